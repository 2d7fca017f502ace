"""Passes are also compared by the contact loss of tosses that nothing of contact was learned from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from processing.config import Config
from processing.cycle import certain_share
from processing.dynamics import held_out_losses, held_out_model
from processing.pipeline import Run, start_run
from processing.stage import Done
from processing.truth import open_truth
from recordings.progress import Silent
from recordings.results import read_shape, write_shape, write_track
from recordings.session import Session
from recordings.tracks import ObjectShape, ObjectTrack, Status

SAMPLE = Path(__file__).resolve().parents[2] / "recordings" / "samples" / "box_toss"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    session = Session.open(SAMPLE)
    place = tmp_path_factory.mktemp("held-out")
    return start_run(session, session.tosses, place, Config(), "multi-hypothesis", lambda _: Silent())


@pytest.fixture(scope="module")
def true_tracks(run: Run) -> dict[int, Done]:
    truth = open_truth(None, run.session, run.session.calibration)
    assert truth is not None
    found = {}
    for toss in run.tosses:
        times_ns = run.frames(toss).times_ns
        empty = ObjectTrack.nowhere(toss, "d455", times_ns)
        poses = truth.camera_from_object(empty)
        assert poses is not None
        covariance = np.tile(np.diag([1e-5] * 3 + [1e-7] * 3), (len(times_ns), 1, 1))
        status: tuple[Status, ...] = tuple("tracked" if np.isfinite(p).all() else "lost" for p in poses)
        found[toss] = stored_track(run, replace(empty, camera_from_object=poses, status=status, covariance=covariance))
    return found


@pytest.fixture(scope="module")
def true_shape(run: Run) -> Done:
    mesh = trimesh.load_mesh(SAMPLE / "truth" / "mesh.obj", process=True)
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    return stored_shape(run, ObjectShape("object", "test", np.asarray(mesh.vertices), np.asarray(mesh.faces)))


def stored_track(run: Run, track: ObjectTrack) -> Done:
    def write(folder: Path) -> dict[str, int]:
        write_track(folder, track)
        return {}

    return run.store.run("track", 1, {}, {"poses": str(float(np.nansum(track.camera_from_object)))}, write)


def stored_shape(run: Run, shape: ObjectShape) -> Done:
    def write(folder: Path) -> dict[str, int]:
        write_shape(folder, shape)
        return {}

    return run.store.run("shape", 1, {}, {"size": str(float(np.ptp(shape.vertices_m)))}, write)


def test_a_shape_stretched_along_one_axis_has_the_larger_loss_on_tosses_it_was_not_learned_from(
    run: Run, true_tracks: dict[int, Done], true_shape: Done
) -> None:
    body = read_shape(true_shape.folder)
    stretched = stored_shape(run, replace(body, vertices_m=body.vertices_m * np.array([1.2, 1.0, 1.0])))
    learned = held_out_model(run, "test", true_tracks, dict.fromkeys(true_tracks, true_shape))
    assert learned is not None
    small, large = (
        held_out_losses(run, "test", true_tracks, dict.fromkeys(true_tracks, s), learned)
        for s in (true_shape, stretched)
    )
    assert list(small) == list(large) == list(true_tracks)[1::2]
    assert sum(large.values()) > 1.3 * sum(small.values())


def test_a_shape_one_millimetre_larger_all_round_is_no_evidence_because_the_plane_may_lie_lower(
    run: Run, true_tracks: dict[int, Done], true_shape: Done
) -> None:
    body = read_shape(true_shape.folder)
    outward = np.sign(body.vertices_m - body.vertices_m.mean(0))
    larger = stored_shape(run, replace(body, vertices_m=body.vertices_m + 0.001 * outward))
    learned = held_out_model(run, "test", true_tracks, dict.fromkeys(true_tracks, true_shape))
    before, after = (
        held_out_losses(run, "test", true_tracks, dict.fromkeys(true_tracks, s), learned) for s in (true_shape, larger)
    )
    assert sum(after.values()) < 1.2 * sum(before.values())


def test_a_difference_between_few_tosses_counts_only_beyond_chance() -> None:
    before = {1: 1.0, 3: 1.1, 5: 0.9, 7: 1.0}
    assert certain_share(before, {t: 1.3 * x for t, x in before.items()}) == pytest.approx(0.3)
    assert certain_share(before, {1: 1.5, 3: 0.9, 5: 1.0, 7: 1.0}) == 0.0
    assert certain_share(before, {t: 0.8 * x for t, x in before.items()}) == pytest.approx(-0.2)
    assert certain_share({1: 1.0}, {1: 2.0}) == 0.0


def test_three_tosses_are_too_few_to_keep_some_for_judging(
    run: Run, true_tracks: dict[int, Done], true_shape: Done
) -> None:
    few = dict(list(true_tracks.items())[:3])
    shapes = dict.fromkeys(few, true_shape)
    assert held_out_model(run, "test", few, shapes) is None
    assert held_out_losses(run, "test", few, shapes, None) == {}
