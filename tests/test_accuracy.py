"""A suite that judges: tracking against figures on recordings whose truth is known, and what the demo must reach.

The whole cycle on the shipped sample is judged by `make demo` (CI runs it on a fresh clone) with tools/judge_demo.py,
whose judgement is tested here; the slow test runs it anew.
"""

import importlib
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh

from processing.config import Config
from processing.images import raw_images
from processing.pipeline.start import start_run
from processing.stages.masks.find import find_object
from processing.stages.masks.segment import segment
from processing.stages.recording.rig import refine_rig
from processing.stages.recording.scene import learn_static_scene
from processing.stages.track import track as track_toss
from recordings.importers.folder import import_folder
from recordings.progress import Silent
from recordings.results.folder import read_track
from recordings.session import Session

ROOT = Path(__file__).resolve().parent.parent
ADD_LIMIT_M = 0.1
TRACKED = {"photo_dev/truck": 97.0, "lab_dev": 98.5}
"""ADD in %, of the poses of toss 0 tracked alone: some way below what was seen when this was written (97.99, 99.14)."""


def add_auc(camera_from_object, camera_from_true, points_m):
    """The area under the accuracy curve of ADD up to 10 cm, in %, aligned at frame 0; a lost frame counts as missed."""
    object_from_true = np.linalg.inv(camera_from_object[0]) @ camera_from_true[0]
    ends = [
        poses[:, :3, :3] @ points_m.T + poses[:, :3, 3:]
        for poses in (camera_from_object @ object_from_true, camera_from_true)
    ]
    error_m = np.linalg.norm(ends[0] - ends[1], axis=1).mean(axis=1)
    return 100 * np.clip(1 - np.nan_to_num(error_m, nan=np.inf) / ADD_LIMIT_M, 0, 1).mean()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["photo_dev/truck", "lab_dev"])
def test_one_toss_of_a_known_object_is_tracked_as_well_as_its_figure(name, data, tmp_path):
    truth = data(name.replace("_dev", "_dev_truth"))
    import_folder(data(name), tmp_path / "session")
    with Session.open(tmp_path / "session") as session:
        run = start_run(session, [0], tmp_path / "results", Config(), "multi-hypothesis", lambda _: Silent())
        scene = learn_static_scene(run)
        rig = refine_rig(run, scene)
        masks = segment(run, 0, scene, rig, find_object(run, scene, rig))
        done = track_toss(run, raw_images(run, 0, rig, masks))
    track = read_track(done.folder, 0)
    true = np.load(truth / "toss_00" / "poses_camera_object.npz")["T_camera_object"]
    points_m = trimesh.load_mesh(truth / "mesh.obj").vertices
    assert np.isfinite(track.camera_from_object[0]).all(), "the first frame is lost"
    assert add_auc(track.camera_from_object, true, points_m) >= TRACKED[name]


@pytest.fixture
def judge_demo(monkeypatch):
    """tools/judge_demo.py, which nothing imports otherwise."""
    monkeypatch.syspath_prepend(ROOT / "tools")
    return importlib.import_module("judge_demo")


@pytest.fixture
def results(tmp_path):
    """Results like the demo's, made by hand: `results(add_auc=98)` with that value, None for none at all."""

    def make(kept_out=None, drawn="contact's key", contact=True, **changed):
        values = {"add_auc": 99.6, "cd": 0.022, "friction_error": -0.02} | changed
        row = {
            "variant": "ours",
            "scope": "all",
            "values": {k: {"value": v} for k, v in values.items() if v is not None},
        }
        (tmp_path / "table.json").write_text(json.dumps({"rows": [row]}))
        record = {"shape": "field-1", "contact": "contact-1" if contact else None}
        counts = {"kept_out": kept_out} if kept_out else {"friction": 0.2}
        for name, document in {
            "variants/ours.all.json": record,
            "contact-1/stage.json": {"key": "contact's key", "inputs": {}, "counts": counts},
            "field-1/stage.json": {"key": "field's key", "inputs": {"shape": drawn}, "counts": {}},
        }.items():
            (tmp_path / name).parent.mkdir(exist_ok=True)
            (tmp_path / name).write_text(json.dumps(document))
        return tmp_path

    return make


def test_results_that_reach_every_figure_pass(judge_demo, results):
    assert list(judge_demo.faults(results())) == []


@pytest.mark.parametrize(
    "change",
    [
        {"add_auc": 98.9},
        {"add_auc": float("nan")},
        {"cd": 0.031},
        {"cd": None},
        {"friction_error": 0.051},
        {"friction_error": -0.051},
        {"friction_error": None},
        {"kept_out": "no contact seen"},
        {"drawn": "the key of vision's own shape"},
        {"contact": False},
    ],
    ids=str,
)
def test_one_figure_that_is_missed_is_one_fault(judge_demo, results, change):
    assert len(list(judge_demo.faults(results(**change)))) == 1


def test_the_demo_ends_with_the_judgement():
    recipe = (ROOT / "Makefile").read_text().split("\ndemo:")[1].split("\n\n")[0]
    assert recipe.index("toss-process $(SAMPLE)") < recipe.index("tools/judge_demo.py $(OUT)/results")


@pytest.mark.slow
def test_the_shipped_sample_reaches_every_figure(judge_demo, sample_path, tmp_path):
    from processing.cli import main

    shutil.copytree(sample_path, tmp_path / "sample")
    assert main([str(tmp_path / "sample"), "--out", str(tmp_path / "results")]) == 0
    assert list(judge_demo.faults(tmp_path / "results")) == []
