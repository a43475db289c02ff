"""`sigmaslam calibrate` and `sigmaslam calibrate rectify` on rendered boards and real ones."""

from __future__ import annotations

import csv
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from sigmaslam.calibration.board_images import find_board_images, read_board_views
from sigmaslam.calibration.boards import AprilGrid, Board, parse_board
from sigmaslam.calibration.calibrate import BoardCalibration, calibrate
from sigmaslam.calibration.image_bootstrap import RESAMPLES, bootstrap_rigs, widened
from sigmaslam.errors import InputError
from sigmaslam.geometry.camera import StereoCamera
from sigmaslam.geometry.se3 import se3_exp, se3_inverse
from sigmaslam.readers import open_sequence
from tests.support.commands import assert_refused, run_here
from tests.support.simulated_board import APRIL_GRID, CHARUCO, CHESSBOARD, board_poses, draw_board, stereo_rig

BOARD = "chessboard:9x6:0.025"
REAL = {
    "euroc": ("euroc_stereo_calib_a/images", "aprilgrid:6x6:0.088:0.3", 30, 0.28),
    "opencv": ("opencv_stereo_chessboard", BOARD, 13, 0.215),
}


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with left and right images of a chessboard."""
    folder = tmp_path_factory.mktemp("board")
    rig = stereo_rig()
    for k, pose in enumerate(board_poses(CHESSBOARD, 12, seed=11, depth=0.5)):
        cv2.imwrite(str(folder / f"left{k:02d}.png"), draw_board(CHESSBOARD, rig.eyes[0], pose))
        in_right = se3_inverse(rig.T_left_right) @ pose
        cv2.imwrite(str(folder / f"right{k:02d}.png"), draw_board(CHESSBOARD, rig.eyes[1], in_right))
    return folder


@pytest.mark.long
def test_a_picture_is_drawn_where_one_eye_lacks_the_last_image(rendered: Path, tmp_path: Path):
    folder = shutil.copytree(rendered, tmp_path / "board")
    (folder / "right11.png").unlink()
    out, picture = tmp_path / "stereo.yaml", tmp_path / "corners.png"
    result = run_here("calibrate", folder, "--board", BOARD, "--out", out, "--picture", picture)
    assert result.returncode == 0, result.stderr
    assert picture.is_file()


@pytest.mark.long
def test_a_rendered_pair_is_calibrated_and_rectified(rendered: Path, tmp_path: Path):
    out, picture = tmp_path / "stereo.yaml", tmp_path / "corners.png"
    result = run_here("calibrate", rendered, "--board", BOARD, "--out", out, "--picture", picture)
    assert result.returncode == 0, result.stderr
    assert "coverage  left" in result.stdout
    assert "baseline  " in result.stdout
    assert cv2.imread(str(picture)) is not None
    camera, true = StereoCamera.from_yaml(out), stereo_rig()
    assert camera.left.fx == pytest.approx(true.eyes[0].fx, abs=2.0)
    assert camera.baseline == pytest.approx(np.linalg.norm(true.T_left_right[:3, 3]), abs=1e-3)
    assert camera.covariance is not None
    content = yaml.safe_load(out.read_text())
    assert content["residuals"]["rms"] < 0.15
    shown = set(content["residuals"]["outlier_images"])
    assert content["residuals"]["images"] + len(shown) == 12
    covariance = np.array(content["parameters"]["covariance"])
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), content["parameters"]["sigmas"], rtol=1e-6)

    rectified = tmp_path / "rectified"
    result = run_here("calibrate", "rectify", rendered, "--calibration", out, "--out", rectified)
    assert result.returncode == 0, result.stderr
    sequence = open_sequence(rectified)
    assert sequence.camera.is_rectified
    assert sequence.camera.covariance is not None
    frames = list(sequence.frames())
    assert len(frames) == 12
    rows = []
    for frame in frames:
        left, right = (CHESSBOARD.detect(image) for image in (frame.left, frame.right))
        if len(left) and len(right):
            rows.append(left.pixels[:, 1] - right.pixels[:, 1])
    assert len(rows) >= 5
    assert np.sqrt(np.mean(np.square(rows))) < 0.3
    assert_refused(
        run_here("calibrate", "rectify", rendered, "--calibration", out, "--out", rectified), "is not an empty folder"
    )


@pytest.mark.long
@pytest.mark.parametrize(
    ("plan", "words"),
    [(CHARUCO, "charuco:7x5:0.035:0.025:DICT_5X5_100"), (APRIL_GRID, "aprilgrid:4x3:0.05:0.3")],
    ids=["charuco", "aprilgrid"],
)
def test_boards_with_markers_calibrate_a_pair(tmp_path: Path, plan: Board, words: str):
    rig, out = stereo_rig(), tmp_path / "stereo.yaml"
    centre, turn = np.eye(4), np.eye(4)
    centre[:3, 3] = plan.points.mean(axis=0)
    if isinstance(plan, AprilGrid):
        # Its y goes up: the camera would see it from behind.
        turn = centre @ se3_exp(np.array([0.0, 0.0, 0.0, np.pi, 0.0, 0.0])) @ se3_inverse(centre)
    for k, pose in enumerate(board_poses(plan, 12, seed=3, depth=0.4) @ turn):
        for name, eye, T_left_eye in (("L", rig.eyes[0], np.eye(4)), ("R", rig.eyes[1], rig.T_left_right)):
            (tmp_path / name).mkdir(exist_ok=True)
            cv2.imwrite(str(tmp_path / name / f"{k}.png"), draw_board(plan, eye, se3_inverse(T_left_eye) @ pose))
    result = run_here("calibrate", tmp_path, "--board", words, "--out", out)
    assert result.returncode == 0, result.stderr
    content = yaml.safe_load(out.read_text())
    assert content["residuals"]["rms"] < 0.15
    assert content["residuals"]["images"] >= 10
    camera, parameters = StereoCamera.from_yaml(out), content["parameters"]
    sigmas = dict(zip(parameters["names"], parameters["sigmas"], strict=True))
    for found, true, name in ((camera.left, rig.eyes[0], "left"), (camera.right, rig.eyes[1], "right")):
        for key in ("fx", "fy", "cx", "cy"):
            assert abs(getattr(found, key) - getattr(true, key)) < 4.0 * sigmas[f"{name}.{key}"]
    assert camera.baseline == pytest.approx(np.linalg.norm(rig.T_left_right[:3, 3]), rel=2e-3)
    if isinstance(plan, AprilGrid):
        wrong = run_here("calibrate", tmp_path, "--board", "aprilgrid:4x3:0.05:0.2", "--out", out)
        assert re.search(r"residuals of \d\.\d+ px .*another --board", wrong.stdout)
        turned = run_here("calibrate", tmp_path, "--board", "aprilgrid:3x4:0.05:0.3", "--out", out)
        assert_refused(turned, "another one?")


@pytest.mark.long
def test_one_camera_is_calibrated(rendered: Path, tmp_path: Path):
    out = tmp_path / "left.yaml"
    result = run_here("calibrate", *sorted(rendered.glob("left*")), "--board", BOARD, "--out", out, "--lens", "radtan4")
    assert result.returncode == 0, result.stderr
    camera = yaml.safe_load(out.read_text())["camera"]
    assert camera["fx"] == pytest.approx(stereo_rig().eyes[0].fx, abs=2.0)
    assert len(camera["distortion"]) == 4


@pytest.mark.long
def test_bad_requests_are_refused(rendered: Path, tmp_path: Path):
    out = tmp_path / "stereo.yaml"
    assert_refused(run_here("calibrate", rendered, "--board", "grid", "--out", out), "--board is 'grid'")
    assert_refused(run_here("calibrate", rendered, "--board", BOARD, "--out", tmp_path / "a.xml"), "is YAML")
    assert_refused(run_here("calibrate", tmp_path / "no", "--board", BOARD, "--out", out), "no such file or folder")
    nowhere = run_here("calibrate", rendered, "--board", BOARD, "--out", tmp_path / "nowhere" / "stereo.yaml")
    assert_refused(nowhere, "there is no folder")
    assert run_here("calibrate", rendered, "--board", BOARD, "--out", out, "--seed", "-1").returncode == 2
    wrong = run_here("calibrate", rendered, "--board", "chessboard:13x4:0.025", "--out", out)
    assert_refused(wrong, "the board is found in none of 12 images: check --board")
    assert not out.exists()


def test_files_of_other_sizes_are_refused(tmp_path: Path):
    for k, size in enumerate([(20, 30), (20, 31)]):
        cv2.imwrite(str(tmp_path / f"image{k}.png"), np.zeros(size, np.uint8))
    with pytest.raises(InputError, match=r"image1.png: image is 31x20, those before 30x20"):
        read_board_views(find_board_images([tmp_path]), CHESSBOARD, lambda: None)


@pytest.mark.parametrize(
    ("names", "pairs"),
    [
        (("left1.png", "left2.png", "right1.png", "right2.png"), 2),
        (("cam0/1.png", "cam1/1.png", "cam1/2.png"), 2),
        (("cam0/data/1.png", "cam1/data/1.png"), 1),
        (("7_0.png", "7_1.png", "8_1.png", "8_0.png"), 2),
        (("left1.png", "left2.png"), 0),
        (("a.png", "b.png"), 0),
    ],
)
def test_names_tell_the_eyes(tmp_path: Path, names: tuple[str, ...], pairs: int):
    for name in names:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    found = find_board_images([tmp_path / name for name in names])
    assert len(found) == (pairs or len(names))
    assert {len(each.files) for each in found} == {2 if pairs else 1}
    assert sorted(file for each in found for file in each.files if file) == sorted(tmp_path / name for name in names)
    if pairs:
        assert any(all(each.files) for each in found)


def real_calibration(real_data: Path, name: str) -> BoardCalibration:
    folder, board, _, _ = REAL[name]
    plan = parse_board(board)
    seen = read_board_views(find_board_images([real_data / folder]), plan, lambda: None)
    return calibrate(seen.names, seen.views, plan.points, seen.sizes, "radtan5")


@pytest.fixture(scope="module")
def real_results(real_data: Path) -> dict[str, BoardCalibration]:
    return {name: real_calibration(real_data, name) for name in REAL}


@pytest.mark.slow
@pytest.mark.parametrize("name", REAL)
def test_real_boards_fit_and_every_image_is_used_or_named(real_results: dict[str, BoardCalibration], name: str):
    result, (_, _, images, rms) = real_results[name], REAL[name]
    assert result.rms <= rms
    assert len(result.names) + len(result.outlier_images) == images
    assert len(result.outlier_corners) < 0.02 * len(result.corners)
    for eye in result.rig.eyes:
        # Where the board was, on every lens.
        pixels = result.corners.pixels
        np.testing.assert_allclose(eye.project(eye.unproject(pixels)), pixels, atol=1e-6)


@pytest.mark.slow
def test_the_baseline_of_euroc_is_that_of_its_own_calibration(real_results: dict[str, BoardCalibration]):
    assert np.linalg.norm(real_results["euroc"].rig.T_left_right[:3, 3]) == pytest.approx(0.11008, abs=1e-3)


@pytest.mark.slow
def test_corners_of_the_grid_are_those_that_another_detector_found(real_data: Path):
    folder = real_data / "euroc_stereo_calib_a"
    with (folder / "corners.csv").open() as file:
        rows = list(csv.DictReader(file))
    board = parse_board("aprilgrid:6x6:0.088:0.3")
    for name in ("3_0", "17_1"):
        frame, eye = name.split("_")
        theirs = {
            int(row["corner_id"]): (float(row["u_px"]), float(row["v_px"]))
            for row in rows
            if (row["frame"], row["cam"]) == (frame, eye)
        }
        found = board.detect(cv2.imread(str(folder / "images" / f"{name}.jpg"), cv2.IMREAD_GRAYSCALE))
        both = [k for k, corner in enumerate(found.ids.tolist()) if corner in theirs]
        assert len(both) > 0.6 * len(theirs)
        apart = np.linalg.norm(found.pixels[both] - [theirs[int(found.ids[k])] for k in both], axis=1)
        assert np.median(apart) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize(("name", "resamples"), [("euroc", 60), ("opencv", 200)])
def test_sigmas_are_those_of_a_bootstrap_over_images(
    real_results: dict[str, BoardCalibration], name: str, resamples: int
):
    """By half the central 68 % and by the standard deviation, which differ where resamples have heavy tails."""
    result = widened(real_results[name], bootstrap_rigs(real_results[name], RESAMPLES, seed=0))
    differences = bootstrap_rigs(result, resamples, seed=1)
    low, high = np.quantile(differences, [0.16, 0.84], axis=0)
    for spread in ((high - low) / 2.0, differences.std(axis=0)):
        ratios = spread / result.sigmas
        assert np.all(ratios < 1.6), dict(zip(result.rig.names, ratios, strict=True))
        assert np.all(ratios > 1.0 / 1.6), dict(zip(result.rig.names, ratios, strict=True))
