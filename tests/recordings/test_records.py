"""Records carry their shapes in their types, and the tests really check them."""

from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest
from jaxtyping import TypeCheckError

from recordings.records import ArmStates, DepthImage, RgbdFrame, depth_in_metres


def frame(color_shape=(4, 6, 3), depth_shape=(4, 6), depth_type=np.float32):
    return RgbdFrame(
        camera="d455",
        index=7,
        time_ns=2_000_000_000,
        depth_time_ns=2_005_000_000,
        color_rgb=np.zeros(color_shape, np.uint8),
        depth_m=np.zeros(depth_shape, depth_type),
    )


def arm(samples=5, **changes):
    states = ArmStates(
        time_ns=np.arange(samples, dtype=np.int64) * 1_000_000,
        joint_names=("a", "b"),
        q_rad=np.arange(2.0 * samples).reshape(samples, 2),
        dq_rad_s=np.zeros((samples, 2)),
        finger_width_m=np.full(samples, np.nan),
    )
    return replace(states, **changes)


def test_colour_and_depth_keep_their_two_times():
    assert frame().depth_time_ns - frame().time_ns == 5_000_000


@pytest.mark.parametrize(
    "wrong",
    [
        {"depth_shape": (4, 5)},  # colour and depth of different sizes
        {"color_shape": (4, 6)},
        {"color_shape": (4, 6, 4)},
        {"depth_type": np.float64},
        {"depth_type": np.uint16},  # raw depth is no depth in metres
    ],
)
def test_a_frame_of_the_wrong_shape_or_type_is_refused(wrong):
    with pytest.raises(TypeCheckError):
        frame(**wrong)


def test_a_batch_of_joint_states_of_different_lengths_is_refused():
    with pytest.raises(TypeCheckError):
        arm(dq_rad_s=np.zeros((4, 2)))


def test_a_record_cannot_be_changed():
    with pytest.raises(FrozenInstanceError):
        frame().time_ns = 3


def test_between_keeps_both_ends():
    part = arm().between(1_000_000, 3_000_000)
    assert part.time_ns.tolist() == [1_000_000, 2_000_000, 3_000_000]
    np.testing.assert_array_equal(part.q_rad, arm().q_rad[1:4])
    assert part.dq_rad_s.shape == (3, 2)
    assert part.finger_width_m.shape == (3,)
    assert len(arm().between(7_000_000, 8_000_000).time_ns) == 0


@pytest.mark.parametrize("unit_m", [0.001, 0.00025, 0.0001])
def test_depth_in_metres_follows_the_devices_unit_and_leaves_no_return_at_zero(unit_m):
    raw = np.array([[0, 1, 4000], [65535, 0, 10]], np.uint16)
    depth_m = depth_in_metres(DepthImage("d455", 0, 0, 0, unit_m, raw))
    assert depth_m.dtype == np.float32
    np.testing.assert_allclose(depth_m, raw * unit_m, rtol=1e-6)
    assert (depth_m[raw == 0] == 0).all()
