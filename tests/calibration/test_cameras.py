"""Lenses and places of cameras against known ones: exact answers from exact points, honest deviations, named faults."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from calibration.cameras.extrinsics import calibrate_cameras
from calibration.cameras.intrinsics import calibrate_intrinsics, new_matrix_alpha
from calibration.cameras.poses import angle_deg, inverse_poses
from calibration.cameras.targets import NOTHING, Charuco, Chessboard, Tags, find_target, tag_view, target_from_document
from calibration.drift import bumps, drift_findings
from calibration.tags.detect import TagDetection
from calibration.tags.faults import sizes_by_triangulation, wrong_sizes
from calibration.tags.tagged_object import solve_tagged_object
from recordings.errors import BadInput
from recordings.geometry import Transform
from recordings.tracks import RigCalibration, TagPlacement


def off(found, true):
    gap = inverse_poses(true) @ found
    return 1e3 * float(np.linalg.norm(gap[:3, 3])), angle_deg(gap[:3, :3])


@pytest.fixture(scope="module")
def rig(geometry):
    """Four cameras round a table and twelve places of the board in front of them."""
    rng = np.random.default_rng(1)
    models = {n: geometry.camera(n, 600.0 + 10 * k) for k, n in enumerate(("d455", "mono0", "mono1", "mono2"))}
    world_from = {}
    for k, name in enumerate(models):
        azimuth = 0.45 * (k - 1.5)
        z = -np.array([np.sin(azimuth), -np.cos(azimuth) * 0.7, 0.8])
        z /= np.linalg.norm(z)
        x = np.cross(z, [0, 0, 1.0])
        x /= np.linalg.norm(x)
        place = np.eye(4)
        place[:3, :3], place[:3, 3] = np.stack([x, np.cross(z, x), z], -1), -0.9 * z
        world_from[name] = place
    boards = [geometry.pose(0.5 * rng.normal(size=3), [*rng.uniform(-0.1, 0.1, 2), 0.1]) for _ in range(8)]
    return models, world_from, boards


def views_of(geometry, rig, sigma_px=0.1, seed=2):
    models, world_from, boards = rig
    rng = np.random.default_rng(seed)
    return {
        n: [geometry.view(m, inverse_poses(world_from[n]) @ board, rng, sigma_px) for board in boards]
        for n, m in models.items()
    }


def test_places_of_cameras_are_found_within_their_own_deviations(geometry, rig):
    models, world_from, _ = rig
    placed = calibrate_cameras(models, views_of(geometry, rig), "d455")
    assert placed.report.verdict == "good"
    for transform in placed.transforms:
        mm, deg = off(transform.matrix, inverse_poses(world_from["d455"]) @ world_from[transform.source])
        said = placed.report.uncertainty[transform.source]
        assert mm < 3 * said["position_mm"]
        assert deg < 3 * said["direction_deg"]
        assert mm < 1.0


def test_a_view_that_moved_between_cameras_is_left_out_and_named(geometry, rig):
    views = views_of(geometry, rig)
    seen = views["mono1"][4]
    views["mono1"][4] = replace(seen, pixels=seen.pixels + [6.0, -3.0])
    placed = calibrate_cameras(rig[0], views, "d455")
    assert any("mono1 view 4" in reason for reason in placed.report.reasons())
    assert placed.report.residuals["rms_px"] < 0.15


def test_a_camera_that_shares_no_view_is_named(geometry, rig):
    views = views_of(geometry, rig)
    views["mono2"] = [NOTHING] * 8
    with pytest.raises(BadInput, match="mono2"):
        calibrate_cameras(rig[0], views, "d455")


def test_a_board_whose_marks_are_printed_beside_their_places_does_little_harm(geometry, rig):
    """Tags off by 0.1 mm by axis, pictures that slip by 0.03 px as a whole, lenses found with the places."""
    models, world_from, _ = rig
    rng = np.random.default_rng(5)
    shift = {i: 1e-4 * rng.normal(size=3) for i in geometry.board.size_m}
    places = {i: p.copy() for i, p in geometry.board.board_from_tag.items()}
    for i, place in places.items():
        place[:3, 3] += shift[i]
    printed = type(geometry)(replace(geometry.board, board_from_tag=places))
    views = {}
    for n, looks in views_of(printed, rig, 0.04).items():
        back = [np.array([shift[i] for i in (v.ids // 4).tolist()]) for v in looks]
        views[n] = [
            replace(v, points_m=v.points_m - s, pixels=v.pixels + 0.03 * rng.normal(size=2), marks=v.ids // 4)
            for v, s in zip(looks, back)
        ]
    start = {n: replace(m, K=m.K * np.array([[1.004, 1, 1], [1, 1.004, 1], [1, 1, 1]])) for n, m in models.items()}
    placed = calibrate_cameras(start, views, "d455", freed=list(models))
    for transform in placed.transforms:
        mm, deg = off(transform.matrix, inverse_poses(world_from["d455"]) @ world_from[transform.source])
        said = placed.report.uncertainty[transform.source]
        assert mm < 1.5
        assert deg < 0.1
        assert mm < 3 * said["position_mm"]
    assert max(abs(placed.models[n].fx / m.fx - 1) for n, m in models.items()) < 0.003


@pytest.mark.slow
def test_the_tables_tags_give_the_scale_of_a_board_printed_too_large(geometry, rig):
    models, world_from, boards = rig
    board = geometry.board
    table = Tags("tag36h11", dict.fromkeys(range(4), 0.08), {})
    corners = [(-0.3, 0.2), (0.3, 0.2), (0.25, -0.2), (-0.25, -0.2)]
    flat = np.diag([1.0, -1.0, -1.0, 1.0])
    places = {}
    for k, (x, y) in enumerate(corners):
        places[k] = flat.copy()
        places[k][:2, 3] = x, y
    table = replace(table, board_from_tag=places)
    large = {k: p.copy() for k, p in board.board_from_tag.items()}
    for place in large.values():
        place[:3, 3] *= 1.004
    printed = type(geometry)(Tags("tag36h11", {k: 1.004 * s for k, s in board.size_m.items()}, large))
    truth = views_of(printed, rig)
    views = {n: [replace(v, points_m=v.points_m / 1.004) for v in looks] for n, looks in truth.items()}
    seen = type(geometry)(table)
    rng = np.random.default_rng(3)
    still = {n: [seen.view(m, inverse_poses(world_from[n]), rng) for _ in boards] for n, m in models.items()}
    without, tied = (calibrate_cameras(models, views, "d455", t) for t in (None, still))

    def worst(placed):
        true = {t.source: inverse_poses(world_from["d455"]) @ world_from[t.source] for t in placed.transforms}
        return max(off(t.matrix, true[t.source])[0] for t in placed.transforms)

    assert worst(tied) < 1.0 < worst(without)
    assert tied.report.details["board_scale"] == pytest.approx(1.004, abs=5e-4)
    assert any("% of the size it is said to be" in reason for reason in tied.report.reasons())


@pytest.mark.slow
def test_a_lens_is_found_with_its_distortion_and_the_simplest_model_is_taken(geometry):
    rng = np.random.default_rng(4)
    bent = geometry.camera("mono0", 620.0, distortion_model="brown-conrady", distortion=(-0.25, 0.08, 4e-4, -3e-4, 0.0))
    views = [geometry.view(bent, geometry.tilted(rng, (0.3, 0.6), 0.14), rng) for _ in range(14)]
    lens = calibrate_intrinsics("mono0", (640, 480), views, ("none", "brown-conrady"))
    assert lens.report.details["lens"] == "brown-conrady"
    assert abs(lens.model.distortion[4]) < 0.03
    assert lens.model.fx == pytest.approx(bent.fx, rel=3e-3)
    assert abs(lens.model.fx / bent.fx - 1) < 4e-2 * lens.report.uncertainty["focal_percent"]
    grid = np.stack(np.meshgrid(np.linspace(-0.35, 0.35, 7), np.linspace(-0.25, 0.25, 5), [1.0]), -1).reshape(-1, 3)
    gap = np.linalg.norm(lens.model.project(grid) - bent.project(grid), axis=1)
    assert np.median(gap) < 1.5


def test_few_views_in_one_place_are_doubted_for_coverage_and_tilt(geometry):
    rng = np.random.default_rng(5)
    model = geometry.camera("mono0")
    views = [geometry.view(model, geometry.tilted(rng, (1.0, 1.1), 0.02, 6.0), rng) for _ in range(6)]
    report = calibrate_intrinsics("mono0", (640, 480), views, ("none",)).report
    assert report.verdict in ("doubtful", "refused")
    said = " ".join(report.reasons())
    assert "tilt" in said
    assert "upper left" in said


@pytest.mark.slow
def test_a_view_with_wrong_corners_is_left_out_of_the_lens(geometry):
    rng = np.random.default_rng(6)
    model = geometry.camera("mono0")
    views = [geometry.view(model, geometry.tilted(rng, (0.4, 0.7)), rng) for _ in range(12)]
    views[3] = replace(views[3], pixels=views[3].pixels + rng.normal(0, 4, views[3].pixels.shape))
    lens = calibrate_intrinsics("mono0", (640, 480), views, ("none",))
    assert lens.report.details["rejected_views"] == [3]
    assert lens.model.fx == pytest.approx(model.fx, rel=4e-3)


def test_a_given_lens_is_kept_until_the_views_know_better(geometry):
    rng = np.random.default_rng(9)
    true = geometry.camera("mono0")
    views = [geometry.view(true, geometry.tilted(rng, (0.7, 0.9), 0.05), rng) for _ in range(6)]
    kept = calibrate_intrinsics("mono0", (640, 480), views, ("none",), true)
    assert kept.model is true
    assert kept.report.verdict == "doubtful"
    assert "upper left" in " ".join(kept.report.reasons())
    assert "--anew" in " ".join(kept.report.reasons())
    anew = calibrate_intrinsics("mono0", (640, 480), views, ("none",), true, anew=True)
    assert anew.model is not true
    wrong = replace(true, K=true.K * [[1.06, 1, 1], [1, 1.06, 1], [1, 1, 1]])
    found = calibrate_intrinsics("mono0", (640, 480), views, ("none",), wrong)
    assert abs(found.model.fx / true.fx - 1) < 0.02


@pytest.mark.parametrize("alpha", [0.0, 1.0])
def test_a_matrix_of_get_optimal_new_camera_matrix_with_its_distortion_kept_is_recognised(geometry, alpha):
    true = geometry.camera("mono0", 620.0, distortion_model="brown-conrady", distortion=(-0.25, 0.08, 0.0, 0.0, 0.0))
    new, _ = cv2.getOptimalNewCameraMatrix(true.K, np.array(true.distortion), (640, 480), alpha)
    assert new_matrix_alpha(replace(true, K=new), true) == alpha
    assert new_matrix_alpha(true, true) is None
    if alpha == 0.0:
        rng = np.random.default_rng(7)
        views = [geometry.view(true, geometry.tilted(rng, (0.3, 0.6), 0.14), rng) for _ in range(10)]
        lens = calibrate_intrinsics("mono0", (640, 480), views, ("brown-conrady",), replace(true, K=new))
        assert any("getOptimalNewCameraMatrix" in reason for reason in lens.report.reasons())


def test_a_camera_that_was_bumped_between_views_is_named(geometry, rig):
    rng = np.random.default_rng(8)
    still = [geometry.view(rig[0]["mono0"], geometry.pose([np.pi, 0, 0], [0, 0, 0.7]), rng) for _ in range(8)]
    assert bumps({"mono0": still}) == []
    moved = [*still[:5], *(replace(v, pixels=v.pixels + [1.2, 0.5]) for v in still[5:])]
    (finding,) = bumps({"mono0": moved})
    assert "between view 4 and view 5" in finding.text


def seen_tags(model, camera_from_body, layout, rng, sigma_px=0.1, least_cos=0.25):
    found = []
    for tag, place in layout.board_from_tag.items():
        in_camera = camera_from_body @ place
        facing = -in_camera[:3, 3] @ in_camera[:3, 2] / np.linalg.norm(in_camera[:3, 3])
        if facing < -least_cos:
            corners = layout.corners_m(tag) @ camera_from_body[:3, :3].T + camera_from_body[:3, 3]
            pixels = model.project(corners) + sigma_px * rng.normal(size=(4, 2))
            if model.sees(pixels).all():
                found.append(TagDetection(tag, pixels, np.tile(sigma_px**2 * np.eye(2), (4, 1, 1)), 60.0, 0))
    return found


@pytest.fixture(scope="module")
def tossed(geometry, rig):
    """A cube with a tag on every face, thrown in front of the mono cameras."""
    models, world_from, _ = rig
    rng, layout, quarter = np.random.default_rng(9), {}, np.pi / 2
    turns = [[0, 0, 0], [np.pi, 0, 0], [quarter, 0, 0], [-quarter, 0, 0], [0, quarter, 0], [0, -quarter, 0]]
    for tag, turn in enumerate(turns):
        inward = geometry.pose([np.pi, 0, 0], [0, 0, 0.05])
        layout[tag] = geometry.pose(turn, [0, 0, 0]) @ inward @ geometry.pose([0, 0, 0.02 * tag], [0.003, -0.002, 0])
    body = Tags("tag36h11", dict.fromkeys(layout, 0.06), layout)
    times = np.arange(24) / 30
    trajectory = [
        geometry.pose([2.5 * t, 1.5 * t, 1.0 * t], [0.5 * t - 0.2, 0.1, 0.1 + 1.2 * t - 4.9 * t * t / 2]) for t in times
    ]
    names = ("mono0", "mono1", "mono2")
    detections = {
        n: [seen_tags(models[n], inverse_poses(world_from[n]) @ pose, body, rng) for pose in trajectory] for n in names
    }
    return body, times, trajectory, detections


def test_layout_and_poses_of_an_unknown_tagged_body_are_found(rig, tossed):
    models, world_from, _ = rig
    body, _, trajectory, detections = tossed
    names = list(detections)
    places = {n: inverse_poses(world_from[n]) for n in names}
    solved = solve_tagged_object({n: models[n] for n in names}, detections, body.size_m, places)
    assert solved.left_out == 0
    assert len(solved.instants) == len(trajectory)
    reference = solved.tag_ids[0]
    for pose, k in zip(solved.rig_from_body, solved.instants):
        mm, deg = off(pose, trajectory[k] @ body.board_from_tag[reference])
        assert mm < 0.6
        assert deg < 0.5


def test_cameras_are_placed_by_the_tossed_body_alone(rig, tossed):
    models, world_from, _ = rig
    body, _, _, detections = tossed
    names = sorted(detections)
    solved = solve_tagged_object({n: models[n] for n in names}, detections, body.size_m)
    for k, name in enumerate(names[1:], 1):
        true = inverse_poses(world_from[name]) @ world_from[names[0]]
        mm, deg = off(solved.solved.scene.camera_from_rig[k], true)
        assert mm < 6.0
        assert deg < 0.3


def test_a_wrong_tag_size_is_found_by_its_ratio_and_said(rig, tossed):
    models, world_from, _ = rig
    body, _, _, detections = tossed
    places = {n: inverse_poses(world_from[n]) for n in detections}
    measured = sizes_by_triangulation({n: models[n] for n in detections}, places, detections)
    assert wrong_sizes(body.size_m, measured) == []
    (finding,) = wrong_sizes(dict.fromkeys(body.size_m, 0.066), measured)
    assert finding.level == "refused"
    said_mm = float(finding.text.rsplit("state ", 1)[1].split(" mm")[0])
    assert said_mm == pytest.approx(60.0, abs=0.3)
    one = wrong_sizes({**body.size_m, 2: 0.05}, measured)
    assert ["tag 2" in f.text for f in one] == [True]


def test_tags_on_the_table_tell_that_a_camera_moved_since_its_calibration(geometry, rig):
    models, world_from, _ = rig
    flat = geometry.pose([np.pi, 0, 0], [0.1, 0.05, 0.0])
    calibration = RigCalibration(
        models,
        tuple(Transform.from_matrix("world", n, p) for n, p in world_from.items()),
        (TagPlacement(30, 0.1, Transform.from_matrix("world", "tag_30", flat)),),
    )
    table = Tags("tag36h11", {30: 0.1}, {30: flat})
    rng = np.random.default_rng(0)

    def toss(moved):
        return {"mono0": [seen_tags(models["mono0"], inverse_poses(moved), table, rng) for _ in range(5)]}

    assert drift_findings(calibration, table, toss(world_from["mono0"])) == []
    (finding,) = drift_findings(calibration, table, toss(world_from["mono0"] @ geometry.pose([0, 0.002, 0], [0, 0, 0])))
    assert "mono0 moved" in finding.text


def test_charuco_and_chessboards_are_found_where_they_were_drawn():
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    board = cv2.aruco.CharucoBoard((6, 5), 0.04, 0.03, dictionary)
    image = cv2.copyMakeBorder(board.generateImage((600, 500)), 40, 40, 40, 40, cv2.BORDER_CONSTANT, value=255)
    (view,) = find_target(Charuco(6, 5, 0.04, 0.03), [image])
    assert len(view) == 20
    np.testing.assert_allclose(view.pixels, view.points_m[:, :2] / 0.04 * 100 + 39.5, atol=0.6)
    squares = np.kron(np.indices((6, 7)).sum(axis=0) % 2, np.ones((50, 50))) * 255
    image = cv2.copyMakeBorder(squares.astype(np.uint8), 60, 60, 60, 60, cv2.BORDER_CONSTANT, value=255)
    (view,) = find_target(Chessboard(6, 5, 0.03), [image])
    assert len(view) == 30
    assert find_target(Chessboard(6, 5, 0.03), [np.full((200, 200), 128, np.uint8)]) == [NOTHING]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"size_m": -0.05}, "tag 3 of the board has size_m -0.05; wanted metres above 0"),
        ({"size_m": float("nan")}, "size_m nan"),
        ({"T_board_tag": np.full((4, 4), np.nan).tolist()}, "T_board_tag of tag 3 is no pose"),
        ({"T_board_tag": np.diag([2.0, 1, 1, 1]).tolist()}, "T_board_tag of tag 3 is no pose"),
        ({"T_board_tag": [[1.0, 0.0]]}, "T_board_tag of tag 3 is no pose"),
    ],
)
def test_a_board_that_cannot_be_is_refused_naming_its_tag(change, said):
    tag = {"id": 3, "size_m": 0.05, "T_board_tag": np.eye(4).tolist(), **change}
    with pytest.raises(BadInput, match=said):
        target_from_document({"family": "tag36h11", "tags": [tag]}, "session.json")
    with pytest.raises(BadInput, match="wanted two or more each way"):
        target_from_document({"kind": "chessboard", "columns": 1, "rows": 7, "square_m": 0.02}, "session.json")


def test_tags_of_a_wrong_size_on_a_board_of_the_right_pitch_are_refused(geometry, rig):
    """The board then looks like a larger one whose tags are pushed together: nothing but their places tells."""
    views = views_of(geometry, rig)
    middle = {i: geometry.board.corners_m(i).mean(axis=0) for i in geometry.board.size_m}

    def larger(view):
        at = np.array([middle[i] for i in (view.ids // 4).tolist()])
        return replace(view, points_m=at + 1.1 * (view.points_m - at), marks=view.ids // 4)

    placed = calibrate_cameras(rig[0], {n: [larger(v) for v in looks] for n, looks in views.items()}, "d455")
    assert placed.report.verdict == "refused"
    assert any("from where its layout" in reason for reason in placed.report.reasons())


def test_a_board_is_read_from_its_document_or_refused():
    found = target_from_document({"kind": "charuco", "columns": 6, "rows": 5, "square_m": 0.04, "marker_m": 0.03}, "x")
    assert found == Charuco(6, 5, 0.04, 0.03)
    assert isinstance(target_from_document({"family": "tag36h11", "tags": []}, "x"), Tags)
    with pytest.raises(BadInput, match="circles"):
        target_from_document({"kind": "circles"}, "x")
    with pytest.raises(BadInput, match="square_m"):
        target_from_document({"kind": "chessboard", "columns": 6, "rows": 5}, "x")


def test_a_tag_seen_twice_in_one_image_is_left_out():
    place = {1: np.eye(4), 2: np.eye(4)}
    tags = [TagDetection(i, np.zeros((4, 2)), np.tile(np.eye(2), (4, 1, 1)), 50.0, 0) for i in (1, 1, 2, 9)]
    assert sorted(set(tag_view(Tags("tag36h11", {1: 0.1, 2: 0.1}, place), tags).ids // 4)) == [2]
