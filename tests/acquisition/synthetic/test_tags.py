"""AprilTags are drawn where truth says: found by pupil-apriltags in rendered images, corners within 0.3 px."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import dataclass

import cv2
import numpy as np
import pytest

from acquisition.synthetic.board import board_pose, board_tags
from acquisition.synthetic.objects import textures
from acquisition.synthetic.render.rays import Placed

pytest.importorskip("pupil_apriltags")
PUPIL_SHIFT_PX = 0.5
"""pupil-apriltags' pixel centres lie at half integers, OpenCV's at integers."""


# Speaks before it lets the detector go, and leaves without tidying up.
DETECT = """
import json, os, sys
import numpy as np
from pupil_apriltags import Detector
found = Detector(families="tag36h11", quad_decimate=1.0).detect
image = np.load(sys.argv[1])
print(json.dumps([[t.tag_id, t.hamming, t.corners.tolist()] for t in found(image)]), flush=True)
os._exit(0)
"""


@dataclass(frozen=True)
class Found:
    tag_id: int
    hamming: int
    corners: np.ndarray


class ApartDetector:
    """pupil-apriltags in a process of its own: it corrupts the heap on busy images, and ours would die of it later."""

    def __init__(self, scratch):
        self._path = scratch / "image.npy"

    def detect(self, image):
        np.save(self._path, image)
        done = subprocess.run([sys.executable, "-c", DETECT, self._path], capture_output=True, text=True, check=True)
        return [Found(tag_id, hamming, np.array(corners)) for tag_id, hamming, corners in json.loads(done.stdout)]


@pytest.fixture
def detector(tmp_path):
    return ApartDetector(tmp_path)


def corner_errors(found, camera, tags):
    """Detected minus projected corners of every known tag: {tag id: (4, 2)}. `tags`: id -> (size, camera_from_tag)."""
    errors = {}
    for tag in found:
        if tag.hamming == 0 and tag.tag_id in tags:
            size_m, camera_from_tag = tags[tag.tag_id]
            square = 0.5 * size_m * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
            errors[tag.tag_id] = tag.corners - PUPIL_SHIFT_PX - camera.project(camera_from_tag.points(square))
    return errors


def object_tags(lab, view, motion, time_s):
    camera_from_object = view.camera_from_world @ motion.object.at(time_s)
    return {t.tag_id: (t.size_m, camera_from_object @ t.object_from_tag) for t in lab.object_tags}


def test_a_drawn_tag_is_read_upright(detector):
    picture = np.full((200, 200, 3), textures.WHITE, np.float32)
    textures.paint_tag(picture, 7, np.array([100.25, 99.5]), 120.0)
    (tag,) = detector.detect((255 * picture[..., 0]).astype(np.uint8))
    assert tag.tag_id == 7
    # x right, y down: pupil's first corner is (-, +), the lower left one; continuous pixels, as pupil counts them
    expected = np.array([100.25, 99.5]) + 60.0 * np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]])
    # pupil fits lines along pixel rows less well than tilted ones: a third of a pixel here, see the other tests
    np.testing.assert_allclose(tag.corners, expected, atol=0.35)


def test_tags_on_the_object_and_the_table_are_where_truth_says_in_the_mono_cameras(lab, motion, detector):
    time_s = motion.instants.first_impact_s - 0.03
    every = []
    for number, view in enumerate(lab.mono_views):
        tags = object_tags(lab, view, motion, time_s)
        tags |= {t.tag_id: (t.size_m, view.camera_from_world @ t.world_from_tag) for t in lab.table_tags}
        errors = corner_errors(detector.detect(lab.mono(number, motion, time_s, 0)), view.camera, tags)
        assert len(errors) >= 3
        every += list(errors.values())
    # 0.08-0.11 px is what the reference rendering of cube_dev has
    assert np.sqrt(np.mean(np.square(np.concatenate(every)))) < 0.2
    assert np.median(np.linalg.norm(np.concatenate(every), axis=1)) < 0.15


def test_tags_are_readable_in_the_colour_image(lab, motion, detector):
    time_s = motion.instants.rest_s + 0.1
    grey = cv2.cvtColor(lab.color(motion, time_s, 0), cv2.COLOR_RGB2GRAY)
    errors = corner_errors(detector.detect(grey), lab.d455.camera, object_tags(lab, lab.d455, motion, time_s))
    assert errors
    # sRGB makes black squares smaller by about a third of a pixel at each side
    assert np.sqrt(np.mean(np.square(np.concatenate(list(errors.values()))))) < 0.5


def test_the_calibration_board_is_where_truth_says(lab, detector):
    world_from_board = board_pose(np.random.default_rng(3))
    _, depth, monos = lab.board_view(0, world_from_board)
    found = 0
    for view, image in zip(lab.mono_views, monos):
        camera_from_board = view.camera_from_world @ world_from_board
        tags = {t.tag_id: (t.size_m, camera_from_board @ t.world_from_tag) for t in board_tags()}
        errors = corner_errors(detector.detect(image), view.camera, tags)
        found += len(errors)
        if errors:
            assert np.sqrt(np.mean(np.square(np.concatenate(list(errors.values()))))) < 0.2
    assert found >= 20
    assert (depth > 0).mean() > 0.5


def test_without_motion_the_tag_stays_where_it_is_painted(lab, detector):
    """The object straight in front of a mono camera: the corners to a tenth of a pixel."""
    view = lab.mono_views[0]
    tag = lab.object_tags[0]
    away = view.world_from_camera.points(np.array([0.0, 0.0, 0.5]))
    camera_from_tag_rotation = cv2.Rodrigues(np.array([0.2, -0.25, 0.1]))[0]
    rotation = view.world_from_camera.rotation @ camera_from_tag_rotation @ tag.object_from_tag.rotation.T
    from recordings.geometry import Transform

    world_from_object = Transform("world", "object", rotation, away - rotation @ tag.object_from_tag.translation_m)
    image = lab._mono(0, lambda t: [Placed(lab.object, world_from_object)], 0.0, np.random.default_rng(0))
    tags = {tag.tag_id: (tag.size_m, view.camera_from_world @ world_from_object @ tag.object_from_tag)}
    errors = corner_errors(detector.detect(image), view.camera, tags)
    assert np.abs(errors[tag.tag_id]).max() < 0.2
