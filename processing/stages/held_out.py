"""Stage `held-out`: passes compared by contact, with shape, friction and inertia learned from one half of the tosses
and judged on the other, both ways.

A half takes the row's own way: the shape that contact corrects from this half alone goes into a second pass of its own,
so nothing that contact told of the judged tosses is in the shape they are judged by. What all tosses showed the camera
is; and poses are the row's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from jaxtyping import Float
from numpy import ndarray as Array
from scipy.optimize import minimize_scalar

from processing.run import CAMERA, Run
from processing.store import Done
from recordings.errors import BadInput
from recordings.geometry import Transform
from recordings.results.folder import read_contact, read_shape, read_track
from recordings.tracks import ContactModel, ObjectShape, ObjectTrack
from recordings.whole_file import write_json

if TYPE_CHECKING:
    from processing.contact.learn.shape_comparison import TossLoss

VERSION = 6
LEAST_TOSSES = 4
"""From which on there are halves: learned from fewer than two tosses, friction is hardly known."""
ALONE = "passes are compared by images alone, not by the contact of tosses held out"
HEIGHTS_M = (-0.004, 0.004)
"""How far the plane may lie from where calibration has it."""


@dataclass(frozen=True)
class HeldOutResult:
    """Contact loss (J) by toss and how far the plane was raised (m); or why there are none."""

    loss_j: Mapping[str, float]
    raised_m: float = 0.0
    kept_out: str | None = None


@dataclass(frozen=True, eq=False)
class Half:
    """What is known where contact is learned from the tosses `learned_from` alone: the shape so far, and (None: not
    learned yet) the stage `contact` that corrected it, with friction and inertia. `judged` are the other tosses."""

    learned_from: tuple[int, ...]
    judged: tuple[int, ...]
    shape: Done
    contact: Done | None = None

    @property
    def name(self) -> str:
        return f"contact from tosses {_listed(self.learned_from)} alone"


def halves_of(tracks: Mapping[int, Done], shapes: Mapping[int, Done]) -> tuple[Half, ...]:
    """Every other toss, and the rest, with a shape that no contact was learned for; none where tosses are too few or do
    not share a shape."""
    if len(tracks) < LEAST_TOSSES or len({s.key for s in shapes.values()}) > 1:
        return ()
    tosses, shape = sorted(tracks), next(iter(shapes.values()))
    first, second = tuple(tosses[::2]), tuple(tosses[1::2])
    return Half(first, second, shape), Half(second, first, shape)


def why_not_by_contact(tosses: int) -> str:
    """What to say where passes were not compared by contact."""
    if tosses < LEAST_TOSSES:
        return f"fewer than {LEAST_TOSSES} tosses together: {ALONE}"
    return f"contact cannot be learned from each half of the tosses: {ALONE}"


def losses_of(judged: Sequence[Done[HeldOutResult]]) -> dict[int, float]:
    """Contact loss (J) of every toss by the half that did not learn from it; empty without halves, or where a half has
    no toss that can be used."""
    if not all(d.result.loss_j for d in judged):
        return {}
    return dict(sorted((int(t), float(x)) for d in judged for t, x in d.result.loss_j.items()))


def judge_by_contact(run: Run, name: str, tracks: Mapping[int, Done], half: Half) -> Done[HeldOutResult]:
    """The contact loss of the judged tosses by a half's shape, friction and inertia.

    At the height of the plane that suits the half's own tosses best: size and height are not identifiable together, and
    a shape that grew would else be charged for a plane that lies too high.
    """
    if half.contact is None:
        raise ValueError("a half judges after it has learned contact")
    learned = half.contact
    inputs = {"shape": half.shape.key, "learned": learned.key, "judged": _listed(half.judged)}
    inputs |= {**{f"track_{t:02d}": d.key for t, d in tracks.items()}, "calibration": run.keys["calibration"]}

    def compute(folder: Path) -> HeldOutResult:
        run.progress(f"{name}: contact loss of tosses not learned from").step(0, 1, "")
        own, others = (
            {t: read_track(tracks[t].folder, t) for t in tosses} for tosses in (half.learned_from, half.judged)
        )
        world_from_camera = run.session.calibration.transform("world", CAMERA)
        try:
            points_m, model = hull_of(read_shape(half.shape.folder)), read_contact(learned.folder)
            raised_m = best_height_m(own, points_m, model, world_from_camera)
            losses = losses_at(raised_m, others, points_m, model, world_from_camera)
        except BadInput as why:
            return HeldOutResult({}, kept_out=str(why))
        write_json(folder / "losses.json", {str(t): asdict(x) for t, x in losses.items()})
        return HeldOutResult({str(t): x.loss_j for t, x in losses.items()}, raised_m)

    return run.store.run("held-out", VERSION, {}, inputs, HeldOutResult, compute)


def best_height_m(
    poses: Mapping[int, ObjectTrack], points_m: Float[Array, "v 3"], model: ContactModel, world_from_camera: Transform
) -> float:
    """How far (m) the plane is raised where the mean loss of these tosses is least."""
    from processing.contact.learn.shape_comparison import mean_loss_j

    def mean_j(raised_m: float) -> float:
        return mean_loss_j(losses_at(raised_m, poses, points_m, model, world_from_camera))

    return float(minimize_scalar(mean_j, bounds=HEIGHTS_M, method="bounded", options={"xatol": 2e-4}).x)


def hull_of(shape: ObjectShape) -> Float[Array, "v 3"]:
    """The points of a shape that may touch: the same at every height of the plane."""
    from processing.contact.physics.support import trimmed_hull

    return trimmed_hull(shape.vertices_m, shape.faces)


def losses_at(
    raised_m: float,
    poses: Mapping[int, ObjectTrack],
    points_m: Float[Array, "v 3"],
    model: ContactModel,
    world_from_camera: Transform,
) -> dict[int, TossLoss]:
    """Contact losses above the plane raised by so much (m)."""
    from processing.contact.learn.shape_comparison import contact_loss_of
    from processing.contact.physics.plane import Plane

    plane = Plane(model.plane_normal_world, model.plane_offset_m + float(raised_m), "the contact model")
    return contact_loss_of(poses, points_m, model, world_from_camera, plane)


def _listed(tosses: Sequence[int]) -> str:
    return ", ".join(map(str, tosses))
