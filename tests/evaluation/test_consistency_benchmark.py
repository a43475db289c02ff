"""Statistics of consistency: known answers."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam_benchmarks.tracking.consistency import depths_around
from sigmaslam_benchmarks.tracking.consistency_page import DRAWN, ConsistencyResult, Scale, format_noise, format_page
from sigmaslam_benchmarks.tracking.map_consistency import (
    depth_edges,
    mean_with_error,
    point_nees,
    points_of_depth,
    ratio_with_error,
)
from sigmaslam_evaluation.metrics.trajectory_errors import coverage
from sigmaslam_synthetic.simulation import Recipe, Studio, simulate

CAMERA = RectifiedStereo(fx=100.0, fy=100.0, cx=31.5, cy=23.5, baseline=0.1, width=64, height=48)
GOOD = ConsistencyResult(
    nees=1.0,
    inside=0.95,
    nis=1.0,
    ate=0.002,
    path_length=2.0,
    offset_error=0.01,
    lost=0,
    point_nees=1.0,
    point_inside=0.95,
    point_gross=0.0,
    relative={"1 m": (1.1, 0.94), "1 s": (0.9, 0.96)},
)


def test_coverage_counts_what_is_inside_the_quantile_of_chi_square():
    # 95 % quantiles: 12.592 with 6 degrees of freedom, 7.815 with 3.
    assert coverage(np.array([0.5, 12.59 / 6, 12.60 / 6, 50.0]), 6) == 0.5
    assert coverage(np.array([7.81, 7.82]) / 3, 3) == 0.5
    assert math.isnan(coverage(np.zeros(0), 6))


def test_covariances_that_are_right_cover_95_percent_of_points_with_nees_1():
    rng = np.random.default_rng(0)
    factors = rng.standard_normal((20000, 3, 3))
    errors = (factors @ rng.standard_normal((20000, 3, 1)))[..., 0]
    truth = rng.standard_normal((20000, 3))
    nees = point_nees(truth + errors, factors @ factors.transpose(0, 2, 1), truth)
    assert nees.mean() == pytest.approx(1.0, abs=0.02)
    assert np.median(nees) == pytest.approx(2.366 / 3, abs=0.02)
    assert coverage(nees, 3) == pytest.approx(0.95, abs=0.005)


def test_one_sigma_off_in_each_axis_is_nees_1():
    covariance = np.diag([1.0, 4.0, 9.0])[None]
    assert point_nees(np.array([[1.0, -2.0, 3.0]]), covariance, np.zeros((1, 3))) == pytest.approx([1.0])


def test_means_come_with_their_standard_errors():
    assert mean_with_error([1.0, 2.0, 3.0]) == pytest.approx((2.0, 1.0 / math.sqrt(3)))
    assert mean_with_error([1.0, math.nan, 3.0]) == pytest.approx((2.0, 1.0))
    assert mean_with_error([4.0]) == pytest.approx((4.0, math.nan), nan_ok=True)
    assert mean_with_error([math.nan]) == pytest.approx((math.nan, math.nan), nan_ok=True)
    ratio, _ = ratio_with_error([2.0, 8.0], [1.0, 1.0])
    assert ratio == pytest.approx(4.0)


def test_points_of_a_slanted_plane_are_on_it_and_not_at_edges():
    normal, distance = np.array([0.2, 0.8, 0.5]), 2.0  # a floor seen at a grazing angle
    pixels = np.array([[10.3, 20.7], [50.0, 40.0], [31.5, 23.5]])
    v, u = np.mgrid[-1:2, -1:2]
    around = pixels[:, None, None] + np.stack([u, v], axis=-1)
    rays = np.concatenate([(around - [31.5, 23.5]) / 100.0, np.ones((3, 3, 3, 1))], axis=-1)
    depths = distance / (rays @ normal)
    assert not depth_edges(depths).any()
    assert (np.ptp(depths, axis=(1, 2)) > 0.02 * depths[:, 1, 1]).any()

    pose = np.eye(4)
    pose[:3, :3] = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    pose[:3, 3] = [1.0, 2.0, 3.0]
    points = points_of_depth(pixels, depths[:, 1, 1], CAMERA, np.stack([pose] * 3))
    assert ((points - pose[:3, 3]) @ pose[:3, :3]) @ normal == pytest.approx(np.full(3, distance))


def test_steps_of_depth_and_the_sky_are_edges():
    depths = np.full((4, 3, 3), 2.0)
    depths[1, 0, 2] = 2.1
    depths[2, 1, 1] = 1.95
    depths[3, 2, 0] = np.inf
    assert depth_edges(depths).tolist() == [False, True, True, True]


@pytest.mark.long
def test_depths_around_pixels_are_those_of_the_image():
    simulation = simulate(Recipe("room", 2, 3, width=64, height=48))
    studio = Studio(simulation)
    with torch.inference_mode():
        depth = studio.views(np.array([1]))[0].depth[0].numpy()
    depths = depths_around(studio, 1, np.array([[10.0, 20.0], [33.0, 7.0]]))
    assert depths == pytest.approx(np.stack([depth[19:22, 9:12], depth[6:9, 32:35]]))


def test_the_page_names_the_goals_that_are_missed():
    bad = replace(GOOD, nees=2.4, nis=0.5, relative={"1 s": (1.5, 0.8)})
    drawn = replace(GOOD, nees=3.3)
    results = {
        Scale("driving", "street", 64, 48): {"ours": [GOOD, GOOD], "EKF": [bad, bad], "ours, drawn": [drawn, drawn]},
        Scale("endoscope", "organ", 64, 48): {"ours": [bad, bad], "EKF": [GOOD, GOOD], "ours, drawn": [GOOD, GOOD]},
    }
    page = format_page(results, 0.3, 30, (1000, 2), "the command")
    goals, goals_drawn = page.split("## Goals, for ours with a calibration that is drawn")
    assert "Missed: NEES of poses per dof in endoscope (2.40); NIS per dof in endoscope (0.50)." in goals
    assert goals.count("**missed**") == 2
    assert "Missed: NEES of poses per dof in driving (3.30)." in goals_drawn
    assert goals_drawn.count("**missed**") == 1
    assert "seeds 1000 to 1001" in page
    assert "`the command`" in page
    rows = [line for line in page.splitlines() if line.startswith("| EKF |")]
    assert len(rows) == 6
    assert "| method | NEES 1 m | inside 1 m | NEES 1 s | inside 1 s |" in page
    assert "| EKF | - | - | 1.50 ± 0.00 | 80 ± 0 |" in rows
    assert "| EKF | 1.10 ± 0.00 | 94 ± 0 | 0.90 ± 0.00 | 96 ± 0 |" in rows
    widths = {line.count("|") for line in page.splitlines() if line.startswith(("| EKF |", "| ours |"))}
    assert widths == {5, 6, 9}


def test_the_page_of_noise_compares_own_covariances_with_one_on_the_same_sequence():
    own, worse = (
        [replace(GOOD, ate=0.001), replace(GOOD, ate=0.004)],
        [replace(GOOD, ate=0.002), replace(GOOD, ate=0.002)],
    )
    methods = {"ours": own, "one covariance": worse, f"one covariance, {DRAWN}": worse, f"ours, {DRAWN}": own[:1] * 2}
    page = format_noise({Scale("driving", "street", 64, 48): methods}, 0.3, 30, (1000, 2), "the command")
    rows = [line for line in page.splitlines() if line.startswith(("| driving", "| **all**"))]
    assert [row.split(" | ")[1:3] for row in rows] == [
        ["exact", "1.00 ± 0.69"],
        ["drawn", "0.50 ± 0.00"],
        ["exact", "1.00 ± 0.69"],
        ["drawn", "0.50 ± 0.00"],
        ["both", "0.71 ± 0.25"],
    ]
    assert {row.count("|") for row in rows} == {8}
