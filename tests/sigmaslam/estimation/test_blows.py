"""Blows: each one is found when it comes, and none in flight."""

import numpy as np
import pytest

from sigmaslam.estimation.standstill import find_blow
from sigmaslam.readers.inertial import find_imu, read_imu
from tests.support.inertial import SENSOR, Motion


def of_flight(seed: int) -> np.ndarray:
    table = np.column_stack(Motion(seed).measure(np.arange(0.0, 1.0, 0.005)).columns())
    scale = 5.0 * SENSOR.accel_density / np.sqrt(0.005)
    table[:, 4:] += scale * np.random.default_rng(seed).standard_normal((len(table), 3))
    return table


def test_a_knock_of_some_milliseconds_is_found_when_it_comes():
    for seed in range(10):
        table, rng = of_flight(seed), np.random.default_rng(seed)
        hit = int(rng.integers(185, 195))
        force = rng.standard_normal(3)
        since = table[180, 0]
        assert find_blow(table, since) is None
        table[hit, 4:] += 20.0 * force / np.linalg.norm(force)
        found = find_blow(table, since)
        assert found is not None
        assert found[0] == pytest.approx(table[hit, 0], abs=6e-3)
        assert found[1] == pytest.approx(20.0, abs=2.0)
        assert find_blow(table, table[hit + 2, 0]) is None  # of an earlier frame


@pytest.mark.long
@pytest.mark.parametrize("name", ["euroc_mh01_f000_099", "euroc_v1_01_keyframes_a", "euroc_v1_01_static"])
def test_motors_and_shaking_hands_are_no_blows(name: str, real_data):
    samples = read_imu(find_imu(real_data / name)).samples
    table = np.column_stack(samples.columns())
    for end in range(100, len(table), 10):
        assert find_blow(table[end - 100 : end], table[end - 11, 0]) is None
