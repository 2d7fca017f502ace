"""Marks say what happened: silent wrong frames, covariances that hold, a table that names what failed."""

import json
from dataclasses import replace

import numpy as np
import pytest
from variety import marks
from variety.table import table

from recordings.geometry import rotation_exp
from recordings.tracks import ObjectTrack

N = 60
RNG = np.random.default_rng(0)


def pose(turn, shift):
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = rotation_exp(np.asarray(turn, float)), shift
    return out


TRUE = np.array([pose(3 * RNG.standard_normal(3), [0.1, 0.2, 0.8] + 0.1 * RNG.standard_normal(3)) for _ in range(N)])


def track(poses, sigma=(0.01, 0.002)):
    covariance = np.diag([sigma[0] ** 2] * 3 + [sigma[1] ** 2] * 3)
    return ObjectTrack(
        0, "d455", "object", np.arange(N, dtype=np.int64), poses, ("tracked",) * N, np.tile(covariance, (N, 1, 1))
    )


def off(k, turn=(0, 0, 0), shift=(0, 0, 0)):
    poses = TRUE.copy()
    poses[k] = poses[k] @ pose(turn, shift)
    return poses


def test_a_frame_off_by_six_degrees_or_three_centimetres_that_is_called_tracked_is_silent_and_wrong():
    for k, poses in ((7, off(7, turn=(0, np.radians(6), 0))), (9, off(9, shift=(0.03, 0, 0)))):
        assert np.flatnonzero(marks.silent_wrong(track(poses), TRUE, False)).tolist() == [k]
    near = off(7, turn=(0, np.radians(4), 0))
    assert not marks.silent_wrong(track(near), TRUE, False).any()


def test_a_masks_overlap_is_what_both_share_of_what_either_has_and_hidden_frames_do_not_count():
    true, found = np.zeros((3, 8, 8), dtype=bool), np.zeros((3, 8, 8), dtype=bool)
    true[0, 2:6, 2:6], true[1, 2:6, 2:6], found[0, 2:6, 2:4], found[2, 0, 0] = True, True, True, True
    np.testing.assert_allclose(marks.overlap(found, true), [0.5, 0.0])


def test_another_object_frame_is_no_error():
    frame = pose((0.3, 1.0, -2.0), (0.02, 0.0, -0.05))
    assert not marks.silent_wrong(track(TRUE @ frame), TRUE, False).any()
    assert marks.normalised_errors(track(TRUE @ frame), TRUE).max() < 1e-12


def test_a_wrong_frame_that_is_flagged_is_not_silent():
    wrong = track(off(7, shift=(0.03, 0, 0)))
    flagged = replace(wrong, status=tuple("interpolated" if k == 7 else s for k, s in enumerate(wrong.status)))
    assert not marks.silent_wrong(flagged, TRUE, False).any()


def test_of_a_plain_body_of_revolution_a_turn_about_its_axis_is_no_error_and_a_tilt_is():
    spun, tilted = off(7, turn=(0, 0, 1.0)), off(7, turn=(0.2, 0, 0))
    assert not marks.silent_wrong(track(spun), TRUE, True).any()
    assert marks.silent_wrong(track(spun), TRUE, False)[7]
    assert marks.silent_wrong(track(tilted), TRUE, True)[7]


def test_errors_drawn_from_the_covariance_are_inside_95_per_cent_of_its_ellipsoids_95_per_cent_of_the_time():
    rng, inside, mean = np.random.default_rng(1), [], []
    for _ in range(20):
        noisy = TRUE.copy()
        noisy[:, :3, :3] = [rotation_exp(0.01 * rng.standard_normal(3)) @ T[:3, :3] for T in TRUE]
        noisy[:, :3, 3] += 0.002 * rng.standard_normal((N, 3))
        errors = marks.normalised_errors(track(noisy), TRUE)
        inside.append((errors < marks.CHI2_6_95).mean())
        mean.append(errors.mean() / 6)
    assert np.mean(inside) == pytest.approx(0.95, abs=0.02)
    assert np.mean(mean) == pytest.approx(1.0, abs=0.08)


def test_a_track_that_is_sure_of_the_frame_where_it_defined_its_object_frame_is_judged_from_there():
    """A random walk away from the first frame, with the covariance of a random walk."""
    rng, mean = np.random.default_rng(2), []
    for _ in range(20):
        turns, shifts = (np.cumsum(s * rng.standard_normal((N, 3)), axis=0) for s in (0.01, 0.002))
        poses, growing = TRUE.copy(), np.zeros((N, 6, 6))
        for k in range(1, N):
            poses[k, :3, :3] = rotation_exp(turns[k] - turns[0]) @ TRUE[k, :3, :3]
            poses[k, :3, 3] += shifts[k] - shifts[0]
            growing[k] = k * np.diag([0.01**2] * 3 + [0.002**2] * 3)
        walked = replace(track(poses @ pose((1.0, 0.2, 0), (0.01, 0, 0.03))), covariance=growing)
        errors = marks.normalised_errors(walked, TRUE)
        assert len(errors) == N - 1
        mean.append(errors.mean() / 6)
    assert np.mean(mean) == pytest.approx(1.0, abs=0.2)


def test_a_covariance_ten_times_too_small_is_found_out():
    poses = np.array([pose(0.01 * RNG.standard_normal(3), 0) @ T for T in TRUE])
    assert marks.normalised_errors(track(poses, sigma=(0.001, 0.002)), TRUE).mean() / 6 > 10


def test_a_track_that_turns_away_all_the_time_is_judged_and_not_refused():
    poses = np.array([T @ pose((0, 0, 0.1 * k), (0, 0, 0)) for k, T in enumerate(TRUE)])
    assert marks.normalised_errors(track(poses), TRUE).mean() / 6 > 100
    assert marks.silent_wrong(track(poses), TRUE, False)[1:].all()


def row(case, add, **more):
    marked = {
        "frames": 40, "lost": 0, "flagged": 3, "silent": 2, "silent_tosses": 1, "add": add,
        "adds": 99.0, "success": 90.0,
        "chamfer_cm": 0.2, "inside_95": 0.9, "nees": 1.5, "friction": 0.3, "friction_inside": True,
        "restitution": None, "mask_iou": 0.925,
    }  # fmt: skip
    return {
        "case": case, "seed": 1, "family": "box", "commit": "abc", "floor_cm": 0.1,
        "made": {"cpu_s": 50.0, "wall_s": 60.0},
        "physics": {"friction_mu": 0.25, "restitution": 0.2}, "runs": {"ours": {"cpu_s": 10.0, "marks": marked}},
    } | more  # fmt: skip


def test_the_table_means_over_sessions_sums_frames_and_names_the_worst():
    text = table([row("choose-000", 90.0), row("choose-009", 80.0)], "choose")
    line = next(x for x in text.splitlines() if x.startswith("| all | ours"))
    cells = [c.strip() for c in line.strip("|").split("|")]
    assert cells[2:4] == ["2 of 2", "85.0"]
    assert cells[8:11] == ["92.5", "4 of 80", "6 of 80"]
    assert cells[-1] == "choose-009 (80.0)"
    assert "choose-000:1 choose-009:1" in text


def test_what_failed_is_counted_and_named_and_not_in_the_means():
    skipped = {
        "case": "choose-018",
        "seed": 1,
        "family": "box",
        "commit": "abc",
        "runs": {},
        "failed": "skipped: out of view",
    }
    half = row("choose-027", 70.0)
    half["runs"] = {"ours": {"cpu_s": 3.0, "failed": "exit code 2: no mask"}}
    text = table([row("choose-000", 90.0), skipped, half], "choose")
    assert "Failed or skipped: 2" in text
    assert "- choose-018 (box): skipped: out of view" in text
    assert "- choose-027 (box), ours: exit code 2: no mask" in text
    assert "| all | ours | 1 of 2 | 90.0 |" in text


def test_a_run_in_which_everything_failed_is_still_a_table():
    text = table(
        [{"case": "choose-000", "seed": 1, "family": "mug", "commit": "c", "runs": {}, "failed": "crashed: x"}],
        "choose",
    )
    assert "Failed or skipped: 1" in text
    assert json.dumps(text)
