"""What to throw next: sides that were not seen shrink the surface's uncertainty most; friction's toss by its score."""

from __future__ import annotations

import numpy as np

from processing.contact.friction.estimate import Interval
from processing.live.advice import Throw, options
from processing.live.friction import LawSoFar, shrink_by
from processing.live.sides import DIRECTIONS, GUESS, next_starts, sides_of, surface_sigma_m
from processing.motion.rotation_grid import directions
from recordings.geometry import Transform, rotation_exp
from recordings.tracks import ObjectTrack

CAMERA_UP_M = 0.8
WORLD_FROM_CAMERA = Transform("world", "d455", rotation_exp(np.array([np.pi - 0.6, 0, 0])), np.array([0, -0.5, 0.6]))
CENTER, EXTENT_M = np.zeros(3), 0.1


def still(rotation: np.ndarray, frames: int = 6) -> ObjectTrack:
    """An object that lies before the camera and never turns."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, (0, 0, CAMERA_UP_M)
    times = 33_000_000 * np.arange(frames)
    return ObjectTrack(0, "d455", "object", times, np.tile(pose, (frames, 1, 1)), ("tracked",) * frames,
                       np.tile(np.eye(6), (frames, 1, 1)))  # fmt: skip


def test_a_frame_tells_of_the_side_that_faces_the_camera_and_of_no_other() -> None:
    information = sides_of(still(np.eye(3)), CENTER, None, None).information
    facing = directions(DIRECTIONS) @ np.array([0, 0, -1.0])
    assert (information[facing > 0.5] > 0).all()
    assert (information[facing < 0.2] == 0).all()
    assert directions(DIRECTIONS)[information.argmax()] @ np.array([0, 0, -1.0]) > 0.98


def test_nothing_seen_leaves_the_guess_and_more_frames_only_help() -> None:
    assert surface_sigma_m(np.zeros(DIRECTIONS), EXTENT_M) == GUESS * EXTENT_M
    one, two = (sides_of(still(np.eye(3), n), CENTER, None, None).information for n in (2, 8))
    assert surface_sigma_m(two, EXTENT_M) < surface_sigma_m(one, EXTENT_M) < GUESS * EXTENT_M


def test_the_best_start_shows_the_side_that_nobody_saw() -> None:
    seen = sides_of(still(np.eye(3)), CENTER, WORLD_FROM_CAMERA, None)
    starts = next_starts([seen], still(np.eye(3)).camera_from_object[-1], CENTER, WORLD_FROM_CAMERA, EXTENT_M)
    expected = {s.side: s for s in starts}
    assert starts[0].unseen
    assert not expected["faces the camera"].unseen or not expected["is up"].unseen
    assert expected["lies on the table"].sigma_m < expected["is up"].sigma_m
    assert starts[0].sigma_m < surface_sigma_m(seen.information, EXTENT_M)


def test_a_side_is_touched_where_it_pointed_down_after_the_impact() -> None:
    track = still(np.eye(3))
    down = WORLD_FROM_CAMERA.rotation.T @ np.array([0, 0, -1.0])
    touched = sides_of(track, CENTER, WORLD_FROM_CAMERA, 2).touched
    assert touched[(directions(DIRECTIONS) @ down).argmax()]
    assert not touched[(directions(DIRECTIONS) @ down).argmin()]
    assert not sides_of(track, CENTER, WORLD_FROM_CAMERA, None).touched.any()


def law(information: dict[int, float]) -> LawSoFar:
    return LawSoFar(Interval(0.3, 0.2, 0.4), Interval(0.1, 0.0, 0.3), information)


def test_one_more_toss_like_the_only_one_shrinks_its_deviation_by_one_over_root_two() -> None:
    np.testing.assert_allclose(shrink_by(law({4: 9.0}), 4), 1 - 2**-0.5)
    assert shrink_by(law({4: 9.0, 5: 0.0}), 5) == 0.0
    assert shrink_by(law({}), 0) == 0.0


def test_where_every_side_was_seen_the_toss_that_told_most_of_friction_is_advised_with_what_was_different() -> None:
    turns = [rotation_exp(np.pi / 2 * k * np.eye(3)[a]) for a in (0, 1) for k in range(4)]
    sides = [sides_of(still(r, 30), CENTER, WORLD_FROM_CAMERA, 0) for r in turns] * 4
    throws = {0: Throw(2.0, 0.2), 1: Throw(2.0, 0.2), 2: Throw(8.0, 0.05)}
    now = still(np.eye(3)).camera_from_object[-1]
    found = options(sides, now, CENTER, EXTENT_M, WORLD_FROM_CAMERA, law({0: 1.0, 1: 2.0, 2: 30.0}), throws)
    assert found[0].text.startswith("throw like toss 2 (more spin, lower)")
    assert [o.shrink for o in found] == sorted((o.shrink for o in found), reverse=True)


def test_that_no_toss_told_friction_yet_is_said() -> None:
    sides = [sides_of(still(np.eye(3)), CENTER, WORLD_FROM_CAMERA, 2)]
    found = options(sides, None, CENTER, EXTENT_M, WORLD_FROM_CAMERA, None, {0: Throw(2.0, 0.2)})
    assert [o.text.split(":")[0] for o in found] == ["a toss that flies, hits the table and comes to rest"]


def test_the_law_so_far_says_what_of_restitutions_interval_is_assumed():
    text = LawSoFar(Interval(0.3, 0.2, 0.4), Interval(0.1, 0.0, 0.35), {}).text()
    assert text == (
        "friction 0.30 (0.20 to 0.40), restitution 0.10 (0.00 to 0.35; +-0.20 of it is assumed, not measured)"
    )
