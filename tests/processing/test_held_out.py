"""Passes are also compared by contact, each toss by what the other half of the tosses taught."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from processing.config import Config
from processing.evaluate.truth import open_truth
from processing.field.learn import LearnConfig
from processing.field.train import FieldConfig
from processing.images import raw_images
from processing.pipeline.cycle import learned_by_halves, second_pass, with_contact
from processing.pipeline.passes import Pass, certain_share
from processing.pipeline.start import start_run
from processing.run import Run
from processing.stages.contact import learn_contact
from processing.stages.held_out import Half, halves_of, judge_by_contact, losses_of, why_not_by_contact
from processing.stages.masks.find import find_object
from processing.stages.masks.segment import segment
from processing.stages.recording.rig import refine_rig
from processing.stages.recording.scene import learn_static_scene
from processing.store import Done
from recordings.progress import Silent
from recordings.results.folder import read_shape, read_track, write_shape, write_track
from recordings.session import Session
from recordings.tracks import ObjectShape, ObjectTrack, Status

SAMPLE = Path(__file__).resolve().parents[2] / "recordings" / "samples" / "box_toss"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    session = Session.open(SAMPLE)
    place = tmp_path_factory.mktemp("held-out")
    config = Config(shape=LearnConfig(most_views=12, field=FieldConfig(steps=4)))
    return start_run(session, session.tosses, place, config, "multi-hypothesis", lambda _: Silent())


@pytest.fixture(scope="module")
def true_tracks(run: Run) -> dict[int, Done]:
    truth = open_truth(None, run.session, run.session.calibration)
    assert truth is not None
    found = {}
    for toss in run.tosses:
        times_ns = run.session.toss(toss).rgbd().times_ns
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


@dataclass(frozen=True)
class Stored:
    frames: int = 1
    lost: int = 0


def learned_by(run: Run, halves: tuple[Half, ...], tracks: dict[int, Done]) -> tuple[Half, ...]:
    return tuple(
        replace(h, contact=learn_contact(run, f"test, {h.name}", {t: tracks[t] for t in h.learned_from}, h.shape))
        for h in halves
    )


def stored_track(run: Run, track: ObjectTrack) -> Done:
    def write(folder: Path) -> Stored:
        write_track(folder, track)
        return Stored()

    return run.store.run("track", 1, {}, {"poses": str(float(np.nansum(track.camera_from_object)))}, Stored, write)


def stored_shape(run: Run, shape: ObjectShape) -> Done:
    def write(folder: Path) -> Stored:
        write_shape(folder, shape)
        return Stored()

    return run.store.run("shape", 1, {}, {"size": str(float(np.ptp(shape.vertices_m)))}, Stored, write)


@pytest.fixture(scope="module")
def halves(run: Run, true_tracks: dict[int, Done], true_shape: Done) -> tuple[Half, ...]:
    return learned_by(run, halves_of(true_tracks, dict.fromkeys(true_tracks, true_shape)), true_tracks)


def losses_of_shape(run: Run, tracks: dict[int, Done], halves: tuple[Half, ...], shape: Done) -> dict[int, float]:
    return losses_of([judge_by_contact(run, "test", tracks, replace(h, shape=shape)) for h in halves])


def test_a_shape_stretched_along_one_axis_has_the_larger_loss_on_every_toss_held_out_both_ways(
    run: Run, true_tracks: dict[int, Done], true_shape: Done, halves: tuple[Half, ...]
) -> None:
    body = read_shape(true_shape.folder)
    stretched = stored_shape(run, replace(body, vertices_m=body.vertices_m * np.array([1.2, 1.0, 1.0])))
    small, large = (losses_of_shape(run, true_tracks, halves, s) for s in (true_shape, stretched))
    assert list(small) == list(large) == list(true_tracks)
    assert sum(large.values()) > 1.2 * sum(small.values())


def test_a_shape_one_millimetre_larger_all_round_is_no_evidence_because_the_plane_may_lie_lower(
    run: Run, true_tracks: dict[int, Done], true_shape: Done, halves: tuple[Half, ...]
) -> None:
    body = read_shape(true_shape.folder)
    outward = np.sign(body.vertices_m - body.vertices_m.mean(0))
    larger = stored_shape(run, replace(body, vertices_m=body.vertices_m + 0.001 * outward))
    before, after = (losses_of_shape(run, true_tracks, halves, s) for s in (true_shape, larger))
    assert sum(after.values()) < 1.2 * sum(before.values())


@pytest.mark.slow
def test_what_judges_a_toss_is_the_same_whatever_that_toss_did(
    run: Run, true_tracks: dict[int, Done], true_shape: Done, halves: tuple[Half, ...]
) -> None:
    judged = halves[0].judged
    moved = {t: lifted(run, t, d) if t in judged else d for t, d in true_tracks.items()}
    again = learned_by(run, halves_of(moved, dict.fromkeys(moved, true_shape)), moved)
    before, after = ([None if h.contact is None else h.contact.key for h in found] for found in (halves, again))
    assert after[0] == before[0] is not None
    assert after[1] != before[1]


def lifted(run: Run, toss: int, done: Done) -> Done:
    """The same toss, 2 mm nearer to the camera."""
    track = read_track(done.folder, toss)
    poses = track.camera_from_object.copy()
    poses[:, 2, 3] -= 0.002
    return stored_track(run, replace(track, camera_from_object=poses))


@pytest.mark.slow
def test_no_contact_of_a_toss_is_in_the_second_pass_shape_that_it_is_judged_by(
    run: Run, true_tracks: dict[int, Done], true_shape: Done
) -> None:
    """Walks back through the stages that the judging shapes were made from."""
    scene = learn_static_scene(run)
    rig = refine_rig(run, scene)
    found = find_object(run, scene, rig)
    images = {t: raw_images(run, t, rig, segment(run, t, scene, rig, found)) for t in run.tosses}
    shapes = dict.fromkeys(true_tracks, true_shape)
    start = Pass(true_tracks, shapes, shared_frame=True, halves=halves_of(true_tracks, shapes))
    refined = replace(with_contact(run, start, images, "test"), halves=learned_by_halves(run, start, "test"))
    assert refined.shapes[0].key != true_shape.key, "contact's shape must take part, or nothing is shown"
    after = second_pass(run, refined, images, "test", icp=False)
    for of in (refined, after):
        losses = losses_of([judge_by_contact(run, "test", of.tracks, half) for half in of.halves])
        assert sorted(losses) == list(run.tosses)
    for half in after.halves:
        assert half.shape.key != after.shapes[0].key
        assert half.contact is not None
        behind = tosses_of_contact_behind(run, half.shape) | tosses_of_contact_behind(run, half.contact)
        assert behind == set(half.learned_from)
    assert tosses_of_contact_behind(run, after.shapes[0]) == set(run.tosses)


def tosses_of_contact_behind(run: Run, done: Done) -> set[int]:
    """Tosses that any stage `contact` learned from, among those that led to a stage's shape; not what led to poses."""
    stages = {d["key"]: d for p in run.store.results.glob("*/stage.json") if (d := json.loads(p.read_text()))}
    found: set[int] = set()
    todo = [done.key]
    while todo:
        stage = stages.get(todo.pop())
        if stage is None:
            continue
        if stage["stage"] == "contact":
            found |= {int(n.removeprefix("track_")) for n in stage["inputs"] if n.startswith("track_")}
        todo.append(stage["inputs"].get("shape", ""))
    return found


def test_a_difference_between_few_tosses_counts_only_beyond_chance() -> None:
    before = {1: 1.0, 3: 1.1, 5: 0.9, 7: 1.0}
    assert certain_share(before, {t: 1.3 * x for t, x in before.items()}) == pytest.approx(0.3)
    assert certain_share(before, {1: 1.5, 3: 0.9, 5: 1.0, 7: 1.0}) == 0.0
    assert certain_share(before, {t: 0.8 * x for t, x in before.items()}) == pytest.approx(-0.2)
    assert certain_share({1: 1.0}, {1: 2.0}) == 0.0


def test_three_tosses_are_too_few_for_halves_and_a_session_says_so(
    true_tracks: dict[int, Done], true_shape: Done
) -> None:
    few = dict(list(true_tracks.items())[:3])
    assert halves_of(few, dict.fromkeys(few, true_shape)) == ()
    assert "fewer than 4 tosses" in why_not_by_contact(len(few))
    assert "cannot be learned from each half" in why_not_by_contact(len(true_tracks))
