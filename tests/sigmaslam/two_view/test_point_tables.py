"""`sigmaslam images triangulate` and `sigmaslam images orient`: from files to files."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from sigmaslam.geometry.camera import StereoCamera
from sigmaslam.geometry.se3 import se3_exp, se3_inverse
from sigmaslam.two_view.point_tables import triangulate_pairs
from sigmaslam.two_view.triangulation import METHODS
from tests.support.calibration_forms import raw_rig, rectified_rig, write_own
from tests.support.commands import assert_refused, run_here

SIGMA = 0.3
RIGS = {"radtan": raw_rig("radtan"), "fisheye": raw_rig("equidistant"), "rectified": rectified_rig()}


def scene(count: int, seed: int) -> np.ndarray:
    """(count, 3) points before the left camera."""
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-0.5, 0.5, (count, 2)), np.ones(count)]) * rng.uniform(1.0, 5.0, (count, 1))


def seen(camera: StereoCamera, points: np.ndarray) -> np.ndarray:
    T = se3_inverse(camera.T_left_right)
    return np.column_stack([camera.left.project(points), camera.right.project(points @ T[:3, :3].T + T[:3, 3])])


def write_csv(path: Path, header: str, rows: np.ndarray) -> Path:
    path.write_text("\n".join([header, *(",".join(map(repr, row)) for row in rows.tolist())]) + "\n")
    return path


def read_csv(path: Path) -> tuple[list[str], np.ndarray]:
    with path.open(newline="") as file:
        rows = list(csv.reader(file))
    return rows[0], np.array(rows[1:], float)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    "rig", [raw_rig("radtan"), raw_rig("equidistant"), rectified_rig()], ids=["radtan", "fisheye", "rectified"]
)
def test_exact_pixels_give_the_points(rig: StereoCamera, method: str):
    points = scene(20, seed=1)
    found, covariance = triangulate_pairs(rig, seen(rig, points), np.tile(SIGMA**2 * np.eye(4), (20, 1, 1)), method)
    np.testing.assert_allclose(found, points, atol=1e-6)
    assert np.all(np.linalg.eigvalsh(covariance) > 0.0)


def test_pixels_that_do_not_belong_together_are_told_of(tmp_path: Path):
    rig = RIGS["radtan"]
    pixels = seen(rig, scene(20, seed=1))
    calibration = write_own(rig, tmp_path)
    for rows, away, words in ((0.0, 0.0, None), (30.0, 0.0, "1 of the pairs miss"), (0.0, 1e4, "2 of the pairs miss")):
        pixels[4, 3] += rows
        pixels[5, 0] += away
        table = write_csv(tmp_path / "pixels.csv", "u0,v0,u1,v1", pixels)
        found = run_here("images", "triangulate", table, "--calibration", calibration, "--out", tmp_path / "points.csv")
        assert found.returncode == 0
        assert (words or "points") in found.stdout
        assert words or "miss" not in found.stdout


@pytest.mark.parametrize("method", METHODS)
def test_no_pair_of_pixels_keeps_the_others_from_their_points(method: str):
    """Of a thousand random ones the steps of four diverge."""
    rig, random = RIGS["radtan"], np.random.default_rng(0)
    eyes = (rig.left, rig.right)
    wild = np.column_stack([random.uniform(0, (eye.width, eye.height), (3_000, 2)) for eye in eyes])
    points = scene(20, seed=1)
    pixels = np.concatenate([seen(rig, points), wild])
    found, _ = triangulate_pairs(rig, pixels, np.tile(SIGMA**2 * np.eye(4), (len(pixels), 1, 1)), method)
    np.testing.assert_allclose(found[:20], points, atol=1e-6)


@pytest.mark.long
@pytest.mark.parametrize("method", METHODS)
def test_the_covariance_is_that_of_a_monte_carlo(method: str):
    rig, points = raw_rig("radtan"), scene(3, seed=2)
    pixels, rng = seen(rig, points), np.random.default_rng(3)
    _, covariance = triangulate_pairs(rig, pixels, np.tile(SIGMA**2 * np.eye(4), (3, 1, 1)), method)
    noisy = pixels + SIGMA * rng.standard_normal((4000, *pixels.shape))
    flat = noisy.reshape(-1, 4)
    found, _ = triangulate_pairs(rig, flat, np.tile(SIGMA**2 * np.eye(4), (len(flat), 1, 1)), method)
    errors = found.reshape(4000, 3, 3) - points
    sampled = np.einsum("sni,snj->nij", errors, errors) / 4000
    deviations = np.sqrt(np.diagonal(sampled, axis1=1, axis2=2) / np.diagonal(covariance, axis1=1, axis2=2))
    # 4,000 samples know a deviation to 1.1 %; the rest is what the first order leaves out.
    np.testing.assert_allclose(deviations, 1.0, atol=0.08)


def test_the_command_writes_points_and_leaves_out_what_meets_nowhere(tmp_path: Path):
    rig, points = rectified_rig(), scene(6, seed=4)
    calibration, pixels = write_own(rig, tmp_path), seen(rig, points)
    pixels[2] = pixels[2][[2, 3, 0, 1]]
    source, out = write_csv(tmp_path / "pixels.csv", "u0,v0,u1,v1", pixels), tmp_path / "points.csv"
    for method in METHODS:
        result = run_here(
            "triangulate", source, "--calibration", calibration, "--out", out, "--method", method, "--sigma", SIGMA
        )
        assert result.returncode == 0, result.stderr
        assert "5 points, 1 left out" in result.stdout
        header, values = read_csv(out)
        assert header[:5] == ["id", "x", "y", "z", "cov_xx"]
        assert values[:, 0].tolist() == [0.0, 1.0, 3.0, 4.0, 5.0]
        np.testing.assert_allclose(values[:, 1:4], np.delete(points, 2, axis=0), rtol=1e-6)
        # (9.36): the depth's sigma is Z^2 / (f B) times that of the disparity.
        expected = values[:, 3] ** 2 / (rig.left.fx * rig.baseline) * np.sqrt(2.0) * SIGMA
        np.testing.assert_allclose(np.sqrt(values[:, 9]), expected, rtol=0.02)


def test_matches_are_taken_with_their_covariance(tmp_path: Path):
    rig, points = rectified_rig(), scene(8, seed=5)
    pixels = seen(rig, points)
    covariance = np.tile(np.diag([0.04, 0.01]), (8, 1, 1))
    np.savez(tmp_path / "m.npz", keypoints0=pixels[:, :2], keypoints1=pixels[:, 2:], covariance=covariance)
    out = tmp_path / "points.csv"
    result = run_here(
        "images", "triangulate", tmp_path / "m.npz", "--calibration", write_own(rig, tmp_path), "--out", out
    )
    assert result.returncode == 0, result.stderr
    _, values = read_csv(out)
    expected = values[:, 3] ** 2 / (rig.left.fx * rig.baseline) * 0.2
    np.testing.assert_allclose(np.sqrt(values[:, 9]), expected, rtol=0.01)


@pytest.mark.parametrize("change", [np.diag([1000.0, 1000.0, 1000.0]), np.diag([1.0, 1.0, -1.0])])
def test_other_units_and_a_mirror_are_told_of(tmp_path: Path, change: np.ndarray):
    points = np.column_stack([np.arange(7.0), scene(7, seed=6)])
    source = write_csv(tmp_path / "a.csv", "id,x,y,z", points)
    points[:, 1:] = points[:, 1:] @ change
    control = write_csv(tmp_path / "b.csv", "id,x,y,z", points)
    assert "handedness" not in run_here("images", "orient", source, source, "--out", tmp_path / "p.json").stdout
    assert "units (--scale)" in run_here("images", "orient", source, control, "--out", tmp_path / "p.json").stdout


@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_control_points_give_the_frame(tmp_path: Path, scale: float):
    T = se3_exp(np.array([1.0, -2.0, 0.5, 0.3, -0.8, 1.1]))
    points = scene(7, seed=6)
    target = scale * points @ T[:3, :3].T + T[:3, 3]
    ids = np.arange(7.0)
    source = write_csv(tmp_path / "a.csv", "id,x,y,z", np.column_stack([ids, points]))
    # In another order, and with a point that the other file does not have.
    rows = np.column_stack([ids, target, np.full(7, 0.01)])[::-1]
    rows = np.vstack([rows, [99.0, 0.0, 0.0, 0.0, 0.01]])
    control, out = write_csv(tmp_path / "b.csv", "id,x,y,z,sigma", rows), tmp_path / "pose.json"
    result = run_here("images", "orient", source, control, "--out", out, *(["--scale"] if scale != 1.0 else []))
    assert result.returncode == 0, result.stderr
    content = json.loads(out.read_text())
    found = np.array(content["T_target_source"])
    np.testing.assert_allclose(points @ found[:3, :3].T + found[:3, 3], target, atol=1e-9)
    assert content["scale"] == pytest.approx(scale)
    # Of the centroid of seven points of 1 cm each.
    covariance = np.array(content["covariance"])
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)[:3]), 0.01 / np.sqrt(7.0), rtol=1e-6)


def test_bad_tables_are_refused(tmp_path: Path):
    rig = write_own(rectified_rig(), tmp_path)
    rest = ("--calibration", rig, "--out", tmp_path / "out.csv")
    wrong = write_csv(tmp_path / "a.csv", "u0,v0,u1", np.ones((1, 3)))
    assert_refused(
        run_here("images", "triangulate", wrong, *rest), "no column v1 in 'u0,v0,u1': give a header with u0,v0,u1,v1"
    )
    wrong = write_csv(tmp_path / "a.csv", "u0,v0,u1,v1", np.array([[1.0, 2.0, np.nan, 4.0]]))
    assert_refused(
        run_here("images", "triangulate", wrong, *rest), "a.csv, line 2: '1.0,2.0,nan,4.0' is not one finite number"
    )
    wrong.write_text("u0,v0,u1,v1\n320,5,240,1,300,2,240,0\n")
    assert_refused(run_here("images", "triangulate", wrong, *rest), "a.csv, line 2: '320,5,240,1,")
    wrong.write_text("u0,v0,u1,v1,sigma\n320,5,240,5,inf\n")
    assert_refused(run_here("images", "triangulate", wrong, *rest), "its sigma is not positive and finite")
    right = write_csv(tmp_path / "c.csv", "u0,v0,u1,v1", seen(rectified_rig(), scene(3, 7)))
    found = run_here("images", "triangulate", right, "--calibration", rig, "--out", tmp_path)
    assert_refused(found, "is a folder: give the name of a file in it")
    swapped = write_csv(tmp_path / "a.csv", "u0,v0,u1,v1", seen(rectified_rig(), scene(3, 7))[:, [2, 3, 0, 1]])
    assert_refused(run_here("images", "triangulate", swapped, *rest), "none of 3 pairs meets in front of the cameras")
    two = write_csv(tmp_path / "b.csv", "id,x,y,z", np.arange(8.0).reshape(2, 4))
    assert_refused(run_here("images", "orient", two, two, "--out", tmp_path / "p.json"), "have 2 ids in common")
    line = write_csv(tmp_path / "b.csv", "id,x,y,z", np.outer(np.arange(4.0), [1, 1, 1, 1]))
    assert_refused(run_here("images", "orient", line, line, "--out", tmp_path / "p.json"), "on a line")
