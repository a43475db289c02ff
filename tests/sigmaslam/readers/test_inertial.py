from pathlib import Path

import numpy as np
import pytest

from sigmaslam.errors import CalibrationError, InputError
from sigmaslam.geometry.se3 import se3_exp, se3_inverse
from sigmaslam.readers.inertial import find_imu, in_order, read_imu

NOISE = """gyroscope_noise_density: 1.6968e-04
gyroscope_random_walk: 1.9393e-05
accelerometer_noise_density: 2.0e-3
accelerometer_random_walk: 3.0e-3
"""
HEAD = "#timestamp [ns],w_RS_S_x [rad s^-1],w_y,w_z,a_RS_S_x [m s^-2],a_y,a_z\n"
ROWS = "".join(f"{1403636579758555392 + 5_000_000 * k},0.1,0.2,{k},9.8,0,-1.5\n" for k in range(5))
T_CAM_IMU = se3_exp(np.array([0.1, -0.2, 0.3, 0.4, 0.5, -0.6]))


def matrix(T: np.ndarray) -> str:
    return str(np.round(T, 12).tolist())


@pytest.fixture
def asl(tmp_path: Path) -> Path:
    """A EuRoC folder without images."""
    folder = tmp_path / "mav0" / "imu0"
    folder.mkdir(parents=True)
    (folder / "data.csv").write_text(HEAD + ROWS)
    (folder / "sensor.yaml").write_text(f"T_BS: {matrix(np.eye(4))}\n{NOISE}")
    (tmp_path / "mav0" / "cam0").mkdir()
    (tmp_path / "mav0" / "cam0" / "sensor.yaml").write_text(f"T_BS: {matrix(se3_inverse(T_CAM_IMU))}\n")
    return tmp_path


def test_euroc_s_table_and_sensors_are_read(asl):
    path = find_imu(asl)
    recording = read_imu(path)
    np.testing.assert_allclose(recording.sensor.T_left_imu, T_CAM_IMU, atol=1e-10)
    assert (recording.sensor.gyro_density, recording.sensor.accel_walk) == (1.6968e-4, 3e-3)
    np.testing.assert_allclose(np.diff(recording.samples.timestamp), 0.005, atol=1e-6)
    np.testing.assert_array_equal(recording.samples.gyro[3], [0.1, 0.2, 3])
    np.testing.assert_array_equal(recording.samples.accel[3], [9.8, 0, -1.5])


@pytest.mark.parametrize("stamp", [1e4, -5.0])
def test_one_stamp_of_another_time_costs_one_sample(stamp: float):
    seconds = 0.005 * np.arange(1000)
    seconds[300] = stamp
    np.testing.assert_array_equal(np.flatnonzero(~in_order(Path("imu.csv"), seconds)), [300])


def test_kalibr_s_files_beside_a_table_of_seconds_are_read(tmp_path):
    rows = "".join(f"{100 + 0.01 * k:.3f},0,0,0,0,0,9.81\n" for k in range(5))
    (tmp_path / "rig.csv").write_text("t,wx,wy,wz,ax,ay,az\n" + rows)
    (tmp_path / "imu.yaml").write_text(NOISE + "rostopic: /imu0\nupdate_rate: 100.0\n")
    chain = f"cam0:\n  T_cam_imu: {matrix(T_CAM_IMU)}\n  timeshift_cam_imu: -0.0123\ncam1: {{}}\n"
    (tmp_path / "camchain-imucam-rig.yaml").write_text(chain)
    recording = read_imu(tmp_path / "rig.csv")
    assert recording.sensor.time_shift == -0.0123
    assert recording.samples.timestamp[0] == 100.0
    np.testing.assert_allclose(recording.sensor.T_left_imu, T_CAM_IMU, atol=1e-10)
    own = f"{NOISE}T_cam_imu: {matrix(np.eye(4))}\n"
    (tmp_path / "rig.yaml").write_text(own)
    np.testing.assert_array_equal(read_imu(tmp_path / "rig.csv").sensor.T_left_imu, np.eye(4))


@pytest.mark.parametrize(
    ("name", "old", "new", "error", "message"),
    [
        ("data.csv", ",-1.5\n", "\n", InputError, r"line 2: expected time, angular rate"),
        ("data.csv", ",0.2,2,", ",0.2,nan,", InputError, r"line 4: expected time"),
        ("data.csv", "1403636579768555392", "1403636579758555391", InputError, r"1 of 5 time stamps do not increase"),
        ("data.csv", ROWS, "", InputError, r"has 0 samples"),
        ("sensor.yaml", NOISE, "", CalibrationError, r"nothing says how noisy"),
        ("sensor.yaml", "walk: 3.0e-3", "walk: -1", CalibrationError, r"accelerometer_random_walk is -1"),
        ("sensor.yaml", "[[1.0,", "[[2.0,", CalibrationError, r"T_BS is no rotation"),
    ],
)
def test_wrong_files_are_named(asl, name, old, new, error, message):
    path = asl / "mav0" / "imu0" / name
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(error, match=message):
        read_imu(asl / "mav0" / "imu0")


def test_a_sensor_whose_place_nobody_knows_is_not_used_by_itself(asl):
    (asl / "mav0" / "cam0" / "sensor.yaml").unlink()
    assert find_imu(asl) is None
    with pytest.raises(CalibrationError, match="nothing says where the sensor is"):
        read_imu(asl / "mav0" / "imu0")


@pytest.mark.parametrize("force", ["", ",,,"])
def test_a_gyro_alone_has_no_columns_of_force(tmp_path, force):
    rows = [f"{100 + 0.01 * k:.3f},0.1,0.2,{k}{force}\n" for k in range(5)]
    (tmp_path / "rig.csv").write_text("t,wx,wy,wz\n" + "".join(rows))
    own = "gyroscope_noise_density: 1e-3\ngyroscope_random_walk: 1e-5\n"
    (tmp_path / "rig.yaml").write_text(f"{own}T_cam_imu: {matrix(np.eye(4))}\n")
    recording = read_imu(tmp_path / "rig.csv")
    assert not recording.sensor.has_accelerometer
    np.testing.assert_array_equal(recording.samples.gyro[3], [0.1, 0.2, 3])
    np.testing.assert_array_equal(recording.samples.accel, 0.0)
    (tmp_path / "rig.csv").write_text("".join([*rows, "101,0,0,0,0,0,9.8\n"]))
    with pytest.raises(InputError, match="5 of 6 rows lack the specific force"):
        read_imu(tmp_path / "rig.csv")


@pytest.mark.long
def test_real_recordings_have_a_sensor(real_data):
    for name, count in (("euroc_mh01_f000_099", 1290), ("euroc_v1_01_keyframes_a", 21051)):
        assert len(read_imu(find_imu(real_data / name)).samples) == count
