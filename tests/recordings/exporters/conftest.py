"""Results of a small session, as the pipeline writes them."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from recordings.geometry import rotation_exp
from recordings.results.folder import TossRecord, VariantRecord, write_masks, write_shape, write_track, write_variant
from recordings.session import Session
from recordings.tracks import ObjectShape, ObjectTrack

LOST_FRAME = 2


def make_track(session: Session, toss: int) -> ObjectTrack:
    times_ns = session.toss(toss).color().times_ns
    poses = np.tile(np.eye(4), (len(times_ns), 1, 1))
    for i in range(len(times_ns)):
        poses[i, :3, :3] = rotation_exp(np.array([0.1 * i, -0.7, 3.0]))
        poses[i, :3, 3] = [0.01 * i, -1 / 3, 0.7 + toss]
    poses[LOST_FRAME] = np.nan
    status = ["tracked"] * len(times_ns)
    status[LOST_FRAME], status[3] = "lost", "interpolated"
    return ObjectTrack(toss, "d455", "object", times_ns, poses, tuple(status), np.full((len(times_ns), 6, 6), np.nan))


def make_shape(size_m: float) -> ObjectShape:
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]) * size_m
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    return ObjectShape("object", "a test", corners, faces, np.full((4, 3), 200, dtype=np.uint8))


MakeResults = Callable[..., Path]


@pytest.fixture
def make_results(tmp_path: Path, write_session: Callable[..., Path]) -> MakeResults:
    """`make_results(scope)` records two tosses and writes results of them; gives the results folder."""

    def make(scope: str = "all", name: str = "bundlesdf-1") -> Path:
        path = tmp_path / "small"
        if not path.exists():
            write_session(tosses=2)
        results, stage = path / "results", path / "results" / f"track-{scope}{name}"
        stage.mkdir(parents=True)
        session = Session.open(path)
        for toss in session.tosses:
            track = make_track(session, toss)
            write_track(stage, track)
            masks = [np.arange(64 * 48).reshape(48, 64) % (i + 2) == 0 for i in range(len(track.status))]
            write_masks(stage, toss, masks, np.ones(len(masks)))
            if scope == "one":
                own = stage.with_name(f"{stage.name}-{toss}")
                own.mkdir()
                write_shape(own, make_shape(0.1 * (toss + 1)))
        write_shape(stage, make_shape(0.1))
        tosses = tuple(
            TossRecord(t, stage.name, f"{stage.name}-{t}" if scope == "one" else None, stage.name)
            for t in session.tosses
        )
        write_variant(
            results,
            VariantRecord(
                name,
                scope,
                "a label",
                "small",
                "cube",
                session.calibration,
                tosses,  # type: ignore[arg-type]
                shape=stage.name if scope == "all" else None,
                session_path=os.path.relpath(path, results),
                shared_object_frame=True,
            ),
        )
        session.close()
        return results

    return make
