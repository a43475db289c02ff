"""`sigmaslam images geometry` on two rendered views whose motion is known."""

from importlib.resources import files
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from sigmaslam.cli.commands import app
from sigmaslam.errors import InputError
from sigmaslam.two_view.fundamental import FundamentalMatrix
from sigmaslam.two_view.image_geometry import ImageGeometry, estimate_geometry

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
    result = CliRunner().invoke(app, ["images", "geometry", *map(str, arguments)], catch_exceptions=False)
    assert result.exit_code == 0
    return result.stdout


@pytest.mark.long
def test_the_eyes_of_a_rectified_pair_are_found_beside_each_other_by_kitti_s_calibration(tmp_path: Path):
    picture, calibration = tmp_path / "pair.png", DEMO / "calib.txt"
    printed = run(
        IMAGES[0][0], IMAGES[1][0], "--calibration", calibration, "--eyes", "left,right", "--picture", picture
    )
    assert "Rotation: 0.0" in printed
    differs = [float(word) for word in printed.split("differs by")[1].replace("deg", " ").split() if word[0].isdigit()]
    assert differs[0] < 0.1
    assert differs[1] < 2.0
    drawn, image = cv2.imread(str(picture)), cv2.imread(str(IMAGES[0][0]), 0)
    assert drawn.shape == (2 * image.shape[0], 2 * image.shape[1], 3)


@pytest.mark.long
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


def turned(tmp_path: Path, calibration: Path) -> Path:
    """The first image as its camera would see it after a turn."""
    from sigmaslam.geometry.camera import StereoCamera

    K = StereoCamera.from_yaml(calibration).left.matrix
    R = cv2.Rodrigues(np.array([0.02, 0.08, 0.03]))[0]
    image, path = cv2.imread(str(IMAGES[0][0]), 0), tmp_path / "turned.png"
    cv2.imwrite(str(path), cv2.warpPerspective(image, K @ R @ np.linalg.inv(K), image.shape[::-1]))
    return path


@pytest.mark.long
def test_a_mere_turn_is_told_with_and_without_a_calibration(calibration: Path, tmp_path: Path):
    path = turned(tmp_path, calibration)
    printed = run(IMAGES[0][0], path, "--calibration", calibration)
    assert "direction of camera 1 is not known" in printed
    angle = float(printed.split("Rotation: ")[1].split()[0])
    assert angle == pytest.approx(np.degrees(np.linalg.norm([0.02, 0.08, 0.03])), abs=0.1)
    assert "epipoles are not known" in run(IMAGES[0][0], path)


@pytest.mark.long
def test_matches_in_one_corner_are_refused(tmp_path: Path):
    """All that both images show is one picture on grey walls."""
    paths = [tmp_path / f"{k}.png" for k in range(2)]
    corner = cv2.imread(str(IMAGES[0][0]), 0)[:120, :120]
    for path, shift in zip(paths, (0, 9), strict=True):
        wall = np.full((600, 900), 120, np.uint8)
        wall[10:130, 10 + shift : 130 + shift] = corner
        cv2.imwrite(str(path), wall)
    with pytest.raises(InputError, match="parts of the image"):
        run(*paths)


@pytest.mark.parametrize(
    ("second", "cells", "words"),
    [(20, 20, "Another 20 matches agree on another geometry"), (3, 5, "in 5 of 24 parts"), (3, 20, None)],
)
def test_a_second_geometry_and_crowded_inliers_are_told(second: int, cells: int, words: str | None):
    F = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]) / np.sqrt(2.0)
    fundamental = FundamentalMatrix(F, 1e-8 * np.eye(9), np.ones(30, bool))
    points = np.zeros((30, 2))
    printed = ImageGeometry(points, points, fundamental, None, 0.3, cells, second, (640, 480), None).describe()
    assert words in printed if words else "Another" not in printed and "parts" not in printed
