"""Tags: corners against known ones, blurred and not, children that die, caches, other families, mirrored pictures."""

from __future__ import annotations

import os
import re
import signal
import time

import cv2
import numpy as np
import pytest
from synthetic.infrared_dots import corner_noise_px, dots_advice, with_infrared_dots

from calibration.tags import detect as tags_module
from calibration.tags.detect import DetectorChild, DetectorDied, detect_tags
from calibration.tags.faults import explain_absence
from recordings.errors import BadInput

FAMILY = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
SQUARE = 0.5 * np.array([[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]])


def drawn(tag_id, side, seed, blur_px=0.0, noise=2.0, family=FAMILY, spill_px=0.0):
    """A tag turned and tilted anyhow, drawn six times too large and averaged; and where its corners are (the detector's
    order, OpenCV's pixels)."""
    rng, scale = np.random.default_rng(seed), 6
    size = int(3 * side + 40)
    marker = cv2.aruco.generateImageMarker(family, tag_id, 256)[::-1, ::-1]  # OpenCV's is turned by half against it
    texture = np.full((400, 400), 230, np.float32)
    texture[72:328, 72:328] = 20 + 210 * (marker > 127)
    angle, bend = rng.uniform(0, 2 * np.pi), rng.uniform(0, np.pi)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    across = np.array([[np.cos(bend), -np.sin(bend)], [np.sin(bend), np.cos(bend)]])
    corners = side * SQUARE @ (across @ np.diag([1, rng.uniform(0.6, 1)]) @ turn).T + size / 2 + rng.uniform(-1, 1, 2)
    way = blur_px * np.array([np.cos(bend), np.sin(bend)])
    total, steps = np.zeros((size * scale, size * scale), np.float32), max(1, int(3 * blur_px) + 1)
    source = (256 * SQUARE + 199.5).astype(np.float32)
    for share in (np.arange(steps) + 0.5) / steps - 0.5:
        target = ((corners + share * way + 0.5) * scale - 0.5).astype(np.float32)
        total += cv2.warpPerspective(
            texture, cv2.getPerspectiveTransform(source, target), total.shape, borderValue=120.0, flags=cv2.INTER_AREA
        )
    if spill_px:
        total = cv2.dilate(total, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * round(spill_px * scale) + 1,) * 2))
    image = cv2.GaussianBlur(total.reshape(size, scale, size, scale).mean(axis=(1, 3)) / steps, (0, 0), 0.5)
    return np.clip(np.rint(image + rng.normal(0, noise, image.shape)), 0, 255).astype(np.uint8), corners


def errors(cases, **options):
    """Corner errors and covariances of tags that are alone in their pictures."""
    lists = detect_tags([image for image, _ in cases], jobs=1, **options)
    pairs = [(found[0], corners) for found, (_, corners) in zip(lists, cases) if len(found) == 1]
    return np.array([t.corners_px - c for t, c in pairs]), np.array([t.covariance_px2 for t, _ in pairs])


def test_corners_are_exact_in_opencvs_pixels():
    gaps, _ = errors([drawn(k, 40.0, k) for k in range(15)])
    assert len(gaps) == 15
    np.testing.assert_allclose(gaps.mean(axis=(0, 1)), 0, atol=0.02)
    assert np.sqrt((gaps**2).mean()) < 0.05


def test_covariances_say_how_far_corners_are_off_in_noisy_pictures():
    gaps, covariance = errors([drawn(k, 40.0, k, noise=20.0) for k in range(25)])
    squares = np.einsum("tki,tkij,tkj->tk", gaps, np.linalg.inv(covariance), gaps) / 2
    assert 0.5 < squares.mean() < 1.6


def flat(cases):
    """The same tags, so tilted that their cells are less than two pixels wide one way."""
    out = []
    for image, corners in cases:
        squeeze = np.array([[1.0, 0, 0], [0, 0.55, 0.45 * corners[:, 1].mean()]])
        tilted = cv2.warpAffine(image, squeeze, image.shape[::-1], flags=cv2.INTER_AREA)
        out.append((tilted, corners @ squeeze[:, :2].T + squeeze[:, 2]))
    return out


def test_the_whole_pattern_tells_corners_where_cells_are_small_and_where_light_spills():
    cases = flat([drawn(k, 26.0, k, noise=3.0) for k in range(12)])
    outline, whole = (errors(cases, refinement=way)[0] for way in ("edges", "pattern"))
    assert np.sqrt((whole**2).mean()) < 0.06
    assert np.sqrt((whole**2).mean()) < 0.7 * np.sqrt((outline**2).mean())
    spilled = [drawn(k, 60.0, k, spill_px=0.35, noise=3.0) for k in range(6)]
    outline, whole = (errors(spilled, refinement=way)[0] for way in ("edges", "pattern"))
    assert np.sqrt((whole**2).mean()) < 0.08 < 0.3 < np.sqrt((outline**2).mean())


def test_a_tag_that_fills_the_picture_is_fitted_too():
    gaps, _ = errors([drawn(3, 320.0, 3)], refinement="pattern")
    assert len(gaps) == 1
    assert np.sqrt((gaps**2).mean()) < 0.1


@pytest.mark.slow
def test_fitted_edges_beat_the_detector_in_sharp_and_in_blurred_pictures():
    child = DetectorChild("tag36h11", 1.0)
    for blur_px in (0.0, 2.0, 4.0):
        cases = [drawn(k, 60.0, k, blur_px) for k in range(15)]
        plain = np.array([child.detect(image)[0, 3:].reshape(4, 2) - 0.5 - corners for image, corners in cases])
        ours, _ = errors(cases)
        assert np.sqrt((ours**2).mean()) < (0.6 if blur_px < 3 else 1.1) * np.sqrt((plain**2).mean()), blur_px
    child.close()


def test_srgb_pictures_are_fitted_in_linear_light():
    cases = [drawn(k, 40.0, k, noise=0.5) for k in range(8)]
    light = np.arange(256) / 255
    table = np.rint(255 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)).astype(
        np.uint8
    )
    encoded = [(table[image], corners) for image, corners in cases]
    right, wrong = (errors(encoded, response=r)[0] for r in ("srgb", "linear"))
    assert np.sqrt((right**2).mean()) < 0.5 * np.sqrt((wrong**2).mean())


def test_a_dead_child_is_replaced_and_the_image_tried_again(monkeypatch):
    image, corners = drawn(3, 40.0, 1)
    started = []
    original = DetectorChild.detect

    def dies_once(self, picture):
        started.append(self)
        if len(started) == 1:
            os.kill(self._process.pid, signal.SIGSEGV)
            time.sleep(0.05)
        return original(self, picture)

    monkeypatch.setattr(DetectorChild, "detect", dies_once)
    lists = detect_tags([image], jobs=1)
    assert len(started) == 2
    assert started[0] is not started[1]
    assert lists.lost == ()
    np.testing.assert_allclose(lists[0][0].corners_px, corners, atol=0.3)


def test_an_image_that_kills_twice_is_counted_and_left_empty(monkeypatch):
    def dies(self, picture):
        raise DetectorDied("gone")

    monkeypatch.setattr(DetectorChild, "detect", dies)
    lists = detect_tags([drawn(3, 40.0, 1)[0]], jobs=1)
    assert lists == [[]]
    assert lists.lost == (0,)


def test_found_tags_come_from_the_cache_and_a_damaged_cache_is_made_anew(tmp_path, monkeypatch):
    images = [drawn(k, 40.0, k)[0] for k in range(2)]
    first = detect_tags(images, cache=tmp_path, jobs=1)
    (kept,) = tmp_path.glob("*.npz")
    with monkeypatch.context() as patched:
        patched.setattr(tags_module.DetectorChild, "detect", None)
        again = detect_tags(images, cache=tmp_path, jobs=1)
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a[0].corners_px, b[0].corners_px)
        np.testing.assert_array_equal(a[0].covariance_px2, b[0].covariance_px2)
    kept.write_bytes(b"PK\x03\x04 nothing")
    assert len(detect_tags(images, cache=tmp_path, jobs=1)[1]) == 1


@pytest.mark.slow
def test_a_wrong_family_and_mirrored_pictures_are_named():
    other = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_25h9)
    foreign = [drawn(k, 60.0, k, family=other)[0] for k in range(3)]
    assert "tag25h9" in explain_absence(foreign, "tag36h11")
    mirrored = [np.ascontiguousarray(drawn(k, 60.0, k)[0][:, ::-1]) for k in range(3)]
    assert "mirrored" in explain_absence(mirrored, "tag36h11")
    assert "no tags of any family" in explain_absence([np.full((120, 160), 90, np.uint8)] * 3, "tag36h11")


def test_what_is_no_grey_picture_or_no_family_is_refused():
    with pytest.raises(BadInput, match="grey"):
        detect_tags(iter([np.zeros((10, 10, 3), np.uint8)]))
    with pytest.raises(BadInput, match="tag99"):
        detect_tags([], family="tag99")


def test_faint_infrared_dots_do_no_harm_and_strong_ones_are_named():
    image, rng = (0.6 * drawn(7, 60.0, 2)[0]).astype(np.uint8), np.random.default_rng(0)
    without = detect_tags([image] * 2, jobs=1)
    faint = detect_tags([with_infrared_dots(image, 0.15, 12.0, rng) for _ in range(5)], jobs=1)
    assert corner_noise_px(faint, without) < 0.2
    assert dots_advice("mono0", faint, without) == []
    strong = detect_tags([with_infrared_dots(image, 4.0, 6.0, rng) for _ in range(5)], jobs=1)
    assert "infrared cut filter" in dots_advice("mono0", strong, without)[0].text


@pytest.mark.slow
def test_published_tags_are_found_where_they_are_published(data):
    folder = data("apriltag_images_aprilrobotics/test/data")
    near = 0
    for text in sorted(folder.glob("*.txt")):
        image = cv2.imread(str(text.with_suffix(".jpg")), cv2.IMREAD_GRAYSCALE)
        found = detect_tags([image], largest_hamming=2, search="thorough")[0]
        for line in text.read_text().splitlines():
            published = np.array(re.findall(r"-?[\d.]+", line.split(",", 1)[1]), dtype=float).reshape(4, 2)
            gaps = [np.linalg.norm(t.corners_px + 0.5 - published, axis=1).max() for t in found]
            near += min(gaps) < 1.0
    assert near >= 43  # of 47; the plain detector: 43
