"""Laws of transforms, also near 0 and near pi; camera models against OpenCV and against themselves."""

import re

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from jaxtyping import TypeCheckError
from scipy.spatial.transform import Rotation

from recordings.errors import BadInput, FrameMismatch
from recordings.geometry import (
    CameraModel,
    Transform,
    nearest_rotation,
    quaternion_from_rotation,
    rotation_angle_rad,
    rotation_exp,
    rotation_from_quaternion,
    rotation_log,
    skew,
)

EDGES_RAD = (0.0, 1e-12, 1e-9, 1e-7, 1e-4, np.pi / 2, np.pi - 1e-4, np.pi - 1e-7, np.pi - 1e-9, np.pi)
angles_rad = st.one_of(st.sampled_from(EDGES_RAD), st.floats(0, np.pi))
components = st.floats(-10, 10, allow_subnormal=False)
vectors3 = arrays(np.float64, 3, elements=components)
clouds = arrays(np.float64, (5, 3), elements=components)


@st.composite
def axes(draw):
    z, turn = draw(st.floats(-1, 1)), draw(st.floats(0, 2 * np.pi))
    r = np.sqrt(1 - z * z)
    return np.array([r * np.cos(turn), r * np.sin(turn), z])


@st.composite
def transforms(draw, target, source):
    return Transform(target, source, rotation_exp(draw(angles_rad) * draw(axes())), draw(vectors3))


# --- transforms


@given(transforms("a", "b"))
def test_there_and_back_is_nowhere(a_from_b):
    for here in (a_from_b @ a_from_b.inverse(), a_from_b.inverse() @ a_from_b):
        np.testing.assert_allclose(here.rotation, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(here.translation_m, 0, atol=1e-12)
    assert ((a_from_b @ a_from_b.inverse()).target, (a_from_b @ a_from_b.inverse()).source) == ("a", "a")


@given(transforms("a", "b"), transforms("b", "c"), transforms("c", "d"))
def test_chaining_is_associative(a_from_b, b_from_c, c_from_d):
    left, right = (a_from_b @ b_from_c) @ c_from_d, a_from_b @ (b_from_c @ c_from_d)
    np.testing.assert_allclose(left.matrix, right.matrix, atol=1e-12)
    assert (left.target, left.source) == (right.target, right.source) == ("a", "d")


@given(transforms("a", "b"), transforms("b", "c"), clouds)
def test_a_chain_moves_points_and_vectors_as_its_links_do_in_turn(a_from_b, b_from_c, cloud):
    chained = a_from_b @ b_from_c
    np.testing.assert_allclose(chained.points(cloud), a_from_b.points(b_from_c.points(cloud)), atol=1e-11)
    np.testing.assert_allclose(chained.vectors(cloud), a_from_b.vectors(b_from_c.vectors(cloud)), atol=1e-11)


@given(transforms("a", "b"), transforms("b", "c"))
def test_the_inverse_of_a_chain_is_the_chain_of_inverses_backwards(a_from_b, b_from_c):
    backwards = b_from_c.inverse() @ a_from_b.inverse()
    np.testing.assert_allclose((a_from_b @ b_from_c).inverse().matrix, backwards.matrix, atol=1e-12)


@given(transforms("a", "b"), clouds)
def test_points_are_shifted_and_vectors_are_not(a_from_b, cloud):
    np.testing.assert_allclose(
        a_from_b.points(cloud) - a_from_b.vectors(cloud), a_from_b.translation_m + 0 * cloud, atol=1e-13
    )
    np.testing.assert_allclose(a_from_b.vectors(np.zeros((1, 3))), 0, atol=0)
    np.testing.assert_allclose(
        a_from_b.points(cloud[1:]) - a_from_b.points(cloud[:-1]), a_from_b.vectors(cloud[1:] - cloud[:-1]), atol=1e-12
    )


@given(transforms("a", "b"), clouds)
def test_distances_and_handedness_are_kept(a_from_b, cloud):
    moved = a_from_b.vectors(cloud)
    np.testing.assert_allclose(np.linalg.norm(moved, axis=1), np.linalg.norm(cloud, axis=1), atol=1e-12)
    crossed = a_from_b.vectors(np.cross(cloud[:1], cloud[1:2]))
    np.testing.assert_allclose(crossed, np.cross(moved[:1], moved[1:2]), atol=1e-11)


def test_points_move_by_the_known_answer():
    world_from_camera = Transform("world", "camera", rotation_exp(np.array([0, 0, np.pi / 2])), np.array([1.0, 2, 3]))
    np.testing.assert_allclose(world_from_camera.points(np.array([[1.0, 0, 0]])), [[1, 3, 3]], atol=1e-15)
    np.testing.assert_allclose(world_from_camera.vectors(np.array([[1.0, 0, 0]])), [[0, 1, 0]], atol=1e-15)


def test_images_of_points_keep_their_shape():
    grid = np.zeros((4, 6, 3))
    assert Transform.identity("a", "b").points(grid).shape == grid.shape


def test_frames_that_do_not_meet_are_refused():
    a_from_b, c_from_d = Transform.identity("a", "b"), Transform.identity("c", "d")
    with pytest.raises(FrameMismatch, match=re.escape("cannot chain a_from_b with c_from_d: 'b' does not meet 'c'")):
        a_from_b @ c_from_d


@pytest.mark.parametrize(
    ("rotation", "why"),
    [
        (np.diag([1.0, 1.0, -1.0]), "not a rotation matrix"),
        (np.eye(3) * 1.01, "not a rotation matrix"),
        (np.full((3, 3), np.nan), "NaN"),
    ],
)
def test_what_is_no_rotation_is_refused(rotation, why):
    with pytest.raises(BadInput, match=why):
        Transform("a", "b", rotation, np.zeros(3))


def test_an_infinite_translation_is_refused():
    with pytest.raises(BadInput, match="finite"):
        Transform("a", "b", np.eye(3), np.array([0, np.inf, 0]))


def test_a_wrong_shape_is_refused_by_the_type_itself():
    """Proves that jaxtyping's hook is on: nothing in the function looks at the shape."""
    with pytest.raises(TypeCheckError, match="points_m"):
        Transform.identity("a", "b").points(np.zeros((5, 2)))


# --- matrices and quaternions


@given(transforms("a", "b"))
def test_a_matrix_comes_back_as_the_same_transform(a_from_b):
    again = Transform.from_matrix("a", "b", a_from_b.matrix)
    np.testing.assert_allclose(again.matrix, a_from_b.matrix, atol=1e-14)


@given(transforms("a", "b"))
def test_a_quaternion_comes_back_as_the_same_rotation_with_w_not_negative(a_from_b):
    q = a_from_b.quaternion_wxyz
    assert q[0] >= 0
    assert np.linalg.norm(q) == pytest.approx(1)
    again = Transform.from_quaternion("a", "b", q, a_from_b.translation_m)
    np.testing.assert_allclose(again.matrix, a_from_b.matrix, atol=1e-14)


@given(angles_rad, axes())
def test_exp_agrees_with_scipy(angle_rad, axis):
    np.testing.assert_allclose(
        rotation_exp(angle_rad * axis), Rotation.from_rotvec(angle_rad * axis).as_matrix(), atol=1e-14
    )


@given(st.one_of(st.sampled_from(EDGES_RAD[:-3]), st.floats(0, np.pi - 1e-6)), axes())
def test_log_undoes_exp_below_pi(angle_rad, axis):
    np.testing.assert_allclose(rotation_log(rotation_exp(angle_rad * axis)), angle_rad * axis, atol=1e-9, rtol=1e-9)


@given(st.sampled_from(EDGES_RAD[-3:]), axes())
def test_at_pi_log_gives_the_axis_up_to_its_sign(angle_rad, axis):
    vector = rotation_log(rotation_exp(angle_rad * axis))
    assert min(np.abs(vector - angle_rad * axis).max(), np.abs(vector + angle_rad * axis).max()) < 1e-6
    np.testing.assert_allclose(rotation_exp(vector), rotation_exp(angle_rad * axis), atol=1e-12)


@given(angles_rad, axes())
def test_the_angle_is_the_one_that_was_turned(angle_rad, axis):
    assert rotation_angle_rad(rotation_exp(angle_rad * axis)) == pytest.approx(angle_rad, abs=1e-9)


@pytest.mark.parametrize("angle_rad", [1e-7, 1e-9, 1e-12])
def test_tiny_angles_are_not_rounded_away(angle_rad):
    # acos of the trace would give 0 or 2e-8 here
    assert rotation_angle_rad(rotation_exp(np.array([0, angle_rad, 0]))) == pytest.approx(angle_rad, rel=1e-6)


@given(axes(), st.sampled_from([1e-3, 1.0, 50.0]))
def test_a_quaternion_of_any_length_is_a_direction(axis, length):
    q = length * np.array([0.6, *(0.8 * axis)])
    np.testing.assert_allclose(quaternion_from_rotation(rotation_from_quaternion(q)), q / length, atol=1e-12)


@pytest.mark.parametrize("q", [np.zeros(4), np.array([1, np.nan, 0, 0])])
def test_a_quaternion_without_direction_is_refused(q):
    with pytest.raises(BadInput, match="no direction"):
        rotation_from_quaternion(q)


@given(vectors3, vectors3)
def test_skew_is_the_cross_product(a, b):
    np.testing.assert_allclose(skew(a) @ b, np.cross(a, b), atol=1e-12)


def test_a_rotation_off_by_rounding_is_repaired_and_one_off_by_more_is_refused():
    rotation = rotation_exp(np.array([0.3, -1.2, 0.5]))
    np.testing.assert_allclose(nearest_rotation(rotation + 1e-5), rotation, atol=2e-5)
    repaired = nearest_rotation(rotation + 1e-5)
    np.testing.assert_allclose(repaired @ repaired.T, np.eye(3), atol=1e-14)
    with pytest.raises(BadInput, match="off by"):
        nearest_rotation(rotation * 1.1)


@pytest.mark.parametrize("matrix", [np.full((4, 4), np.nan), np.diag([1.0, 1, 1, 2]), np.diag([1.0, 1, -1, 1])])
def test_a_matrix_that_is_no_rigid_transform_is_refused(matrix):
    with pytest.raises(BadInput):
        Transform.from_matrix("a", "b", matrix)


# --- cameras

K = np.array([[386.3, 0, 322.4], [0, 384.9, 241.8], [0, 0, 1]])
LENSES = {
    "none": (),
    "brown-conrady": (-0.12, 0.06, 0.0011, -0.0007, -0.01),
    "rational": (0.42, 0.08, 0.0009, -0.0004, 0.011, 0.51, 0.12, 0.02),
    "fisheye": (0.05, -0.012, 0.004, -0.0011),
}


def camera_with(model, distortion=None, **changes):
    settings = {"frame": "d455", "width": 640, "height": 480, "K": K} | changes
    lens = LENSES[model] if distortion is None else distortion
    return CameraModel(**settings, distortion_model=model, distortion=lens)


@pytest.fixture(params=LENSES)
def camera(request):
    return camera_with(request.param)


def test_pixels_agree_with_opencv(camera, rng_points):
    if camera.distortion_model == "fisheye":
        wanted, _ = cv2.fisheye.projectPoints(
            rng_points[None], np.zeros(3), np.zeros(3), camera.K, np.array(camera.distortion)
        )
    else:
        wanted, _ = cv2.projectPoints(rng_points, np.zeros(3), np.zeros(3), camera.K, np.array(camera.distortion))
    np.testing.assert_allclose(camera.project(rng_points), wanted.reshape(-1, 2), atol=1e-9)


@pytest.fixture
def rng_points():
    rng = np.random.default_rng(4)
    return np.column_stack([rng.uniform(-0.8, 0.8, (200, 2)), rng.uniform(0.4, 3, 200)]) * [1, 0.75, 1]


def test_every_pixel_comes_back_through_the_lens(camera):
    u, v = np.meshgrid(np.arange(0, 640, 13.0), np.arange(0, 480, 13.0))
    pixels = np.stack([u, v], -1)
    depth_m = 0.4 + (u + v) / 500
    points_m = camera.back_project(pixels, depth_m)
    np.testing.assert_allclose(points_m[..., 2], depth_m, atol=1e-12)
    np.testing.assert_allclose(camera.project(points_m), pixels, atol=1e-8)


@given(
    st.sampled_from([m for m in LENSES if m != "none"]),
    st.floats(0.2, 1.0),
    st.floats(0, 639),
    st.floats(0, 479),
    st.floats(0.1, 5),
)
def test_lenses_of_any_strength_go_there_and_back(model, strength, u, v, depth_m):
    camera = camera_with(model, distortion=tuple(strength * k for k in LENSES[model]))
    point_m = camera.back_project(np.array([u, v]), np.array(depth_m))
    np.testing.assert_allclose(camera.project(point_m), [u, v], atol=1e-8)


@pytest.mark.parametrize("model", ["brown-conrady", "rational", "fisheye"])
def test_a_lens_with_zero_coefficients_is_where_it_should_be(model, rng_points):
    pixels = camera_with(model, distortion=(0.0,) * len(LENSES[model])).project(rng_points)
    x, y, z = rng_points.T
    r = np.hypot(x, y)
    scale = np.arctan2(r, z) / r if model == "fisheye" else 1 / z  # equidistant: image radius = f theta
    np.testing.assert_allclose(pixels, np.column_stack([K[0, 0] * x * scale + K[0, 2], K[1, 1] * y * scale + K[1, 2]]))


def test_the_optical_axis_meets_the_principal_point(camera):
    np.testing.assert_allclose(camera.project(np.array([[0.0, 0, 2]])), [[322.4, 241.8]])


def test_points_at_or_behind_the_camera_have_no_pixel(camera):
    behind = camera.project(np.array([[0.1, 0.2, 0.0], [0.1, 0.2, -1.0], [0.0, 0.0, np.nan]]))
    assert np.isnan(behind).all()
    assert not camera.sees(behind).any()


def test_a_pixel_that_no_ray_reaches_has_no_ray():
    """Barrel distortion folds back at r = 1 / sqrt(3 * 0.5): beyond the image radius of that fold there is nothing."""
    camera = camera_with("brown-conrady", distortion=(-0.5, 0.0, 0.0, 0.0, 0.0))
    fold = np.sqrt(1 / 1.5)
    radius_px = K[0, 0] * fold * (1 - 0.5 * fold**2)
    inside, outside = 322.4 - 0.98 * radius_px, 322.4 - 1.05 * radius_px
    rays = camera.rays(np.array([[inside, 241.8], [outside, 241.8]]))
    assert np.isfinite(rays[0]).all()
    assert np.isnan(rays[1, :2]).all()


def test_every_pixel_of_the_image_has_its_ray(camera):
    rays = camera.pixel_rays()
    assert rays.shape == (480, 640, 3)
    np.testing.assert_allclose(camera.project(rays[100, 200]), [200, 100], atol=1e-8)  # row 100 is v


def test_a_skewed_camera_goes_there_and_back():
    skewed = K.copy()
    skewed[0, 1] = 2.5
    camera = camera_with("none", K=skewed)
    np.testing.assert_allclose(
        camera.project(np.array([0.2, 0.4, 2.0])), [386.3 * 0.1 + 2.5 * 0.2 + 322.4, 384.9 * 0.2 + 241.8]
    )
    np.testing.assert_allclose(camera.project(camera.rays(np.array([12.0, 34.0]))), [12, 34])


@pytest.mark.parametrize("factor", [0.5, 0.25, 2.0])
def test_a_resized_image_looks_along_the_same_rays(camera, factor):
    """Pixel centres are at integers: the image's corner, at (-0.5, -0.5), stays a corner."""
    small = camera.scaled(factor)
    assert (small.width, small.height) == (640 * factor, 480 * factor)
    pixels = np.array([[100.0, 50.0], [400.5, 300.0]])
    np.testing.assert_allclose(small.rays((pixels + 0.5) * factor - 0.5), camera.rays(pixels), atol=1e-10)


def test_sees_counts_whole_pixels():
    camera = camera_with("none")
    on = camera.sees(np.array([[-0.5, 0], [639.5, 479.5], [-0.6, 0], [0, 479.6], [np.nan, 0]]))
    assert on.tolist() == [True, True, False, False, False]


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"K": np.array([[386.0, 0, 900], [0, 386, 240], [0, 0, 1]])}, "principal point"),
        ({"K": np.diag([-386.0, 386, 1])}, "focal length"),
        ({"K": np.full((3, 3), np.nan)}, "NaN"),
        ({"width": 0}, "image size"),
        ({"distortion": (0.1,)}, "takes 0 coefficients, found 1"),
    ],
)
def test_implausible_intrinsics_are_refused_in_words(changes, why):
    with pytest.raises(BadInput, match=why):
        camera_with("none", **changes)


def test_an_unknown_lens_is_refused():
    with pytest.raises((BadInput, TypeCheckError)):
        CameraModel("d455", 640, 480, K, "ftheta", ())
