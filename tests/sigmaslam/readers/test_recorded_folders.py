"""Folders as TUM-VI, 4Seasons, ZED, RealSense and OAK write them, with images of the demo: found out and read alike."""

import logging
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from sigmaslam.errors import CalibrationError, InputError
from sigmaslam.geometry.camera import CameraModel, StereoCamera
from sigmaslam.readers import open_sequence
from tests.support import calibration_forms as forms
from tests.support.calibration_yaml import write_calibration
from tests.support.videos import write_video

FRAMES = 8
START = 1520530308199447626
STEP = 50_000_000


@pytest.fixture
def rig(demo_sequence: Path) -> StereoCamera:
    """Of the demo."""
    return open_sequence(demo_sequence).camera


def copy_images(demo: Path, left: Path, right: Path, name: str) -> None:
    """The first images of the demo; `name` is formatted with the eye, the number and the time in nanoseconds."""
    for eye, (source, folder) in enumerate(zip(("image_0", "image_1"), (left, right), strict=True)):
        folder.mkdir(parents=True, exist_ok=True)
        for k, path in enumerate(sorted((demo / source).iterdir())[:FRAMES]):
            shutil.copy(path, folder / name.format(eye=("left", "right")[eye], k=k, stamp=START + k * STEP))


def assert_is_the_demo(folder: Path, demo: Path, rig: StereoCamera, format: str) -> None:
    sequence = open_sequence(folder)
    assert (sequence.format, sequence.length) == (format, FRAMES)
    np.testing.assert_allclose(sequence.camera.T_left_right, rig.T_left_right, atol=1e-9)
    assert sequence.camera.left == rig.left
    frames = list(sequence.frames())
    for frame, true in zip(frames, open_sequence(demo).frames(), strict=False):
        np.testing.assert_array_equal(frame.left, true.left)
        np.testing.assert_array_equal(frame.right, true.right)
    assert len(frames) == FRAMES


def write_camchain(rig: StereoCamera, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cameras = {
        f"cam{k}": {
            "camera_model": "pinhole",
            "distortion_coeffs": [0.0, 0.0, 0.0, 0.0],
            "distortion_model": "radtan",
            "intrinsics": [eye.fx, eye.fy, eye.cx, eye.cy],
            "resolution": [eye.width, eye.height],
        }
        for k, eye in enumerate((rig.left, rig.right))
    }
    cameras["cam1"]["T_cn_cnm1"] = np.linalg.inv(rig.T_left_right).tolist()
    path.write_text(yaml.safe_dump(cameras))


def test_tum_vi_folder(tmp_path: Path, demo_sequence: Path, rig: StereoCamera):
    copy_images(demo_sequence, tmp_path / "mav0/cam0/data", tmp_path / "mav0/cam1/data", "{stamp}.png")
    write_camchain(rig, tmp_path / "dso" / "camchain.yaml")
    assert_is_the_demo(tmp_path, demo_sequence, rig, "euroc")
    assert open_sequence(tmp_path).timestamps[0] == pytest.approx(START / 1e9)


def test_tum_vi_folder_without_a_calibration(tmp_path: Path, demo_sequence: Path):
    copy_images(demo_sequence, tmp_path / "mav0/cam0/data", tmp_path / "mav0/cam1/data", "{stamp}.png")
    with pytest.raises(CalibrationError, match=r"cam0/sensor\.yaml: cannot read"):
        open_sequence(tmp_path)


@pytest.mark.parametrize("place", ["recording", "recording/calibration", "calibration", "Calibration"])
def test_four_seasons_recording(tmp_path: Path, demo_sequence: Path, rig: StereoCamera, place: str, monkeypatch):
    images = tmp_path / "recording" / "undistorted_images"
    copy_images(demo_sequence, images / "cam0", images / "cam1", "{stamp}.png")
    lines = [f"{START + k * STEP} {(START + k * STEP) / 1e9:.9f} 5.0\n" for k in range(FRAMES)]
    (tmp_path / "recording" / "times.txt").write_text("".join(lines))
    (tmp_path / place).mkdir(exist_ok=True)
    monkeypatch.setattr(forms, "SIZE", (rig.left.width, rig.left.height))
    forms.write_four_seasons(rig, tmp_path / place)
    assert_is_the_demo(tmp_path / "recording", demo_sequence, rig, "4seasons")
    np.testing.assert_allclose(np.diff(open_sequence(tmp_path / "recording").timestamps), 0.05, atol=1e-6)


def test_four_seasons_errors(tmp_path: Path, demo_sequence: Path):
    with pytest.raises(InputError, match="not a recording of 4Seasons"):
        open_sequence(tmp_path, "4seasons")
    images = tmp_path / "undistorted_images"
    copy_images(demo_sequence, images / "cam0", images / "cam1", "{stamp}.png")
    with pytest.raises(CalibrationError, match=r"no undistorted_calib_0\.txt, .* give one with --calibration"):
        open_sequence(tmp_path)
    copy_images(demo_sequence, images / "cam0", images / "cam1", "{k:06d}.png")
    with pytest.raises(InputError, match="times in nanoseconds"):
        open_sequence(tmp_path)


def test_realsense_folders(tmp_path: Path, demo_sequence: Path, rig: StereoCamera):
    copy_images(demo_sequence, tmp_path / "infra1", tmp_path / "infra2", "{k:06d}.png")
    write_camchain(rig, tmp_path / "d455-camchain.yaml")
    assert_is_the_demo(tmp_path, demo_sequence, rig, "folder")


def test_oak_folders(tmp_path: Path, demo_sequence: Path, rig: StereoCamera, monkeypatch):
    copy_images(demo_sequence, tmp_path / "left", tmp_path / "right", "{k:06d}.png")
    monkeypatch.setattr(forms, "SIZE", (rig.left.width, rig.left.height))
    forms.write_oak(rig, tmp_path)
    assert_is_the_demo(tmp_path, demo_sequence, rig, "folder")


def test_zed_export_in_one_folder(tmp_path: Path, demo_sequence: Path, rig: StereoCamera):
    copy_images(demo_sequence, tmp_path, tmp_path, "{eye}{k:06d}.png")
    with pytest.raises(CalibrationError, match="no calibration"):
        open_sequence(tmp_path)
    forms.write_zed(forms.raw_rig("radtan"), tmp_path)
    with pytest.raises(CalibrationError, match="is of raw images"):
        open_sequence(tmp_path)
    write_calibration(rig, tmp_path / "calibration.yaml")
    assert_is_the_demo(tmp_path, demo_sequence, rig, "folder")
    (tmp_path / "right000003.png").unlink()
    with pytest.raises(InputError, match=r"unequal left and right images: 8 in .*, 7 in"):
        open_sequence(tmp_path)


def test_zed_export_as_a_video(tmp_path: Path):
    zed = forms.raw_rig("radtan")
    rng = np.random.default_rng(0)
    frames = [rng.integers(0, 255, (zed.left.height, 2 * zed.left.width), dtype=np.uint8) for _ in range(3)]
    write_video(tmp_path / "export.avi", frames, 15.0)
    path = forms.write_zed(zed, tmp_path)
    with pytest.raises(CalibrationError, match=r"is of raw images.* give --calibration"):
        open_sequence(tmp_path / "export.avi")
    forms.assert_same_rig(open_sequence(tmp_path / "export.avi", calibration=path).camera, zed)


def test_raw_images_of_a_zed_take_its_factory_calibration(tmp_path: Path, caplog):
    zed = forms.raw_rig("radtan")
    for eye in ("left", "right"):
        (tmp_path / eye).mkdir()
        for k in range(2):
            cv2.imwrite(str(tmp_path / eye / f"{k}.png"), np.zeros((zed.left.height, zed.left.width), np.uint8))
    forms.write_zed(zed, tmp_path)
    with caplog.at_level(logging.WARNING):
        forms.assert_same_rig(open_sequence(tmp_path).camera, zed)
    assert "what the ZED SDK exports is rectified" in caplog.text


def test_a_real_folder_of_left_and_right_images(real_data: Path, tmp_path: Path):
    eye = CameraModel(640, 480, 536.0, 536.0, 342.0, 235.0)
    T = np.eye(4)
    T[0, 3] = 0.1
    write_calibration(StereoCamera(eye, eye, T), tmp_path / "stereo.yaml")
    sequence = open_sequence(real_data / "opencv_stereo_chessboard", calibration=tmp_path / "stereo.yaml")
    assert (sequence.format, sequence.length) == ("folder", 13)
