"""`sigmaslam geometry` on two rendered views whose motion is known."""

from importlib.resources import files
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from sigmaslam.cli.commands import app
from sigmaslam.errors import InputError
from sigmaslam.two_view.image_geometry import estimate_geometry

DEMO = Path(str(files("sigmaslam_synthetic") / "demo"))
IMAGES = sorted((DEMO / "image_0").glob("*.png")), sorted((DEMO / "image_1").glob("*.png"))


@pytest.fixture
def calibration(tmp_path: Path) -> Path:
    numbers = np.loadtxt(DEMO / "calib.txt", usecols=range(1, 13)).reshape(-1, 3, 4)
    K, (height, width) = numbers[0][:, :3], cv2.imread(str(IMAGES[0][0]), 0).shape
    eye = f"{{width: {width}, height: {height}, fx: {K[0, 0]}, fy: {K[1, 1]}, cx: {K[0, 2]}, cy: {K[1, 2]}}}"
    baseline = -numbers[1][0, 3] / K[0, 0]
    path = tmp_path / "stereo.yaml"
    path.write_text(f"left: {eye}\nright: {eye}\nT_left_right: [[1,0,0,{baseline}],[0,1,0,0],[0,0,1,0],[0,0,0,1]]\n")
    return path


def run(*arguments: object) -> str:
    result = CliRunner().invoke(app, ["geometry", *map(str, arguments)], catch_exceptions=False)
    assert result.exit_code == 0
    return result.stdout


def test_the_eyes_of_a_rectified_pair_are_found_beside_each_other(calibration: Path, tmp_path: Path):
    picture = tmp_path / "pair.png"
    printed = run(
        IMAGES[0][0], IMAGES[1][0], "--calibration", calibration, "--eyes", "left,right", "--picture", picture
    )
    assert "Rotation: 0.0" in printed
    differs = [float(word) for word in printed.split("differs by")[1].replace("deg", " ").split() if word[0].isdigit()]
    assert differs[0] < 0.1
    assert differs[1] < 2.0
    drawn, image = cv2.imread(str(picture)), cv2.imread(str(IMAGES[0][0]), 0)
    assert drawn.shape == (2 * image.shape[0], 2 * image.shape[1], 3)


def test_the_motion_between_two_frames_agrees_with_the_truth(calibration: Path):
    from sigmaslam.geometry.camera import StereoCamera

    poses = np.loadtxt(DEMO / "poses.txt").reshape(-1, 3, 4)
    left = StereoCamera.from_yaml(calibration).left
    found = estimate_geometry(*(cv2.imread(str(IMAGES[0][k]), 0) for k in (0, 12)), models=(left, left))
    assert found is not None
    assert found.pose is not None
    R, t = poses[12][:, :3].T @ poses[0][:, :3], poses[12][:, :3].T @ (poses[0][:, 3] - poses[12][:, 3])
    error = np.r_[t / np.linalg.norm(t) - found.pose.direction, cv2.Rodrigues(R @ found.pose.R.T)[0].ravel()]
    assert np.degrees(np.linalg.norm(error[3:])) < 0.2
    assert np.degrees(np.linalg.norm(error[:3])) < 5.0


def test_without_calibration_it_says_where_the_other_camera_is_seen():
    printed = run(IMAGES[0][0], IMAGES[0][12])
    assert "agree on one geometry" in printed
    assert "Camera 1 is seen by image 0" in printed


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--eyes", "left"), "two of left and right"),
        (("--eyes", "left,middle"), "'middle'"),
        (("--picture", "epipolar.jpg"), "does not end in .png"),
        (("--calibration", "none.yaml"), "none.yaml"),
    ],
)
def test_wrong_options_are_named(arguments: tuple[str, ...], words: str):
    with pytest.raises(InputError, match=words):
        run(IMAGES[0][0], IMAGES[0][1], *arguments)


def test_images_of_nothing_in_common_have_no_geometry(tmp_path: Path):
    rng = np.random.default_rng(0)
    paths = [tmp_path / f"{k}.png" for k in range(2)]
    for path in paths:
        cv2.imwrite(str(path), rng.integers(0, 255, (200, 300), np.uint8))
    with pytest.raises(InputError, match="same scene"):
        run(*paths)


def test_an_image_of_another_size_than_the_calibration_s_is_named(calibration: Path, tmp_path: Path):
    path = tmp_path / "small.png"
    cv2.imwrite(str(path), cv2.resize(cv2.imread(str(IMAGES[0][0]), 0), None, fx=0.5, fy=0.5))
    with pytest.raises(InputError, match=r"small\.png"):
        run(path, IMAGES[0][0], "--calibration", calibration)
