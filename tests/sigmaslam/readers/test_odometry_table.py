from pathlib import Path

import numpy as np
import pytest

from sigmaslam.errors import CalibrationError, InputError
from sigmaslam.readers.odometry import read_odometry

YAML = "T_cam_base: [[0, -1, 0, 0.1], [0, 0, -1, 0.2], [1, 0, 0, 0.3], [0, 0, 0, 1]]\n"
ROWS = ["10.0,0.5,0.01", "10.1,0.6,0.02", "10.2,0.7,0.03"]


def write(folder: Path, head: str, rows: list[str], yaml: str | None = YAML) -> Path:
    path = folder / "wheels.csv"
    path.write_text("\n".join([head, *rows]) + "\n")
    if yaml is not None:
        path.with_suffix(".yaml").write_text(yaml)
    return path


@pytest.mark.parametrize("head", ["timestamp,speed,yaw_rate", "#t, vx [m s^-1], wz [rad s^-1]", "Time,Speed,Yaw_Rate"])
def test_speed_and_yaw_rate_are_a_twist(tmp_path, head):
    recording = read_odometry(write(tmp_path, head, ROWS, YAML + "timeshift_cam_base: -0.05\n"))
    assert recording.sensor.time_shift == -0.05
    np.testing.assert_array_equal(recording.sensor.T_left_base[:3, 3], [0.1, 0.2, 0.3])
    np.testing.assert_array_equal(recording.samples.timestamp, [10.0, 10.1, 10.2])
    np.testing.assert_array_equal(recording.samples.linear[1], [0.6, 0, 0])
    np.testing.assert_array_equal(recording.samples.angular[1], [0, 0, 0.02])
    assert recording.sensor.is_planar


def test_columns_may_stand_in_any_order_and_stamps_in_nanoseconds(tmp_path):
    rows = [f"{1403636579758555392 + 10**7 * k},1,2,3,4,5,6,x" for k in range(3)]
    recording = read_odometry(write(tmp_path, "timestamp,wz,wy,wx,vz,vy,vx,note", rows))
    assert not recording.sensor.is_planar
    np.testing.assert_array_equal(recording.samples.linear[0], [6, 5, 4])
    np.testing.assert_array_equal(recording.samples.angular[0], [3, 2, 1])
    np.testing.assert_allclose(np.diff(recording.samples.timestamp), 0.01, atol=1e-6)


@pytest.mark.parametrize(
    ("head", "rows", "yaml", "error", "message"),
    [
        ("timestamp,speed", ROWS, YAML, InputError, "line 1: no column wz or yaw_rate in timestamp,speed"),
        ("10.0,0.5,0.01", ROWS, YAML, InputError, "line 1: no column timestamp or time or t"),
        ("t,vx,wz", ["1,2", "2,2,2"], YAML, InputError, r"line 2: expected numbers under t,vx,wz, found 1,2"),
        ("t,vx,wz", ["1,2,2", "2,2,inf"], YAML, InputError, "line 3: expected numbers"),
        ("t,vx,wz", ["1,2,2"], YAML, InputError, "has 1 samples"),
        ("t,vx,wz", ["2,2,2", "1,2,2"], YAML, InputError, "1 of 2 time stamps do not increase"),
        ("t,vx,wz", ROWS, None, CalibrationError, r"put wheels\.yaml beside it, with T_cam_base"),
        ("t,vx,wz", ROWS, YAML.replace("[1, 0,", "[2, 0,"), CalibrationError, "T_cam_base is no rotation"),
    ],
)
def test_wrong_files_are_named(tmp_path, head, rows, yaml, error, message):
    with pytest.raises(error, match=message):
        read_odometry(write(tmp_path, head, rows, yaml))
