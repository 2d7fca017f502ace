"""What every feature matcher promises, asked of each. The learned ones have random weights: theirs are not at hand."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from processing.features.learned import PictureConfig, picture_of
from processing.features.lightglue import LightGlue, LightGlueConfig, empty_network, root_sift
from processing.features.loftr import Grid, Loftr, LoftrConfig
from processing.features.sift import FeatureMatcher, Features, RansacConfig, Sift, relative_motions
from processing.features.xfeat import XFeat, XFeatConfig
from processing.sensor.rectification import Rectification
from processing.sensor.view import ViewConfig, cut
from processing.sensor.view_store import ViewStore
from processing.track.beam import Candidate
from processing.track.notes import NotesConfig, notes_of
from processing.track.track_toss import TossTrack
from recordings.errors import BadInput
from recordings.geometry import CameraModel, rotation_exp
from recordings.records import RgbdFrame
from recordings.tracks import ObjectTrack

WIDTH, HEIGHT, FOCAL, HALF_M, FAR_M = 200, 150, 260.0, 0.1, 0.5
CAMERA = CameraModel("d455", WIDTH, HEIGHT, np.array([[FOCAL, 0, 99.5], [0, FOCAL, 74.5], [0, 0, 1.0]]))
PICTURE = PictureConfig(side_px=160)
NEEDS_WEIGHTS = {
    "xfeat": "with random weights nothing says that the same place looks alike from two sides",
    "loftr": "with random weights nothing says that the same place looks alike from two sides",
    "lightglue": "with random weights LightGlue's layers do not keep a point like itself",
}


def see(pose: np.ndarray) -> tuple[RgbdFrame, np.ndarray]:
    """A square of random tiles at a pose (camera from square), its depth exact, and its mask."""
    rays = CAMERA.pixel_rays()
    normal, origin = pose[:3, 2], pose[:3, 3]
    depth = (normal @ origin) / (rays @ normal)
    on_square = (rays * depth[..., None] - origin) @ pose[:3, :2]
    mask = (np.abs(on_square) < HALF_M).all(-1)
    tiles = cv2.resize(np.random.default_rng(5).random((24, 24)).astype(np.float32), (480, 480))
    place = ((on_square + HALF_M) / (2 * HALF_M) * 479).astype(np.float32)
    gray = cv2.remap(tiles, place[..., 0], place[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    color = np.where(mask, 30 + 200 * gray, 10).astype(np.uint8)
    return RgbdFrame("d455", 0, 0, 0, np.stack([color] * 3, -1), np.where(mask, depth, 0).astype(np.float32)), mask


def pose_of(turn: list[float], shift_m: list[float]) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_exp(np.array(turn)), np.array([0, 0, FAR_M]) + shift_m
    return pose


POSES = [pose_of([0, 0.1, 0], [0, 0, 0]), pose_of([0.1, -0.1, 0.15], [0.02, -0.01, 0.03])]


@pytest.fixture(scope="module")
def store() -> ViewStore:
    """Two views of the square and one of nothing."""
    rectified, config = Rectification.of(CAMERA), ViewConfig()
    seen = [see(p) for p in POSES]
    crops = [cut(frame, mask, i, rectified, 1.0, config) for i, (frame, mask) in enumerate(seen)]
    out = ViewStore(rectified, [*crops, None], config)
    assert [out.fill(i) for i in range(3)] == [True, True, False]
    return out


def random_xfeat() -> FeatureMatcher:
    kornia = pytest.importorskip("kornia.feature", reason="kornia is not installed: pip install -e .[learned]")
    torch.manual_seed(0)
    return XFeat(kornia.XFeat(), XFeatConfig(PICTURE, least_score=0.0, most=200))


def random_lightglue() -> FeatureMatcher:
    kornia = pytest.importorskip("kornia.feature", reason="kornia is not installed: pip install -e .[learned]")
    torch.manual_seed(0)
    return LightGlue(empty_network(kornia, n_layers=2, filter_threshold=0.0), LightGlueConfig(PICTURE, most=150))


def random_loftr() -> FeatureMatcher:
    kornia = pytest.importorskip("kornia.feature", reason="kornia is not installed: pip install -e .[learned]")
    torch.manual_seed(0)
    default = kornia.loftr.loftr.default_cfg
    small = {
        "resnetfpn": {"initial_dim": 16, "block_dims": [16, 24, 32]},
        "coarse": default["coarse"] | {"d_model": 32, "d_ffn": 32},
        "fine": default["fine"] | {"d_model": 16, "d_ffn": 16},
        "match_coarse": default["match_coarse"] | {"thr": 0.0},
    }
    return Loftr(kornia.LoFTR(pretrained=None, config=default | small), LoftrConfig(PICTURE))


MATCHERS = {"sift": Sift, "xfeat": random_xfeat, "lightglue": random_lightglue, "loftr": random_loftr}


@pytest.fixture(params=list(MATCHERS))
def matcher(request: pytest.FixtureRequest) -> FeatureMatcher:
    made: FeatureMatcher = MATCHERS[request.param]()
    assert isinstance(made, FeatureMatcher)
    assert made.name == request.param
    return made


def test_points_lie_on_the_object(matcher: FeatureMatcher, store: ViewStore) -> None:
    for view, pose in enumerate(POSES):
        points = matcher.describe(store, view).points_m
        assert len(points) > 20
        inside = (points - pose[:3, 3]) @ pose[:3, :3]
        assert np.abs(inside[:, 2]).max() < 1e-3
        assert np.abs(inside[:, :2]).max() < HALF_M + 0.003


def test_pairs_are_rows_of_both_and_none_is_told_twice(matcher: FeatureMatcher, store: ViewStore) -> None:
    one, other = matcher.describe(store, 0), matcher.describe(store, 1)
    pairs = matcher.match(one, other)
    assert pairs.ndim == 2
    assert pairs.shape[1] == 2
    assert np.issubdtype(pairs.dtype, np.integer)
    assert len(pairs) > 0
    assert pairs.min() >= 0
    assert (pairs.max(0) < [len(one.points_m), len(other.points_m)]).all()
    assert len(np.unique(pairs, axis=0)) == len(pairs)


def test_the_same_views_give_the_same_pairs(matcher: FeatureMatcher, store: ViewStore) -> None:
    def pairs() -> np.ndarray:
        return matcher.match(matcher.describe(store, 0), matcher.describe(store, 1))

    np.testing.assert_array_equal(pairs(), pairs())


def test_a_view_of_nothing_has_no_points_and_no_pairs(matcher: FeatureMatcher, store: ViewStore) -> None:
    nothing, something = matcher.describe(store, 2), matcher.describe(store, 0)
    assert nothing.points_m.shape == (0, 3)
    for pair in ((nothing, something), (something, nothing), (nothing, nothing)):
        assert matcher.match(*pair).shape == (0, 2)


def test_a_view_matched_with_itself_is_at_rest(matcher: FeatureMatcher, store: ViewStore) -> None:
    if matcher.name == "lightglue":
        pytest.skip(NEEDS_WEIGHTS["lightglue"])
    here = matcher.describe(store, 0)
    (motion,) = relative_motions(matcher, here, matcher.describe(store, 0), RansacConfig(), seed=0)
    assert motion.inliers > 20
    np.testing.assert_allclose(motion.other_from_one, np.eye(4), atol=0.01)


def test_a_known_motion_is_found(matcher: FeatureMatcher, store: ViewStore) -> None:
    if matcher.name in NEEDS_WEIGHTS:
        pytest.skip(NEEDS_WEIGHTS[matcher.name])
    one, other = matcher.describe(store, 0), matcher.describe(store, 1)
    (motion,) = relative_motions(matcher, one, other, RansacConfig(), seed=0)
    np.testing.assert_allclose(motion.other_from_one, POSES[1] @ np.linalg.inv(POSES[0]), atol=0.01)


def test_a_place_in_the_picture_shows_what_is_there_in_the_crop(store: ViewStore) -> None:
    picture, crop = picture_of(store, 0, PictureConfig(side_px=256)), store.crops[0]
    assert picture is not None
    assert crop is not None
    assert picture.gray.shape[0] % 32 == picture.gray.shape[1] % 32 == 0
    assert 1 < picture.scale < 3
    v, u = (x[::7] for x in np.nonzero(cv2.erode(picture.mask.astype(np.uint8), np.ones((9, 9), np.uint8))))
    at = picture.in_crop(np.stack([u, v], -1).astype(float)).astype(np.float32)

    def likeness(shift_px: float) -> float:
        place = at + np.float32(shift_px)
        there = cv2.remap(crop.color[..., 0], place[:, :1], place[:, 1:], cv2.INTER_CUBIC)[:, 0]
        return float(np.corrcoef(there, picture.gray[v, u])[0, 1])

    assert likeness(0) > 0.995
    assert likeness(0) > max(likeness(0.2), likeness(-0.2))
    inside = picture.mask.sum() / picture.scale**2
    assert inside == pytest.approx(crop.mask.sum(), rel=0.02)


def test_loftrs_grid_gives_each_place_the_point_under_it(store: ViewStore) -> None:
    grid = random_loftr().describe(store, 0)
    assert isinstance(grid, Grid)
    assert grid.picture is not None
    c, crop = CAMERA, store.crops[0]
    assert crop is not None
    seen = np.stack([c.fx * grid.points_m[:, 0], c.fy * grid.points_m[:, 1]], -1) / grid.points_m[:, 2:]
    in_crop = seen + [c.cx, c.cy] - crop.corner
    uv = (in_crop - grid.picture.corner + 0.5) * grid.picture.scale - 0.5
    np.testing.assert_array_equal(grid.rows(uv), np.arange(len(grid.points_m)))
    assert (grid.rows(np.array([[-5.0, 0], [1e4, 0]])) == -1).all()


def tracked(store: ViewStore, second: np.ndarray) -> TossTrack:
    """A track of the two views and of nothing, with three poses that were not taken."""
    poses = np.stack([POSES[0], second, np.full((4, 4), np.nan)])
    status = ("tracked", "tracked", "lost")
    track = ObjectTrack(0, "d455", "object", np.arange(3), poses, status, np.full((3, 6, 6), np.nan))
    tried = [Candidate(POSES[0], fit, 0.0, 1.0, "prior") for fit in (0.5, 0.3, 0.4)]
    figures = np.array([0.1, 0.1, np.nan])
    return TossTrack(track, figures, figures, (0,), np.array([[0, 1]]), {1: tried}, np.zeros(3), store,
                     {i: Sift().describe(store, i) for i in range(2)}, np.full(len(figures), -1))  # fmt: skip


def test_notes_keep_the_cheapest_rejected_poses_and_matches_that_the_poses_judge(store: ViewStore) -> None:
    rejected, matches = notes_of(tracked(store, POSES[1]), Sift(), config=NotesConfig(most_rejected=2))
    np.testing.assert_array_equal(rejected.frame, [1, 1])
    np.testing.assert_array_equal(rejected.cost, [0.3, 0.4])
    assert {tuple(pair) for pair in matches.frames.tolist()} == {(1, 0)}  # the keyframe has no other to be matched with
    assert matches.agrees.mean() > 0.8
    shifted = POSES[1].copy()
    shifted[2, 3] += 0.03
    wrong = notes_of(tracked(store, shifted), Sift())[1]
    assert wrong.agrees.mean() < 0.05


def test_root_sift_has_length_one_and_keeps_the_order() -> None:
    raw = np.random.default_rng(0).integers(0, 255, (4, 128)).astype(np.float32)
    root = root_sift(raw)
    np.testing.assert_allclose(np.linalg.norm(root, axis=1), 1, atol=1e-6)
    np.testing.assert_array_equal(root.argsort(1, kind="stable")[:, -1], raw.argsort(1, kind="stable")[:, -1])


def test_features_of_another_matcher_are_refused(store: ViewStore) -> None:
    strange = Features(np.zeros((3, 3)), np.zeros((3, 128), dtype=np.float32))
    for made in (random_loftr(), random_lightglue()):
        with pytest.raises(BadInput, match="described itself"):
            made.match(strange, strange)


FILES = {
    "loftr": (Loftr, "loftr_outdoor.ckpt", "LoFTR's outdoor model as kornia has it"),
    "xfeat": (XFeat, "xfeat.pt", "the GitHub project verlab/accelerated_features"),
    "lightglue": (LightGlue, "sift_lightglue.pth", "the GitHub project cvg/LightGlue"),
}


@pytest.mark.parametrize("name", FILES)
def test_missing_weights_say_where_they_come_from_and_where_to_put_them(name: str, tmp_path: Path) -> None:
    backend, file, source = FILES[name]
    with pytest.raises(BadInput, match=f"--matcher {name} needs learned weights.*{file}.*{source}.*--weights DIR"):
        backend.from_weights(None)
    with pytest.raises(BadInput, match=f"found nothing in .*wanted: {file}.*{source}"):
        backend.from_weights(tmp_path)


@pytest.mark.parametrize("name", FILES)
def test_without_kornia_the_error_says_what_to_install(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    backend, file, _ = FILES[name]
    (tmp_path / file).touch()
    monkeypatch.setitem(sys.modules, "kornia.feature", None)
    with pytest.raises(BadInput, match=r"needs kornia, which is not installed; run `pip install -e .\[learned\]`"):
        backend.from_weights(tmp_path)


def published(name: str) -> dict[str, Any]:
    """Zeros under the names of the published file."""
    kornia = pytest.importorskip("kornia.feature", reason="kornia is not installed: pip install -e .[learned]")
    made = {"loftr": lambda: kornia.LoFTR(None), "xfeat": lambda: kornia.XFeat().net}
    network = made.get(name, lambda: empty_network(kornia))()
    layers = {n: torch.zeros((), dtype=t.dtype).expand(t.shape) for n, t in network.state_dict().items()}
    if name == "loftr":
        return {"state_dict": {f"matcher.{n}": t for n, t in layers.items()}}
    if name == "lightglue":
        del layers["confidence_thresholds"]
        return {n.replace("transformers.3.self_attn", "self_attn.3"): t for n, t in layers.items()}
    return layers


@pytest.mark.parametrize("name", FILES)
def test_a_file_of_the_published_layers_loads(name: str, tmp_path: Path) -> None:
    backend, file, _ = FILES[name]
    torch.save(published(name), tmp_path / file)
    made = backend.from_weights(tmp_path)
    assert not made._network.training
    assert all(not p.detach().any() for p in made._network.parameters())


@pytest.mark.parametrize("name", FILES)
def test_a_file_of_other_layers_is_refused(name: str, tmp_path: Path) -> None:
    pytest.importorskip("kornia.feature", reason="kornia is not installed: pip install -e .[learned]")
    backend, file, source = FILES[name]
    torch.save({"some.weight": torch.zeros(2)}, tmp_path / file)
    with pytest.raises(BadInput, match=f"holds other layers: no .* more; wanted: {file}.*{source}"):
        backend.from_weights(tmp_path)


def test_sift_takes_the_matches_that_opencvs_brute_force_finds() -> None:
    rng = np.random.default_rng(2)
    one = rng.integers(0, 150, (80, 128)).astype(np.float32)
    other = np.concatenate(
        [np.clip(one[:50] + rng.integers(-40, 40, (50, 128)), 0, 255), one[:5], rng.integers(0, 150, (40, 128))]
    )
    two = other.astype(np.float32)
    near = cv2.BFMatcher(cv2.NORM_L2).knnMatch(one, two, k=2)
    wanted = sorted((a.distance / max(b.distance, 1e-6), a.queryIdx, a.trainIdx) for a, b in near)
    matcher = Sift()
    found = matcher.match(Features(np.zeros((80, 3)), one), Features(np.zeros((95, 3)), two))
    assert 20 < len(found) < 80
    assert found.tolist() == [[q, t] for ratio, q, t in wanted if ratio < matcher.config.ratio]
