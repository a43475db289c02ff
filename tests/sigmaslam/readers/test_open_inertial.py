"""Inertial sensors in bags, and OXTS packets of KITTI raw."""

from pathlib import Path

import numpy as np
import pytest

from sigmaslam.errors import CalibrationError, InputError
from sigmaslam.readers import open_sequence
from sigmaslam.readers.open_inertial import open_imu
from sigmaslam.readers.oxts import estimate_densities
from tests.support.small_bags import IMU_COUNT, IMU_STEP, START, write_bag

NOISE = """gyroscope_noise_density: 1.0e-4
gyroscope_random_walk: 2.0e-5
accelerometer_noise_density: 3.0e-3
accelerometer_random_walk: 4.0e-3
"""
MOUNTING = "cam0:\n  T_cam_imu: [[1, 0, 0, 0.5], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n  timeshift_cam_imu: 0.02\n"


def bag(folder: Path, kind: str, known: bool = True, **options) -> Path:
    path = write_bag(folder / "bag", kind, (64, 48), **options)
    if known:
        (folder / "bag" / "imu.yaml").write_text(NOISE)
        (folder / "bag" / "camchain-imucam-bag.yaml").write_text(MOUNTING)
    return path if kind == "bag" else path.parent


@pytest.mark.parametrize("kind", ["bag", "db3", "mcap"])
@pytest.mark.parametrize("given", [None, "/imu/data", "imu/data"])
def test_the_topic_of_a_bag_is_read_with_kalibr_s_files_beside(tmp_path, kind, given):
    recording = open_imu(open_sequence(bag(tmp_path, kind, imu=["/imu/data"])), given)
    sensor = recording.sensor
    assert (sensor.gyro_density, sensor.accel_walk, sensor.time_shift) == (1e-4, 4e-3, 0.02)
    assert recording.sensor.T_left_imu[0, 3] == 0.5
    times = [(START + k * IMU_STEP) / 10**9 for k in range(IMU_COUNT)]
    np.testing.assert_array_equal(recording.samples.timestamp, times)
    values = np.hstack([recording.samples.gyro, recording.samples.accel])
    np.testing.assert_array_equal(values.ravel(), np.arange(6 * IMU_COUNT))


def test_samples_without_stamps_have_the_times_of_recording(tmp_path):
    recording = open_imu(open_sequence(bag(tmp_path, "bag", imu=["/imu"], stamped=False)), None)
    assert recording.samples.timestamp[1] == (START + IMU_STEP) / 10**9


def test_what_is_missing_is_said_and_images_are_tracked_alone(tmp_path, caplog):
    sequence = open_sequence(bag(tmp_path, "mcap", known=False, imu=["/imu"]))
    assert open_imu(sequence, None) is None
    assert "/imu not used: nothing says how noisy the sensor is: put recording.yaml beside it" in caplog.text
    with pytest.raises(CalibrationError, match="nothing says how noisy"):
        open_imu(sequence, "/imu")
    (tmp_path / "bag" / "imu.yaml").write_text(NOISE)
    with pytest.raises(CalibrationError, match=r"nothing says where the sensor is: give T_cam_imu in recording\.yaml"):
        open_imu(sequence, "/imu")
    assert open_imu(sequence, "off") is None


def test_of_several_topics_one_must_be_chosen(tmp_path, caplog):
    sequence = open_sequence(bag(tmp_path, "db3", imu=["/a/imu", "/b/imu"]))
    assert open_imu(sequence, None) is None
    assert "/a/imu and /b/imu not used: choose one with --imu TOPIC" in caplog.text
    assert len(open_imu(sequence, "/b/imu").samples) == IMU_COUNT
    with pytest.raises(InputError, match=r"no topic or file /c; .*\n  /a/imu: sensor_msgs/msg/Imu, 6"):
        open_imu(sequence, "/c")


def test_a_bag_without_a_sensor_says_nothing(tmp_path, caplog):
    assert open_imu(open_sequence(bag(tmp_path, "bag")), None) is None
    assert "not used" not in caplog.text


@pytest.fixture
def drive(tmp_path: Path, demo_sequence: Path) -> Path:
    """Packets as KITTI raw distributes them, with calibrations of a day."""
    folder = tmp_path / "2011_09_26_drive_0001_extract" / "oxts"
    (folder / "data").mkdir(parents=True)
    for k in range(4):
        (folder / "data" / f"{k:010d}.txt").write_text(" ".join(str(100 * k + each) for each in range(30)) + "\n")
    stamps = [f"2011-09-26 14:05:35.{k}00000000\n" for k in range(1, 5)]
    (folder / "timestamps.txt").write_text("".join(stamps))
    turn = "0 -1 0 0 0 -1 1 0 0"
    (tmp_path / "calib_imu_to_velo.txt").write_text("R: 1 0 0 0 1 0 0 0 1\nT: -0.8 0.3 -0.8\n")
    (tmp_path / "calib_velo_to_cam.txt").write_text(f"R: {turn}\nT: 0 -0.1 -0.3\n")
    P = "P_rect_00: 700 0 600 0 0 700 170 0 0 0 1 0\nP_rect_02: 700 0 600 42 0 700 170 0 0 0 1 0\n"
    original = "R_00: 1 0 0 0 1 0 0 0 1\nT_00: 0 0 0\n"
    (tmp_path / "calib_cam_to_cam.txt").write_text(f"R_rect_00: 0 -1 0 1 0 0 0 0 1\n{P}{original}")
    return folder


def test_packets_of_kitti_raw_are_an_inertial_sensor(drive, demo_sequence):
    recording = open_imu(open_sequence(demo_sequence), str(drive))
    # Both frames of KITTI's devices are forward, left, up; the camera's is right, down, forward, turned by R_rect.
    np.testing.assert_allclose(recording.sensor.T_left_imu @ [0, 0, 0, 1], [-0.7, -0.3, -1.1, 1], atol=1e-12)
    np.testing.assert_array_equal(recording.samples.gyro[2], [217, 218, 219])
    np.testing.assert_array_equal(recording.samples.accel[2], [211, 212, 213])
    np.testing.assert_allclose(np.diff(recording.samples.timestamp), 0.1, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("timestamps.txt", "2011-09-26 14:05:35.400000000\n", "", "3 times for 4 packets"),
        ("data/0000000002.txt", " 210 ", " nan ", r"0000000002.txt: expected a time and the 30 numbers"),
        ("data/0000000002.txt", " 210 ", " ", r"0000000002.txt: expected a time and the 30 numbers"),
        ("timestamps.txt", ":35.2", ":x", "expected a time"),
    ],
)
def test_wrong_packets_are_named(drive, demo_sequence, name, old, new, message):
    text = (drive / name).read_text()
    assert old in text
    (drive / name).write_text(text.replace(old, new))
    with pytest.raises(InputError, match=message):
        open_imu(open_sequence(demo_sequence), str(drive))


def test_packets_need_kitti_s_calibrations(drive, demo_sequence):
    (drive.parents[1] / "calib_imu_to_velo.txt").unlink()
    with pytest.raises(CalibrationError, match=r"put KITTI's calib_imu_to_velo\.txt"):
        open_imu(open_sequence(demo_sequence), str(drive))


def test_noise_is_estimated_beside_slow_motion():
    rng = np.random.default_rng(0)
    seconds = np.arange(0, 100, 0.01)
    slow = np.sin(seconds)[:, None] * np.ones(6)
    noise = np.repeat([0.01, 0.2], 3) * rng.normal(size=slow.shape)
    np.testing.assert_allclose(estimate_densities(seconds, slow + noise), [0.001, 0.02], rtol=0.05)


def test_packets_of_a_real_drive(real_data):
    folder = real_data / "kitti_raw_0926_0039_a"
    recording = open_imu(open_sequence(folder), str(folder / "oxts_packets.csv"))
    assert len(recording.samples) == 320
    assert np.linalg.norm(recording.samples.accel.mean(axis=0)) == pytest.approx(9.8, abs=0.1)
    assert 0.2 < np.diff(recording.samples.timestamp).max() < 0.3
