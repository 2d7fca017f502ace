"""`toss-process` as a user meets it: from a session to the table, stopped and resumed, and refused in plain words."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from processing.cli import config_of, main
from processing.field.learn import LearnConfig
from processing.field.train import FieldConfig
from processing.stages import track as track_stage
from recordings.console import chosen_tosses
from recordings.errors import BadInput
from recordings.results.folder import Results

Record = Callable[..., Path]


@pytest.fixture(autouse=True)
def quick_field(monkeypatch: pytest.MonkeyPatch) -> None:
    """These tests are about what the command does: the field learns for a few steps only."""
    few = LearnConfig(field=FieldConfig(steps=10, rays=256, pose_rounds=0))
    monkeypatch.setattr("processing.cli.config_of", lambda args: replace(config_of(args), shape=few))


def answers(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    """What the command says; its first row where the arguments name none."""
    given = [str(a) for a in arguments]
    code = main([*given, *([] if "--variant" in given else ["--variant", "bundlesdf-1"])])
    out, err = capsys.readouterr()
    return code, out, err


def output_bytes(results: Path) -> dict[str, bytes]:
    """Every byte of tracks, shapes and masks."""
    return {
        str(p.relative_to(results)): p.read_bytes()
        for p in sorted(results.rglob("*"))
        if p.suffix in (".npz", ".ply", ".png") and p.is_file()
    }


@pytest.mark.parametrize("asked", [[], ["sample"]])
def test_the_sample_by_name_leaves_its_results_where_one_works_not_among_the_installed_files(
    asked: list[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    class Came(BaseException):  # the command turns an Exception into words
        pass

    def vision(args: object, engine: object, session: object, name: str, out: Path) -> None:
        raise Came(out.resolve())

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("processing.cli._vision", vision)
    with pytest.raises(Came, match=re.escape(str(tmp_path / "box_toss_results"))):
        main(asked)
    with pytest.raises(Came, match=re.escape(str(tmp_path / "elsewhere"))):
        main([*asked, "--out", "elsewhere"])


def test_a_results_folder_that_cannot_be_made_is_one_message_with_what_to_type(
    sample_path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("no folder")
    code, _, said = answers(capsys, sample_path, "--out", tmp_path / "file" / "results")
    assert code == 2
    assert "--out DIR" in said
    assert "Traceback" not in said


def test_help_answers_at_once_with_a_copyable_example() -> None:
    code = (
        "import time; t = time.process_time(); from processing.cli import main; "
        "main(['--help']); print(time.process_time() - t)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "toss-process sessions/cube --out" in done.stdout
    assert float(done.stdout.splitlines()[-1]) < 0.5


def test_a_session_becomes_tracks_a_shape_a_table_and_a_report(
    record_tiny: Record, capsys: pytest.CaptureFixture[str]
) -> None:
    session = record_tiny()
    code, out, err = answers(capsys, session, "--variant", "bundlesdf-10")
    assert code == 0, err
    assert "bundlesdf-10" in out
    results = Results.open(session)
    assert results.variants() == (("bundlesdf-10", "all"),)
    assert sorted(results.tracks()) == [0, 1]
    assert all(not t.lost.any() for t in results.tracks().values())
    assert len(results.shape().faces) > 100
    assert len(results.masks(toss=1)) == 8
    assert results.session_path() == session
    page = (session / "results" / "report.html").read_text()
    assert "data:image/jpeg;base64," in page
    assert "http://" not in page
    assert "https://" not in page
    assert "no ground truth" in (session / "results" / "table.md").read_text()


def test_json_is_one_object_and_the_rest_goes_to_stderr(
    record_tiny: Record, capsys: pytest.CaptureFixture[str]
) -> None:
    session = record_tiny(tosses=(0,))
    code, out, _ = answers(capsys, session, "--json")
    document = json.loads(out)
    assert code == 0
    assert document["session"] == "tiny"
    assert document["rows"][0]["per_toss"][0]["tracked"] == 8


@pytest.mark.slow
def test_both_layouts_of_the_truth_give_the_same_scores(
    tiny_world: Any, record_tiny: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session = record_tiny()
    folder = tiny_world.truth_folder(tmp_path / "tiny_truth")
    _, by_folder, _ = answers(capsys, session, "--truth", folder, "--json")
    tiny_world.add_truth(session)
    _, by_session, _ = answers(capsys, session, "--json")
    first, second = (json.loads(text)["rows"][0] for text in (by_folder, by_session))
    assert first["values"]["add_auc"]["value"] > 90
    assert first["values"]["success_5deg_5cm"]["value"] == 100
    assert first["values"]["add_auc"]["unit"] == "%"
    assert first["values"]["add_auc"]["n"] == 16
    assert "first frame" in first["values"]["add_auc"]["aligned"]
    for name, value in first["values"].items():
        assert second["values"][name]["value"] == pytest.approx(value["value"], abs=1e-3), name
    assert first["paper"] is None  # the paper's figures are of each toss alone


def test_tracks_and_shapes_are_the_same_bytes_with_and_without_truth(
    tiny_world: Any, record_tiny: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session = record_tiny()
    folder = tiny_world.truth_folder(tmp_path / "tiny_truth")
    answers(capsys, session, "--out", tmp_path / "without")
    answers(capsys, session, "--out", tmp_path / "with", "--truth", folder)
    assert output_bytes(tmp_path / "without") == output_bytes(tmp_path / "with")
    assert len(output_bytes(tmp_path / "with")) > 16


def test_the_truth_is_opened_after_every_track_is_written(
    tiny_world: Any, record_tiny: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: Any
) -> None:
    from processing.evaluate import truth

    session, out = record_tiny(tosses=(0,)), tmp_path / "out"
    opened = []
    real = truth.open_truth

    def watched(*arguments: Any) -> Any:
        opened.append(sorted(p.name.split("-")[0] for p in out.iterdir()))
        return real(*arguments)

    monkeypatch.setattr(truth, "open_truth", watched)
    answers(capsys, session, "--out", out, "--truth", tiny_world.truth_folder(tmp_path / "t", tosses=(0,)))
    assert len(opened) == 1
    assert {"field", "scene", "segment", "track", "variants"} <= set(opened[0])


def test_an_interrupted_run_keeps_everything_and_resumes_to_the_same_bytes(
    record_tiny: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: Any
) -> None:
    session = record_tiny()
    answers(capsys, session, "--out", tmp_path / "whole")
    real = track_stage.track_toss

    def stopped_at_toss_1(*rest: Any, toss: int, **more: Any) -> Any:
        if toss == 1:
            raise KeyboardInterrupt
        return real(*rest, toss=toss, **more)

    monkeypatch.setattr(track_stage, "track_toss", stopped_at_toss_1)
    code, _, err = answers(capsys, session, "--out", tmp_path / "resumed")
    assert code == 130
    assert "everything so far is kept" in err
    assert len(list((tmp_path / "resumed").glob("track-*"))) == 1
    assert not list((tmp_path / "resumed").glob("*.partial"))
    monkeypatch.setattr(track_stage, "track_toss", real)
    kept = {p: p.stat().st_mtime_ns for p in (tmp_path / "resumed").glob("*/stage.json")}
    assert answers(capsys, session, "--out", tmp_path / "resumed")[0] == 0
    assert all(p.stat().st_mtime_ns == t for p, t in kept.items())
    assert output_bytes(tmp_path / "resumed") == output_bytes(tmp_path / "whole")


@pytest.mark.slow  # fast siblings: an interrupted run (below), a killed worker and a killed run (test_engine)
def test_a_run_killed_in_the_middle_resumes_to_the_same_table(record_tiny: Record, tmp_path: Path) -> None:
    session = record_tiny(frames=10)
    code = "import sys; from processing.cli import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, str(session), "--variant", "bundlesdf-1", "--out"]
    run = subprocess.Popen([*command, str(tmp_path / "killed")], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    for _ in range(600):
        if list((tmp_path / "killed").glob("segment-*")):
            break
        time.sleep(0.05)
    run.kill()
    run.wait()
    for name in ("killed", "whole"):
        subprocess.run([*command, str(tmp_path / name)], check=True, stdout=subprocess.DEVNULL)
    assert output_bytes(tmp_path / "killed") == output_bytes(tmp_path / "whole")
    assert (tmp_path / "killed" / "table.json").read_text() == (tmp_path / "whole" / "table.json").read_text()


@pytest.mark.slow
def test_two_runs_at_once_on_one_results_folder_both_finish(record_tiny: Record, tmp_path: Path) -> None:
    session, out = record_tiny(tosses=(0,), frames=5), tmp_path / "out"
    code = "import sys; from processing.cli import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, str(session), "--variant", "bundlesdf-1", "--jobs", "1", "--out", str(out)]
    runs = [subprocess.Popen(command, stdout=subprocess.DEVNULL) for _ in range(2)]
    assert [run.wait(timeout=300) for run in runs] == [0, 0]
    assert len(list(out.glob("track-*"))) == 1
    assert not [p.name for p in out.rglob("*") if p.suffix in (".partial", ".lock")]


def test_only_the_chosen_tosses_are_processed(record_tiny: Record, capsys: pytest.CaptureFixture[str]) -> None:
    session = record_tiny(tosses=(0, 3))
    answers(capsys, session, "--toss", "3")
    assert list(Results.open(session).tracks()) == [3]
    assert Results.open(session).shape().object_frame == "object_toss_03"


def test_the_baseline_gives_its_own_row(record_tiny: Record, capsys: pytest.CaptureFixture[str]) -> None:
    session = record_tiny()
    assert answers(capsys, session, "--tracker", "frame-to-model")[0] == 0
    assert Results.open(session).variants() == (("bundlesdf-1", "all"),)
    assert Results.open(session).shape().object_frame == "object_toss_00"
    code, _, err = answers(capsys, session, "--tracker", "frame-to-model", "--variant", "bundlesdf-10")
    assert code == 2
    assert "no registration between tosses" in err


@pytest.mark.slow
def test_scope_one_gives_every_toss_its_own_shape(record_tiny: Record, capsys: pytest.CaptureFixture[str]) -> None:
    session = record_tiny()
    answers(capsys, session, "--scope", "one", "--variant", "bundlesdf-1")
    results = Results.open(session)
    assert results.variants() == (("bundlesdf-1", "one"),)
    frames = [results.shape(toss=t).object_frame for t in (0, 1)]
    assert frames == ["object_toss_00", "object_toss_01"]
    with pytest.raises(BadInput, match="each toss has its own"):
        results.shape()


def test_one_mask_for_the_first_toss_is_enough(
    tiny_world: Any, record_tiny: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session = record_tiny(first_mask=False)
    code, out, _ = answers(capsys, session, "--truth", tiny_world.truth_folder(tmp_path / "t"), "--json")
    assert code == 0
    assert json.loads(out)["rows"][0]["values"]["success_5deg_5cm"]["value"] > 90


def test_a_single_mcap_file_is_processed(
    record_tiny: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = record_tiny() / "toss_01.mcap"
    assert answers(capsys, file, "--out", tmp_path / "out")[0] == 0
    assert list(Results.open(tmp_path / "out").tracks()) == [1]


def test_of_several_sessions_one_that_fails_does_not_stop_the_others(
    record_tiny: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good, missing = record_tiny("good", tosses=(0,), frames=5), tmp_path / "missing"
    code, out, _ = answers(capsys, missing, good, "--out", tmp_path / "out", "--tracker", "frame-to-model")
    assert code == 2
    assert "missing does not exist" in out
    assert "| good | bundlesdf-1 | 1 | 0 |" in out
    assert Results.open(tmp_path / "out" / "good").variants()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--variant", "joint", "--scope", "one"], "joint exists over all tosses only"),
        (["--variant", "bundlesdf"], "no variant 'bundlesdf'"),
        (["--tracker", "icp"], "no tracker 'icp'; available: multi-hypothesis, frame-to-model"),
        (["--toss", "7"], "the session has the tosses 0, 1"),
        (["--toss", "1-"], "wanted a toss number or a range"),
        (["--scope", "both"], "invalid choice: 'both'"),
        (["--truth", "nowhere"], "nowhere is no truth: wanted a folder"),
        (["--device", "cuda"], "no CUDA device here"),
    ],
)
def test_bad_usage_is_refused_in_plain_words(
    record_tiny: Record, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    import re

    code, out, err = answers(capsys, record_tiny(frames=3), *arguments)
    assert code == 2
    assert out == ""
    assert re.search(message, err)
    assert "Traceback" not in err


def test_bad_input_is_refused_and_nothing_is_overwritten(
    record_tiny: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "empty").mkdir()
    assert answers(capsys, tmp_path / "empty")[0] == 2
    (tmp_path / "file.mcap").write_bytes(b"")
    code, _, err = answers(capsys, tmp_path / "file.mcap")
    assert code == 2
    assert "Traceback" not in err


def test_ranges_of_tosses() -> None:
    assert chosen_tosses(None, [0, 2, 5], "--toss") == [0, 2, 5]
    assert chosen_tosses("2", [0, 2, 5], "--toss") == [2]
    assert chosen_tosses("1-5", [0, 2, 5], "--toss") == [2, 5]


def test_masks_of_a_session_reach_the_truth(tiny_world: Any, record_tiny: Record, capsys: Any) -> None:
    session = record_tiny(tosses=(0,))
    answers(capsys, session)
    found = Results.open(session).masks(toss=0)
    for i, pose in enumerate(tiny_world.poses(8)):
        truth = tiny_world.see(pose, i)[1]
        assert (found[i] & truth).sum() / (found[i] | truth).sum() > 0.9
    assert np.all(found.confidence > 0.7)
