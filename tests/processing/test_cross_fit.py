"""Cross-fitting: a toss is tracked again on the shape of the others, and keeps what fits itself best."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from processing.config import Config
from processing.images import Images, TossImages
from processing.pipeline import cross_fit, first_pass
from processing.pipeline.start import start_run
from processing.refine.image_residuals import Explained
from processing.run import Run
from processing.stages.adjust import AdjustResult
from processing.stages.carry import carried
from processing.stages.track import TrackResult
from processing.store import Done
from recordings.errors import BadInput
from recordings.geometry import rotation_angle_rad, rotation_exp, skew
from recordings.progress import Silent
from recordings.results.folder import read_track, write_masks, write_track
from recordings.session import Session
from recordings.tracks import ObjectTrack

SURE = TrackResult(frames=8, interpolated=0, lost=0)
OPEN = TrackResult(frames=8, interpolated=8, lost=0, cost=0.1)
TURN = np.array([0.0, 0.0, np.radians(10)])


def seen(depth_mm: Any, frames: int = 10, chroma: Any = np.nan) -> Explained:
    """Residuals of frames whose outlines fit alike."""
    depth_m = 1e-3 * np.broadcast_to(np.asarray(depth_mm, dtype=np.float64), frames)
    index, chroma = np.arange(frames, dtype=np.float64), np.broadcast_to(chroma, frames)
    return Explained(np.stack([0 * index, index, depth_m, np.full(frames, 0.1), np.full(frames, np.nan), chroma], 1), 0)


class Tosses:
    """Tosses of the box with true masks, and tracks of them whose poses may be turned more and more as time goes."""

    def __init__(self, tiny_world: Any, folder: Path, count: int, frames: int = 8) -> None:
        session = Session.open(tiny_world.record(folder / "tiny", tosses=tuple(range(count)), frames=frames))
        self.run: Run = start_run(
            session, session.tosses, folder / "out", Config(), "multi-hypothesis", lambda _: Silent()
        )
        self.images: dict[int, Images] = {}
        self._world, self._folder, self._frames = tiny_world, folder, frames
        for toss in session.tosses:
            own = folder / f"segment-{toss}"
            own.mkdir()
            masks = [tiny_world.see(p, i)[1] for i, p in enumerate(tiny_world.poses(frames, toss))]
            write_masks(own, toss, masks, np.ones(frames))
            rgbd = session.toss(toss).rgbd()
            seen = TossImages(rgbd, rgbd.depth_times_ns, masks, np.ones(frames), None, None)
            self.images[toss] = Images(toss, {"masks": f"masks {toss}"}, lambda seen=seen: seen)

    def truth(self, toss: int) -> np.ndarray:
        """camera_from_object of every frame."""
        camera_from_world = self._world.world_from_camera.inverse()
        return np.stack([(camera_from_world @ p).matrix for p in self._world.poses(self._frames, toss)])

    def track(self, toss: int, turn: np.ndarray, name: str) -> Done:
        """The true poses, turned by up to `turn` (rotation vector, object frame) towards the end."""
        poses = self.truth(toss)
        for i, pose in enumerate(poses):
            pose[:3, :3] = pose[:3, :3] @ rotation_exp(turn * i / (len(poses) - 1))
        folder = self._folder / name
        folder.mkdir()
        times_ns, n = self.run.session.toss(toss).rgbd().times_ns, len(poses)
        status: Any = ("tracked",) * n
        write_track(
            folder, ObjectTrack(toss, "d455", "object", times_ns, poses, status, np.tile(1e-6 * np.eye(6), (n, 1, 1)))
        )
        return Done(folder, name, SURE, False)

    def misfit(self, done: Done) -> float:
        """Of toss 0."""
        return cross_fit.misfit(cross_fit.on_itself(self.run, done, self.images[0]))

    def off_deg(self, toss: int, done: Done) -> float:
        """Largest rotation error of a track, from its first frame on."""
        found, true = read_track(done.folder, toss).camera_from_object, self.truth(toss)
        steps = [np.linalg.inv(p[0]) @ p[k] for k in range(len(true)) for p in (found, true)]
        return max(
            np.degrees(rotation_angle_rad(a[:3, :3].T @ b[:3, :3]))
            for a, b in zip(steps[::2], steps[1::2], strict=True)
        )


def test_wrong_poses_fit_their_own_frames_worse(tiny_world: Any, tmp_path: Path) -> None:
    tosses = Tosses(tiny_world, tmp_path, 1)
    misfits = [tosses.misfit(tosses.track(0, k * TURN, f"track-{k}")) for k in range(3)]
    assert misfits == sorted(misfits)
    assert misfits[2] > misfits[0] + 0.3


def test_a_frame_without_a_pose_is_no_way_to_fit_better(tiny_world: Any, tmp_path: Path) -> None:
    tosses = Tosses(tiny_world, tmp_path, 1)
    whole = tosses.track(0, 0 * TURN, "track-whole")
    track = read_track(whole.folder, 0)
    poses = track.camera_from_object.copy()
    poses[4] = np.nan
    status = tuple("lost" if i == 4 else s for i, s in enumerate(track.status))
    less = tmp_path / "track-less"
    less.mkdir()
    write_track(less, replace(track, camera_from_object=poses, status=status))
    assert tosses.misfit(Done(less, "less", SURE, False)) > tosses.misfit(whole)


def test_a_toss_that_drifted_is_put_right_on_the_shape_of_the_other(tiny_world: Any, tmp_path: Path) -> None:
    tosses = Tosses(tiny_world, tmp_path, 2)
    tracks: Any = {0: tosses.track(0, 0 * TURN, "track-0"), 1: tosses.track(1, TURN, "track-1")}
    fitted = cross_fit.cross_fitted(tosses.run, tosses.images, tracks, tracks)
    assert tosses.off_deg(1, tracks[1]) > 9
    assert tosses.off_deg(1, fitted[1]) < 3  # 1.8 by depth alone: outlines are in pixels, 4 mm wide here
    assert tosses.off_deg(0, fitted[0]) < 2


def test_poses_that_drifted_are_put_right_with_the_surface_free(tiny_world: Any, tmp_path: Path) -> None:
    tosses = Tosses(tiny_world, tmp_path, 2)
    tracks: Any = {0: tosses.track(0, 0 * TURN, "track-0"), 1: tosses.track(1, 0.5 * TURN, "track-1")}
    after = cross_fit.with_free_surface(tosses.run, tracks, tosses.images)
    assert tosses.off_deg(1, tracks[1]) > 4.5
    assert tosses.off_deg(1, after[1]) < 3.5  # pixels are 4 mm wide here
    assert tosses.off_deg(0, after[0]) < 2.5
    assert after[1].result.frames == 16


def test_a_toss_that_the_adjustment_spoils_stays_as_it_was(
    tiny_world: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tosses = Tosses(tiny_world, tmp_path, 1, frames=16)
    right, wrong = tosses.track(0, 0 * TURN, "right"), tosses.track(0, 2 * TURN, "wrong")
    right, wrong = (replace(done, result=AdjustResult(16, 0.5, 0.001)) for done in (right, wrong))
    monkeypatch.setattr(cross_fit, "adjust", lambda *_: wrong)
    assert cross_fit.with_free_surface(tosses.run, {0: right}, tosses.images) == {0: right}
    monkeypatch.setattr(cross_fit, "adjust", lambda *_: right)
    assert cross_fit.with_free_surface(tosses.run, {0: wrong}, tosses.images) == {0: right}


def test_poses_are_adjusted_again_while_that_turns_them_and_no_frame_becomes_sure_by_stages(
    tiny_world: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tosses = Tosses(tiny_world, tmp_path, 1, frames=16)
    right = tosses.track(0, 0 * TURN, "right")
    for turns, calls in (((5.0, 2.0, 0.5, 0.1), 3), ((0.5,), 1), ((9.0,) * 9, cross_fit.ADJUSTMENTS)):
        asked = iter(turns)
        seen: list[Any] = []

        def adjusted(_: Any, __: Any, first: Any, *___: Any, asked: Any = asked, seen: list[Any] = seen) -> Any:
            seen.append(first[0])
            return replace(right, result=AdjustResult(16, next(asked), 0.0))

        monkeypatch.setattr(cross_fit, "adjust", adjusted)
        after = cross_fit.with_free_surface(tosses.run, {0: right}, tosses.images)
        assert len(seen) == calls
        assert all(first is right for first in seen)  # what was sure before any of them decides
        assert after[0].result.rotation_deg == turns[calls - 1]


@pytest.mark.parametrize(("alone_turn", "bent_turn", "kept"), [(0, 2, "carry"), (2, 0, "bent"), (0, 0, "bent")])
def test_a_toss_that_registration_bent_is_as_it_was_alone(
    alone_turn: int, bent_turn: int, kept: str, tiny_world: Any, tmp_path: Path
) -> None:
    tosses = Tosses(tiny_world, tmp_path, 1, frames=16)
    alone, bent = (tosses.track(0, k * TURN, name) for k, name in ((alone_turn, "alone"), (bent_turn, "bent")))
    chosen = cross_fit.unbent(tosses.run, 0, bent, alone, tosses.images[0])
    assert chosen.name.startswith(kept) or chosen.key == kept
    poses, others = (read_track(d.folder, 0).camera_from_object for d in (chosen, bent))
    for pose, true in zip(poses, tosses.truth(0), strict=True):  # whatever its object frame, it moves as it truly did
        np.testing.assert_allclose(pose @ np.linalg.inv(poses[0]), true @ np.linalg.inv(tosses.truth(0)[0]), atol=1e-6)
    turned = [np.degrees(rotation_angle_rad(a[:3, :3].T @ b[:3, :3])) for a, b in zip(poses, others, strict=True)]
    assert np.median(turned) < 10  # in the object frame of all


def test_a_carried_track_moves_alike_and_is_as_sure_of_every_point(tiny_world: Any, tmp_path: Path) -> None:
    tosses = Tosses(tiny_world, tmp_path, 1)
    own = read_track(tosses.track(0, TURN, "alone").folder, 0)
    rng = np.random.default_rng(0)
    half = rng.normal(size=(len(own.status), 6, 6)) * 1e-3
    own = replace(own, covariance=half @ half.transpose(0, 2, 1))
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = rotation_exp(np.array([0.4, -1.0, 0.3])), [0.05, -0.02, 0.1]
    moved = carried(own, motion, "object")
    for i, pose in enumerate(own.camera_from_object):
        np.testing.assert_allclose(moved.camera_from_object[i] @ np.linalg.inv(motion), pose, atol=1e-12)
        point = np.array([0.03, 0.01, -0.02])  # own object frame
        spread = []
        for track, at in ((own, point), (moved, (np.linalg.inv(motion) @ [*point, 1])[:3])):
            arm = track.camera_from_object[i, :3, :3] @ at
            J = np.hstack([-skew(arm), np.eye(3)])
            spread.append(J @ track.covariance[i] @ J.T)
        np.testing.assert_allclose(spread[0], spread[1], atol=1e-15)


def test_the_worst_toss_comes_first_and_every_toss_once(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, tiny_world: Any
) -> None:
    tosses = Tosses(tiny_world, tmp_path, 1)
    run, images = tosses.run, dict.fromkeys(range(7), tosses.images[0])
    monkeypatch.setattr(cross_fit, "on_itself", lambda _, done, __: seen({"3": 5.0, "6": 4.0}.get(done.key, 1.0)))
    tracks = {t: Done(tmp_path, str(t), None, False) for t in range(7)}
    folds = cross_fit.worst_first(cross_fit.own_misfits(run, tracks, images))
    assert folds[0][:2] == (3, 6)
    assert len(folds) == cross_fit.FOLDS
    assert sorted(t for fold in folds for t in fold) == list(range(7))


@pytest.mark.parametrize(
    ("depth_mm", "turns"), [([4.0, 3.0, 2.5, 2.49], 3), ([4.0, 3.95], 1), ([9.0 / k for k in range(1, 20)], 6)]
)
def test_it_goes_on_with_the_tosses_that_gained(
    depth_mm: list[float], turns: int, monkeypatch: pytest.MonkeyPatch, tiny_world: Any, tmp_path: Path
) -> None:
    """Toss 1 fits so after each turn; toss 0 gains nothing. Located anew they may be in the first turn only."""
    tosses = Tosses(tiny_world, tmp_path, 2)
    tracks = {t: Done(tmp_path, f"{t} 0", SURE, False) for t in (0, 1)}
    asked: list[str] = []
    located: list[bool] = []

    def chosen(_: Any, before: Done, *others: Any) -> Done:
        toss, turn = before.key.split()
        asked.append(toss)
        located.append(others[-1])
        return before if toss == "0" else Done(tmp_path, f"1 {int(turn) + 1}", SURE, False)

    def on_itself(_: Any, done: Done, __: Any) -> Explained:
        toss, turn = done.key.split()
        return seen(1.0 if toss == "0" else depth_mm[int(turn)])

    monkeypatch.setattr(cross_fit, "chosen", chosen)
    monkeypatch.setattr(cross_fit, "on_itself", on_itself)
    monkeypatch.setattr(cross_fit, "fused", lambda *_: tracks[0])
    cross_fit.cross_fitted(tosses.run, tosses.images, tracks, tracks)
    assert asked == ["1", "0", *["1"] * (turns - 1)]
    assert located == [True, True, *[False] * (turns - 1)]


def test_one_toss_stays_as_it_is(tiny_world: Any, tmp_path: Path) -> None:
    tosses = Tosses(tiny_world, tmp_path, 1)
    only = {0: tosses.track(0, TURN, "track-0")}
    alone: Any = {0: Done(tmp_path, "alone-0", SURE, False)}
    assert cross_fit.cross_fitted(tosses.run, tosses.images, only, alone) == only


class Tried:
    """Stands for the stage `track` and what its tracks leave: depth residuals (mm) of ten frames by way, and what the
    pairs of frames cost where it located the object anew (0.1 else)."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, folder: Path, cost: float = 0.1, **depth_mm: Any) -> None:
        self.asked: list[str] = []

        def track(_: Any, __: Any, ___: Done, before: Done | None = None) -> Done:
            self.asked.append("anew" if before is None else "refined")
            return Done(folder, self.asked[-1], replace(OPEN, cost=cost if before is None else 0.1), False)

        monkeypatch.setattr(cross_fit, "track", track)
        monkeypatch.setattr(cross_fit, "on_itself", lambda _, done, __: seen(depth_mm[done.key]))
        monkeypatch.setattr(cross_fit, "on_shape", lambda *_: seen(2.0))
        self.before, self.shape = (Done(folder, name, None, False) for name in ("before", "shape"))


@pytest.mark.parametrize(("frames", "sought"), [((40, 0, 0), False), ((40, 4, 0), False), ((40, 3, 2), True)])
def test_the_object_is_sought_anew_where_frames_are_not_sure(
    frames: tuple[int, int, int], sought: bool, monkeypatch: pytest.MonkeyPatch, tiny_world: Any, tmp_path: Path
) -> None:
    tosses = Tosses(tiny_world, tmp_path, 1)
    tried = Tried(monkeypatch, tmp_path, before=3.0, refined=2.0, anew=1.0)
    known = TrackResult(*frames)
    found = cross_fit.chosen(tosses.run, tried.before, known, tried.shape, tosses.images[0], locate=True)
    assert found.key == ("anew" if sought else "refined")
    assert tried.asked == ["refined", *(["anew"] if sought else [])]


@pytest.mark.parametrize(("anew", "taken"), [(1.0, "anew"), ([1.0, 2.9] * 5, "refined"), (2.5, "refined")])
def test_another_way_of_lying_has_to_fit_better_beyond_chance(
    anew: Any, taken: str, monkeypatch: pytest.MonkeyPatch, tiny_world: Any, tmp_path: Path
) -> None:
    tosses = Tosses(tiny_world, tmp_path, 1)
    tried = Tried(monkeypatch, tmp_path, before=3.0, refined=2.0, anew=anew)
    assert cross_fit.chosen(tosses.run, tried.before, OPEN, tried.shape, tosses.images[0], locate=True).key == taken


@pytest.mark.parametrize(("cost", "taken"), [(0.05, "anew"), (0.15, "anew"), (0.2, "refined")])
def test_pairs_of_frames_may_contradict_what_the_surface_prefers(
    cost: float, taken: str, monkeypatch: pytest.MonkeyPatch, tiny_world: Any, tmp_path: Path
) -> None:
    """A surface prefers the object anew by log(2) nats a frame."""
    tosses = Tosses(tiny_world, tmp_path, 1)
    tried = Tried(monkeypatch, tmp_path, cost, before=3.0, refined=2.0, anew=1.0)
    assert cross_fit.chosen(tosses.run, tried.before, OPEN, tried.shape, tosses.images[0], locate=True).key == taken


@pytest.mark.parametrize(("anew", "taken"), [((2.0, 0.01), "anew"), ((2.0, 0.03), "refined"), ((1.0, 0.02), "anew")])
def test_of_ways_that_fit_themselves_alike_the_others_shape_and_its_colors_tell(
    anew: tuple[float, float], taken: str, monkeypatch: pytest.MonkeyPatch, tiny_world: Any, tmp_path: Path
) -> None:
    """A can fits itself at any azimuth."""
    tosses = Tosses(tiny_world, tmp_path, 1)
    tried = Tried(monkeypatch, tmp_path, before=3.0, refined=2.0, anew=2.0)
    on_others = {"refined": (2.0, 0.02), "anew": anew}
    monkeypatch.setattr(
        cross_fit, "on_shape", lambda _, done, *__: seen(on_others[done.key][0], 10, on_others[done.key][1])
    )
    assert cross_fit.chosen(tosses.run, tried.before, OPEN, tried.shape, tosses.images[0], locate=True).key == taken


@pytest.mark.parametrize(("lost", "better"), [(0, True), (1, False)])
def test_a_track_that_loses_frames_is_not_better(lost: int, better: bool) -> None:
    one, other = (cross_fit.TrackResiduals(replace(seen(mm), lost=n), 0.1) for mm, n in ((1.0, lost), (2.0, 0)))
    assert one.surely_better(other) == better


def test_a_track_that_the_shape_makes_worse_stays(
    monkeypatch: pytest.MonkeyPatch, tiny_world: Any, tmp_path: Path
) -> None:
    tosses = Tosses(tiny_world, tmp_path, 1)
    tried = Tried(monkeypatch, tmp_path, before=2.0, refined=3.0)
    assert cross_fit.chosen(tosses.run, tried.before, SURE, tried.shape, tosses.images[0], locate=True) is tried.before


def test_a_shape_that_fits_nothing_locates_no_toss(
    monkeypatch: pytest.MonkeyPatch, tiny_world: Any, tmp_path: Path
) -> None:
    def track(*_: Any, **__: Any) -> Done:
        raise BadInput("the given shape fits nothing")

    tosses = Tosses(tiny_world, tmp_path, 1)
    monkeypatch.setattr(cross_fit, "track", track)
    assert cross_fit.located_on(tosses.run, tosses.images[0], Done(tmp_path, "shape", None, False)) is None


@pytest.mark.parametrize("drifted", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_a_toss_that_was_not_joined_is_found_on_the_shape_of_the_others(
    drifted: int, tiny_world: Any, tmp_path: Path
) -> None:
    """Whether its own track was right or not."""
    tosses = Tosses(tiny_world, tmp_path, 2)
    joined = {0: tosses.track(0, 0 * TURN, "track-0")}
    apart = {1: tosses.track(1, drifted * TURN, "alone-1")}
    found = first_pass.located(tosses.run, tosses.images, joined, apart)
    assert set(found) == {1}
    assert tosses.off_deg(1, found[1]) < 3
    assert first_pass.located(tosses.run, tosses.images, joined, {}) == {}


def test_a_toss_that_surely_fits_better_alone_is_not_located_on_the_others(
    monkeypatch: pytest.MonkeyPatch, tiny_world: Any, tmp_path: Path
) -> None:
    tosses = Tosses(tiny_world, tmp_path, 2)
    joined, own = {0: tosses.track(0, 0 * TURN, "track-0")}, {1: tosses.track(1, 0 * TURN, "alone-1")}
    monkeypatch.setattr(first_pass, "joins", lambda *_: False)
    assert first_pass.located(tosses.run, tosses.images, joined, own) == {}


@pytest.mark.parametrize(
    ("anew_mm", "anew_cost", "explained", "comes"),
    [
        (2.2, 0.1, True, True), (2.2, 0.1, False, False), (1.8, 0.25, True, False), (4.5, 0.1, True, False),
        (0.8, 0.1, False, True),
    ],
)  # fmt: skip
def test_a_track_alone_that_fits_far_better_is_kept_and_one_that_fits_worse_is_not(
    anew_mm: float, anew_cost: float, explained: bool, comes: bool, monkeypatch: pytest.MonkeyPatch, tiny_world: Any,
    tmp_path: Path,
) -> None:  # fmt: skip
    """A shape whose tosses have not seen all sides does not explain what shows the others, however right it lies."""
    tosses, depth_mm = Tosses(tiny_world, tmp_path, 1), {"alone": 2.0, "anew": anew_mm}
    monkeypatch.setattr(cross_fit, "on_itself", lambda _, done, __: seen(depth_mm[done.key]))
    alone = Done(tmp_path, "alone", OPEN, False)
    anew = Done(tmp_path, "anew", replace(OPEN, cost=anew_cost), False)
    assert cross_fit.joins(tosses.run, tosses.images[0], alone, anew, lambda: explained) == comes


def test_tosses_that_show_nothing_sure_correct_no_other(tiny_world: Any, tmp_path: Path) -> None:
    """Nor is a track without any pose taken for a fit."""
    tosses = Tosses(tiny_world, tmp_path, 2)
    tracks = {0: tosses.track(0, 0 * TURN, "track-0"), 1: tosses.track(1, TURN, "track-1")}
    for toss, done in tracks.items():
        track = read_track(done.folder, toss)
        lost: Any = ("lost",) * 8
        write_track(done.folder, replace(track, camera_from_object=np.full((8, 4, 4), np.nan), status=lost))
    same: Any = tracks
    assert cross_fit.cross_fitted(tosses.run, tosses.images, tracks, same) == tracks
    assert tosses.misfit(tracks[0]) == pytest.approx(np.log(0.02))
