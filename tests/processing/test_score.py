"""Scores of a results folder: every frame counts, and they are those of the independent scorer."""

from __future__ import annotations

import importlib.util
import json
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import trimesh

from processing.config import Config
from processing.evaluate.floor import coverage_floor
from processing.evaluate.score import VariantScore, score_variant
from processing.evaluate.table import collect, markdown, table_document
from processing.evaluate.truth import Truth
from processing.pipeline.start import start_run
from recordings.exporters.export import export
from recordings.geometry import CameraModel, rotation_exp
from recordings.progress import Silent
from recordings.results.folder import Results, Scope, TossRecord, VariantRecord, write_shape, write_track, write_variant
from recordings.session import Session
from recordings.tracks import ObjectShape, ObjectTrack, RigCalibration, Status

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("TOSSLAB_DATA", ROOT.parent / "shared" / "data"))
SCORER = DATA.parent / "score" / "score.py"
BOX_M = (0.10, 0.08, 0.06)
FRAME_NS = 33_333_333
CALIBRATION = RigCalibration({"d455": CameraModel("d455", 64, 48, np.eye(3))})


@dataclass(frozen=True)
class Folders:
    """A truth folder and a results folder, with which the scorers are asked."""

    truth: Path
    results: Path

    def score(self, variant: str = "ours", scope: Scope = "all") -> VariantScore:
        results = Results.open(self.results)
        record = results.find(variant, scope)
        return score_variant(results, record, Truth(self.truth, record.calibration, self.truth / "mesh.obj"))

    def table(self, variant: str = "ours", scope: Scope = "all") -> str:
        results = Results.open(self.results)
        return markdown(table_document(results, collect(results, {(variant, scope): self.score(variant, scope)})))


def near(rng: np.random.Generator, turn_rad: float, shift_m: float) -> np.ndarray:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = rotation_exp(turn_rad * rng.standard_normal(3)), shift_m * rng.standard_normal(3)
    return out


def true_poses(rng: np.random.Generator, frames: int) -> np.ndarray:
    """A smooth motion in front of the camera."""
    first, step = near(rng, 1.0, 0.1), near(rng, 0.1, 0.01)
    first[2, 3] += 0.8
    return np.stack([first @ np.linalg.matrix_power(step, i) for i in range(frames)])


def track_of(toss: int, poses: np.ndarray, frame: str = "object") -> ObjectTrack:
    n = len(poses)
    status: tuple[Status, ...] = tuple("tracked" if np.isfinite(p).all() else "lost" for p in poses)
    return ObjectTrack(toss, "d455", frame, np.arange(n) * FRAME_NS, poses, status, np.full((n, 6, 6), np.nan))


def written(
    place: Path,
    truth: Sequence[np.ndarray],
    estimate: Sequence[np.ndarray],
    shared: bool = False,
    apart: Sequence[int] = (),
    variant: str = "ours",
    scope: Scope = "all",
    shape: bool = False,
) -> Folders:
    """A `*_truth` folder and a results folder with these poses (NaN: lost); with `shape` the true box as the one found,
    else an empty mesh, of which there is no Chamfer distance to wait for."""
    mesh = trimesh.creation.box(BOX_M)
    for toss, poses in enumerate(truth):
        folder = place / "truth" / f"toss_{toss:02d}"
        folder.mkdir(parents=True)
        np.savez(folder / "poses_camera_object.npz", t=np.arange(len(poses)) * FRAME_NS * 1e-9, T_camera_object=poses)
    mesh.export(place / "truth" / "mesh.obj")
    tosses = []
    for toss, poses in enumerate(estimate):
        stage = place / "results" / f"track-{toss}"
        stage.mkdir(parents=True)
        write_track(stage, track_of(toss, poses, f"object_{toss}" if toss in apart else "object"))
        tosses.append(TossRecord(toss, stage.name, f"field-{toss}" if toss in apart else "field"))
    for name in {str(t.shape) for t in tosses} | {"field"}:
        (place / "results" / name).mkdir()
        faces = np.asarray(mesh.faces) if shape else np.zeros((0, 3), dtype=np.int64)
        body = ObjectShape("object", "test", np.asarray(mesh.vertices), faces)
        write_shape(place / "results" / name, body)
    write_stage_documents(place / "results")
    record = VariantRecord(
        variant, scope, variant, "test", "box", CALIBRATION, tuple(tosses), "field" if scope == "all" else None,
        shared_object_frame=shared,
    )  # fmt: skip
    write_variant(place / "results", record)
    return Folders(place / "truth", place / "results")


def write_stage_documents(results: Path) -> None:
    for folder in results.iterdir():
        (folder / "stage.json").write_text(json.dumps({"key": folder.name}))


def lost(poses: np.ndarray) -> np.ndarray:
    return np.full_like(poses, np.nan)


@pytest.fixture
def ten() -> list[np.ndarray]:
    rng = np.random.default_rng(7)
    return [true_poses(rng, 12) for _ in range(10)]


def test_true_poses_with_five_of_ten_tosses_lost_score_a_half(tmp_path: Path, ten: list[np.ndarray]) -> None:
    folders = written(tmp_path, ten, [p if i % 2 else lost(p) for i, p in enumerate(ten)])
    score = folders.score()
    for name in ("add_auc", "adds_auc", "success_5deg_5cm"):
        assert score.values[name].value == pytest.approx(50, abs=0.01)
        assert score.values[name].n == 120
    assert score.values["lost_frames"].value == 60
    assert [t.lost for t in score.tosses] == [12, 0] * 5


def test_a_lost_toss_is_lost_in_the_table_and_one_kept_apart_is_named(tmp_path: Path, ten: list[np.ndarray]) -> None:
    estimate = [lost(p) if i == 3 else p for i, p in enumerate(ten[:5])]
    table = written(tmp_path, ten[:5], estimate, apart=[1, 4]).table()
    assert "| ours | 5 (lost: 3; apart: 1, 4) | 60 | 0 | 12 | 80.00 | 80.00 | 80.00 |" in table
    assert "a toss whose first frame is lost is not aligned" in table


def test_a_toss_whose_first_frame_is_lost_is_scored_as_it_lies(tmp_path: Path, ten: list[np.ndarray]) -> None:
    """Its object frame is unknown then: a turn of it makes every frame wrong, as the independent scorer has it."""
    turned = ten[0] @ near(np.random.default_rng(1), 1.0, 0.0)
    turned[0] = np.nan
    score = written(tmp_path, ten[:1], [turned], shape=True).score()
    assert score.values["success_5deg_5cm"].value == 0
    assert score.values["add_auc"].value < 80
    assert any("toss 0: its first frame is lost" in w for w in score.warnings)
    assert score.values["cd"].aligned == "not aligned: no first frame is known"


def test_all_tosses_lost_score_nothing_and_are_all_counted(tmp_path: Path, ten: list[np.ndarray]) -> None:
    score = written(tmp_path, ten[:2], [lost(p) for p in ten[:2]]).score()
    assert (score.values["add_auc"].value, score.values["success_5deg_5cm"].value) == (0, 0)
    assert score.values["lost_frames"].value == 24
    assert np.isinf(score.values["median_translation"].value)


@pytest.mark.parametrize(("scope", "shown"), [("one", True), ("all", False)])
def test_the_papers_figures_stand_beside_scope_one_only(
    tmp_path: Path, ten: list[np.ndarray], scope: Scope, shown: bool
) -> None:
    """They are of one toss at a time: beside all tosses together they would compare other things."""
    table = written(tmp_path, ten[:2], ten[:2], scope=scope).table(scope=scope)
    assert ("(69.5)" in table) == shown
    assert ("the paper's figure" in table) == shown


@pytest.fixture(scope="module")
def scorer() -> ModuleType:
    if not SCORER.exists():
        pytest.skip(f"the independent scorer is not at {SCORER}: set TOSSLAB_DATA to the shared data")
    spec = importlib.util.spec_from_file_location("independent_scorer", SCORER)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def independent(scorer: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., dict]:
    """The other scorer's figures of what `toss-session export tum` writes."""

    def ask(folders: Folders, *options: str) -> dict:
        out = tmp_path / f"{len(list(tmp_path.iterdir()))}-tum"
        export("tum", folders.results, out)
        given = [str(folders.truth), str(out), "--json", str(out / "out.json"), *options]
        monkeypatch.setattr(sys, "argv", ["score.py", *given])
        assert scorer.main() == 0
        found: dict = json.loads((out / "out.json").read_text())
        return found

    return ask


def with_losses(rng: np.random.Generator, truth: np.ndarray) -> np.ndarray:
    """The truth with errors, another object frame, and losses: none, some frames, the first ones, or all."""
    noise = np.stack([near(rng, 0.03 * rng.random(), 0.02 * rng.random()) for _ in truth])
    estimate = truth @ noise @ near(rng, 0.3 * rng.integers(2), 0.02)
    kind = rng.integers(5)
    if kind == 0:
        estimate[rng.random(len(truth)) < 0.4] = np.nan
    elif kind == 1:
        estimate[: rng.integers(1, len(truth))] = np.nan
    elif kind == 2:
        estimate[:] = np.nan
    return estimate


@pytest.mark.parametrize("seed", range(20))
def test_on_random_tracks_with_random_losses_our_scores_are_the_independent_scorers(
    tmp_path: Path, independent: Callable[..., dict], seed: int
) -> None:
    """Ten tracks for each of the twenty seeds."""
    rng = np.random.default_rng([19, seed])
    truth = [true_poses(rng, int(rng.integers(2, 6))) for _ in range(10)]
    folders = written(tmp_path / "session", truth, [with_losses(rng, t) for t in truth], shared=True)
    ours, theirs = folders.score(), independent(folders)
    names = {"add_auc": "add_auc", "adds_auc": "adds_auc", "success_5deg_5cm": "success"}
    for own, other in names.items():
        assert ours.values[own].value == pytest.approx(theirs["total"][other], abs=1e-6)
        together = independent(folders, "--global-align")["total"][other]
        assert ours.values[f"global_{own}"].value == pytest.approx(together, abs=1e-6)
    for toss in ours.tosses:
        row = theirs["tosses"][f"toss_{toss.toss:02d}"]
        median = float(np.median(toss.errors.rotation_deg))
        assert median == pytest.approx(row["median_rot_deg"], abs=1e-4)
        assert len(toss.errors.add_m) == row["frames"]


def test_our_chamfer_distances_are_the_independent_scorers(tmp_path: Path, independent: Callable[..., dict]) -> None:
    rng = np.random.default_rng(3)
    truth = [true_poses(rng, 4) for _ in range(2)]
    estimate = [t @ near(rng, 0.02, 0.004) for t in truth]
    estimate[0][0] = np.nan  # the second toss places the shape
    folders = written(tmp_path / "session", truth, estimate, shape=True)
    mesh = trimesh.creation.box(BOX_M)
    mesh.export(tmp_path / "shape.obj")
    ours, theirs = folders.score().values, independent(folders, "--shape", str(tmp_path / "shape.obj"))["total"]
    assert ours["cd"].value == pytest.approx(theirs["cd_cm"], abs=1e-6)
    assert ours["cd_icp"].value == pytest.approx(theirs["cd_icp_cm"], abs=1e-3)


def test_a_floor_that_could_not_be_computed_is_said_of_its_toss(sample_session: Session, tmp_path: Path) -> None:
    mesh = tmp_path / "mesh.obj"
    trimesh.creation.box((0.1, 0.1, 0.1)).export(mesh)
    truth = Truth(tmp_path, sample_session.calibration, mesh)  # it knows the shape and no pose
    record = VariantRecord(
        "ours", "one", "ours", "sample", "box", sample_session.calibration, (TossRecord(0, "track", "shape", "masks"),)
    )
    run = start_run(sample_session, [0], tmp_path / "results", Config(), "multi-hypothesis", lambda label: Silent())
    values, warnings = coverage_floor(run, {0: sample_session.toss(0).rgbd("d455")}, record, truth)
    assert values == {}
    assert warnings == (
        "toss 0: what its frames show of the shape (floor) is not known: the truth has no pose of its frames",
    )
