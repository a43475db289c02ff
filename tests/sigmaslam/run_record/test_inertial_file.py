"""inertial.csv of a run."""

from pathlib import Path

import numpy as np
import pytest

from sigmaslam.errors import InputError
from sigmaslam.geometry.se3 import rotation_exp
from sigmaslam.run_record.inertial_file import (
    COLUMNS,
    INERTIAL_NAME,
    InertialWriter,
    cut_inertial_records,
    describe_gravity,
    read_inertial_records,
)
from sigmaslam.run_record.pose_file import PoseRecords
from sigmaslam.slam.inertial_estimate import InertialEstimate

UP = rotation_exp(np.array([0.3, 0.1, -0.2])) @ [0.0, -1.0, 0.0]


def estimate(sigma: float, biases: float) -> InertialEstimate:
    spread = sigma**2 * (np.eye(3) - np.outer(UP, UP))
    numbers = biases * np.arange(1.0, 13.0).reshape(4, 3)
    return InertialEstimate(UP, spread, np.eye(4), *numbers)


def write(folder: Path, goes_on: bool = False, first: int = 0) -> None:
    writer = InertialWriter(folder, goes_on)
    for k in range(first, first + 3):
        writer.add(10.0 + k, estimate(0.01 * (3 - k % 3), 1e-3 * k))
    writer.close()


def test_rows_come_back(tmp_path: Path):
    write(tmp_path)
    found = read_inertial_records(tmp_path)
    assert found is not None
    np.testing.assert_allclose(found.timestamp, [10, 11, 12])
    np.testing.assert_allclose(found.up, np.tile(UP, (3, 1)), rtol=1e-6)
    one = estimate(0.02, 1e-3)
    np.testing.assert_allclose(found.level[1], [one.roll, one.pitch, *one.sigmas], rtol=1e-6)
    np.testing.assert_allclose(found.tilt_sigma, [0.03, 0.02, 0.01], rtol=1e-6)
    np.testing.assert_allclose(found.biases[2], 2e-3 * np.arange(1, 7), rtol=1e-6)
    np.testing.assert_allclose(found.bias_sigmas[2], 2e-3 * np.arange(7, 13), rtol=1e-6)


def test_a_row_that_was_cut_off_does_not_count_and_a_run_goes_on(tmp_path: Path):
    assert read_inertial_records(tmp_path) is None
    write(tmp_path)
    path = tmp_path / INERTIAL_NAME
    path.write_text(path.read_text() + "13.0,0.1")
    assert len(read_inertial_records(tmp_path)) == 3
    cut_inertial_records(tmp_path, 11.0)
    assert read_inertial_records(tmp_path).timestamp.tolist() == [10.0, 11.0]
    write(tmp_path, goes_on=True, first=2)
    assert read_inertial_records(tmp_path).timestamp.tolist() == [10.0, 11.0, 12.0, 13.0, 14.0]


def test_a_wrong_file_is_named(tmp_path: Path):
    (tmp_path / INERTIAL_NAME).write_text(",".join(COLUMNS) + "\n1,2,x\n")
    with pytest.raises(InputError, match=r"inertial.csv: is no table of numbers"):
        read_inertial_records(tmp_path)
    (tmp_path / INERTIAL_NAME).write_text("timestamp\n")
    with pytest.raises(InputError, match="has other columns"):
        read_inertial_records(tmp_path)


def test_gravity_is_that_of_the_surest_frame(tmp_path: Path):
    write(tmp_path)
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, :3, :3] = rotation_exp(np.array([[0.0, 0.1 * k, 0.0] for k in range(4)]))
    covariances = np.tile(np.eye(6), (4, 1, 1)) * np.array([1.0, 1e-4, 1e-4, 1.0])[:, None, None]
    records = PoseRecords(np.array([9.0, 10.0, 11.0, 12.0]), poses, covariances, covariances)
    found = describe_gravity(read_inertial_records(tmp_path), records)["gravity"]
    # Frame 11 s is the surest: frame 12 s knows up better and its own rotation hardly.
    np.testing.assert_allclose(np.array(found["T_gravity"])[:3, :3] @ poses[2, :3, :3] @ UP, [0, 0, 1], atol=1e-6)
    assert found["sigma"] == pytest.approx(np.hypot(0.02, 0.01))
    assert found["since"] == 10.0
    assert describe_gravity(None, records) == {}
