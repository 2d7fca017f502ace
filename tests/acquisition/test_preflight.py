"""What the pre-flight says of tags where the detector itself fails."""

from __future__ import annotations

from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from acquisition import preflight
from acquisition.streaming.recorder import Recorder
from calibration.tags.detect import DetectorChild, DetectorDied
from recordings.tracks import RigCalibration


def test_a_picture_on_which_the_tag_detector_dies_is_said_to_be_so(monkeypatch: pytest.MonkeyPatch) -> None:
    detect = DetectorChild.detect

    def dies_on_bright(self: DetectorChild, picture: Any) -> Any:
        if picture.mean() > 128:
            raise DetectorDied("gone")
        return detect(self, picture)

    monkeypatch.setattr(DetectorChild, "detect", dies_on_bright)
    pictures = {"/mono0/image": Mock(pixels=np.full((120, 160), 200, np.uint8)),
                "/mono1/image": Mock(pixels=np.full((120, 160), 50, np.uint8))}  # fmt: skip
    recorder = Mock(spec=Recorder, latest=pictures)
    rows = {
        r.subject: r
        for r in preflight.tags(recorder, Mock(spec=RigCalibration, tag_family="tag36h11", table_tags=(), cameras={}))
    }
    assert rows["mono0"].state == rows["mono1"].state == "warning"
    assert "detector died" in rows["mono0"].found
    assert rows["mono1"].found == "0 seen, 0 of the table"
