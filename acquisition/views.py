"""`--calibration`: views of a board into calibration.mcap, taken when it stands still, saying which are missing."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from acquisition.devices import Image
from acquisition.interrupts import Interrupts
from acquisition.operator import Operator
from acquisition.preflight import of_one_size
from acquisition.ready_rig import Setup
from acquisition.run import SessionReport
from acquisition.streaming.recorder import Recorder
from acquisition.synthetic.board import board_tags
from calibration.cameras.targets import Target, TargetView, find_target, target_from_document
from recordings.mcap.toss_writer import TossWriter
from recordings.records import ArmStates, DepthImage, EncodedImage
from recordings.session_writer import SessionWriter

Kind = Literal["board", "hand-eye"]
VIEW_INTERVAL_NS = 1_000_000_000
ENOUGH = {"board": 30, "hand-eye": 20}
PER_CAMERA = 12
CELLS = 3
STILL_PX = 1.5
NEW_PX = 40.0
NEW_TURN_RAD = 0.17
STANDS_RAD, STANDS_NS = 0.002, 10_000_000
POLL_S = 0.3
LONGEST_S = 1800.0
ROUNDS = 2
"""How often the simulated lab shows its views."""
FEWEST_POINTS = 8


@dataclass
class Coverage:
    """Which parts of a camera's picture the board has been in, and how it was tilted."""

    everywhere: bool = True
    """The board has to be in all parts of the picture (lenses want that, hand-eye does not)."""
    views: int = 0
    cells: set[tuple[int, int]] = field(default_factory=set)
    tilts: set[str] = field(default_factory=set)

    def add(self, view: TargetView, width: int, height: int) -> None:
        x, y = view.pixels.mean(axis=0)
        self.views += 1
        self.cells.add((int(CELLS * y / height), int(CELLS * x / width)))
        self.tilts.add(tilt_of(view))

    def missing(self) -> list[str]:
        """What is still to be shown to this camera, in words."""
        wanted = []
        if self.views < PER_CAMERA:
            wanted.append(f"{PER_CAMERA - self.views} more views")
        rows, columns = ("top", "middle", "bottom"), ("left", "centre", "right")
        empty = [f"{rows[r]} {columns[c]}" for r in range(CELLS) for c in range(CELLS) if (r, c) not in self.cells]
        if self.everywhere and len(empty) > 3:
            wanted.append("the board at the " + ", ".join(empty[:3]))
        if len(self.tilts) < 3:
            wanted.append("other tilts than " + ", ".join(sorted(self.tilts) or ["none"]))
        return wanted


def tilt_of(view: TargetView) -> str:
    """How a board lies in the picture, from the perspective of its outline: flat, or which side is far."""
    H, _ = cv2.findHomography(view.points_m[:, :2], view.pixels)
    if H is None:
        return "flat"
    across, along = H[2, 0] / H[2, 2], H[2, 1] / H[2, 2]
    size = float(np.ptp(view.points_m[:, :2], axis=0).max())
    if max(abs(across), abs(along)) * size < 0.08:
        return "flat"
    if abs(across) > abs(along):
        return "right side far" if across > 0 else "left side far"
    return "upper side far" if along > 0 else "lower side far"


def record_views(
    recorder: Recorder,
    session: SessionWriter,
    setup: Setup,
    kind: Kind,
    operator: Operator,
    interrupts: Interrupts,
) -> SessionReport:
    """Views until there are enough, or the stop key. Each holds one image of every camera, a second apart."""
    target = target_from_document(board_document(setup), str(setup.rig.source))
    report = SessionReport(session.folder, 0)
    kinds = ("rgbd",) if kind == "hand-eye" else ("rgbd", "mono")
    covered = {d.name: Coverage(kind == "board") for d in setup.rig.devices if d.kind in kinds}
    operator.say(f"show the board ({kind}); hold it still for each view. x: enough")
    last: dict[str, TargetView] = {}
    kept: list[dict[str, TargetView]] = []
    poses: list[Float[Array, " j"]] = []
    before: Float[Array, " j"] | None = None
    ends, rounds = time.monotonic() + LONGEST_S, 0
    with interrupts.shield():
        writer = session.calibration_views()
    if setup.lab is not None:
        setup.lab.show_views()
    try:
        while len(kept) < ENOUGH[kind] or any(c.missing() for c in covered.values()):
            time.sleep(POLL_S)
            if operator.key() in ("stop", "quit") or time.monotonic() > ends:
                break
            if setup.lab is not None and setup.lab.stage.over():
                rounds += 1
                if rounds == ROUNDS:
                    break
                setup.lab.show_views_again()
            images = _images(recorder, covered)
            seen = _views(target, images)
            still = bool(seen) and all(n in last and _moved_px(seen[n], last[n]) < STILL_PX for n in seen)
            last = seen
            q = recorder.joints_at(time.monotonic_ns())
            still = still and _stands(q, before)
            before = q
            if not still or not _new(kind, seen, kept, q, poses):
                continue
            with interrupts.shield():
                _write(writer, recorder, images, len(kept), q)
            kept.append(seen)
            if q is not None:
                poses.append(q)
            for name, view in seen.items():
                height, width = images[name].pixels.shape[:2]
                covered[name].add(view, width, height)
            operator.say(progress_text(len(kept), ENOUGH[kind], covered))
    finally:
        with interrupts.shield():
            writer.finish()
    missing = {name: c.missing() for name, c in covered.items() if c.missing()}
    report.stopped = "; ".join(f"{name}: {', '.join(m)}" for name, m in missing.items())
    return report


def progress_text(done: int, wanted: int, covered: Mapping[str, Coverage]) -> str:
    """One line a view: how many there are, and what each camera still lacks."""
    parts = [f"{name} wants {', '.join(c.missing())}" for name, c in covered.items() if c.missing()]
    return f"view {done} of {wanted}" + (": " + "; ".join(parts) if parts else ": every camera has seen enough")


def board_document(setup: Setup) -> dict[str, Any]:
    """The board as a session's start document names it: the rig file's [board], or tosslab's own printed tags."""
    if setup.rig.board:
        return dict(setup.rig.board)
    return {
        "kind": "tags",
        "family": "tag36h11",
        "frame": "board centre, z out of the printed side; tag frame as pupil-apriltags reports it",
        "tags": [
            {"id": t.tag_id, "size_m": t.size_m, "T_board_tag": t.world_from_tag.matrix.tolist()} for t in board_tags()
        ],
    }


def _images(recorder: Recorder, names: Mapping[str, Coverage]) -> dict[str, Image]:
    """The latest picture of every camera, by its name."""
    found = {}
    for topic, image in list(recorder.latest.items()):
        name = topic.split("/")[1]
        if name in names and not topic.endswith("depth"):
            found[name] = image
    return found


def _views(target: Target, images: Mapping[str, Image]) -> dict[str, TargetView]:
    greys = {
        name: i.pixels if i.pixels.ndim == 2 else cv2.cvtColor(i.pixels, cv2.COLOR_RGB2GRAY)
        for name, i in images.items()
    }
    views: dict[str, TargetView] = {}
    for group in of_one_size(greys):
        views |= dict(zip(group, find_target(target, list(group.values()))))
    return {name: view for name, view in views.items() if len(view) >= FEWEST_POINTS}


def _moved_px(a: TargetView, b: TargetView) -> float:
    """How far the points that both views share are apart (median)."""
    _, at_a, at_b = np.intersect1d(a.ids, b.ids, return_indices=True)
    if len(at_a) == 0:
        return float("inf")
    return float(np.median(np.linalg.norm(a.pixels[at_a] - b.pixels[at_b], axis=1)))


def _stands(q: Float[Array, " j"] | None, before: Float[Array, " j"] | None) -> bool:
    """Whether the arm, where there is one, stands where it stood a moment ago."""
    return q is None or (before is not None and float(np.abs(q - before).max()) < STANDS_RAD)


def _new(
    kind: Kind,
    seen: Mapping[str, TargetView],
    kept: list[dict[str, TargetView]],
    q: Float[Array, " j"] | None,
    poses: list[Float[Array, " j"]],
) -> bool:
    """Whether a view shows what none before it did: the board elsewhere, or the arm turned."""
    if kind == "hand-eye":
        return q is not None and all(float(np.abs(q - p).max()) > NEW_TURN_RAD for p in poses)
    for before in kept:
        shared = [n for n in seen if n in before]
        if shared and all(_moved_px(seen[n], before[n]) < NEW_PX for n in shared):
            return False
    return True


def _write(
    writer: TossWriter,
    recorder: Recorder,
    images: Mapping[str, Image],
    number: int,
    q: Float[Array, " j"] | None,
) -> None:
    """All cameras at one stamp: nothing moves, so that their clocks do not matter. Lossless."""
    time_ns = (number + 1) * VIEW_INTERVAL_NS
    for name, image in images.items():
        height, width = image.pixels.shape[:2]
        if image.pixels.ndim == 3:
            data = cv2.imencode(".png", cv2.cvtColor(image.pixels, cv2.COLOR_RGB2BGR))[1].tobytes()
            writer.color(EncodedImage(name, number, time_ns, time_ns, "png", width, height, data))
            thumbnails = list(recorder.thumbnails)[-1:]
            depth = recorder.latest.get(f"/{name}/depth")
            if depth is not None and thumbnails:
                writer.depth(DepthImage(name, number, time_ns, time_ns, thumbnails[0].unit_m, depth.pixels))
        else:
            data = cv2.imencode(".png", image.pixels)[1].tobytes()
            writer.mono(EncodedImage(name, number, time_ns, time_ns, "png", width, height, data))
    arm = next((d for d in recorder.devices.values() if hasattr(d, "joint_names")), None)
    if q is not None and arm is not None:
        times_ns = time_ns + STANDS_NS * np.arange(-1, 2)  # the arm stands: a reader finds it before and after the view
        q = np.tile(q, (3, 1))
        writer.arm(ArmStates(times_ns, tuple(arm.joint_names), q, np.zeros_like(q), np.full(3, np.nan)))
