"""What is reported of frames that no other frame supports."""

from __future__ import annotations

import numpy as np
import pytest

from processing.track.flags import FlagConfig, unjoined, unjoined_uncertainty
from recordings.geometry import rotation_exp

GOOD, BAD = (0.03, 0.95, 0.01), (0.2, 0.9, 0.05)


def hanging(pairs: list[tuple[int, int]], figures: list[tuple[float, float, float]], roots: list[int]) -> list[int]:
    use = np.ones(6, dtype=bool)
    use[5] = False
    found = unjoined(
        np.array(pairs, dtype=np.int64).reshape(-1, 2),
        np.array(figures, dtype=np.float64).reshape(-1, 3),
        roots,
        use,
        FlagConfig(),
    )
    return np.flatnonzero(found).tolist()


def test_frames_beyond_a_gap_that_no_pair_bridges_hang_on_nothing() -> None:
    chain = [(0, 1), (1, 2), (2, 3), (3, 4)]
    assert hanging(chain, [GOOD] * 4, [0]) == []
    assert hanging(chain, [GOOD, BAD, GOOD, GOOD], [0]) == [2, 3, 4]
    assert hanging(chain, [GOOD, (0.03, 0.2, 0.0), GOOD, GOOD], [0]) == [2, 3, 4]  # they hardly see the same surface


def test_another_way_round_joins_them_and_so_does_a_known_shape() -> None:
    assert hanging([(0, 1), (1, 2), (2, 3), (3, 4), (4, 0)], [GOOD, BAD, GOOD, GOOD, GOOD], [0]) == []
    assert hanging([(0, 1), (1, 2), (2, 3), (3, 4), (4, 8)], [GOOD, BAD, GOOD, GOOD, GOOD], [0, 7, 8]) == []


def test_a_frame_in_no_pair_hangs_and_one_that_is_not_used_does_not() -> None:
    assert hanging([(0, 1), (1, 2), (2, 3)], [GOOD] * 3, [0]) == [4]
    assert hanging([], [], [0]) == [1, 2, 3, 4]


def test_the_uncertainty_of_a_hanging_frame_is_a_rotation_about_the_center_of_mass() -> None:
    center = np.array([0.02, -0.01, 0.05])
    uncertainty = unjoined_uncertainty(np.array([False, True]), center, FlagConfig(unjoined_sigma_rad=0.5))
    assert not uncertainty[0].any()
    np.testing.assert_allclose(uncertainty[1, 3:, 3:], 0.25 * np.eye(3))
    turn = np.array([1e-5, -2e-5, 3e-5])
    moved = center - rotation_exp(turn) @ center  # where the origin goes when the body turns about its center of mass
    to_origin = uncertainty[1, :3, 3:] / 0.25
    np.testing.assert_allclose(to_origin @ turn, moved, atol=1e-10)
    assert np.linalg.eigvalsh(uncertainty[1])[0] == pytest.approx(0, abs=1e-12)
