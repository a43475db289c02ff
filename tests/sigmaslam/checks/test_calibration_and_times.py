"""Calibrations and time stamps whose units or places are those of a mistake."""

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest

from sigmaslam.checks.calibration import check_calibration
from sigmaslam.checks.finding import Finding
from sigmaslam.checks.images import blur_radius, check_images, check_overlay
from sigmaslam.checks.time_stamps import check_time_stamps
from sigmaslam.geometry.camera import CameraModel, StereoCamera
from tests.support.estimates import Demo

GOOD = CameraModel(752, 480, 458.7, 457.3, 367.2, 248.4)


def judge(left: CameraModel = GOOD, right: CameraModel = GOOD, baseline: float = 0.11) -> dict[str, tuple[str, str]]:
    T = np.eye(4)
    T[0, 3] = baseline
    return {each.name: (each.severity, each.message) for each in check_calibration(StereoCamera(left, right, T))}


@pytest.mark.parametrize("baseline", [0.004, 0.11, 2.9])
def test_baselines_of_endoscopes_to_lorries_are_good(baseline: float):
    assert judge(baseline=baseline)["baseline"][0] == "ok"


@pytest.mark.parametrize(
    ("baseline", "words"),
    [(110.0, "millimetres (0.11 m)"), (11.0, "centimetres (0.11 m)"), (1e-6, "in metres"), (110e3, "micrometres")],
)
def test_other_baselines_name_the_likely_unit(baseline: float, words: str):
    severity, message = judge(baseline=baseline)["baseline"]
    assert severity == "warning"
    assert words in message


@pytest.mark.parametrize("eye", ["left", "right"])
def test_a_principal_point_of_another_image_size_is_named_in_either_eye(eye: str):
    double = replace(GOOD, fx=2 * GOOD.fx, fy=2 * GOOD.fy, cx=2 * GOOD.cx, cy=2 * GOOD.cy)
    severity, message = judge(**{eye: double})["principal point"]
    assert severity == "warning"
    assert eye in message
    assert "1504x960" in message
    assert "0.5" in message


def test_principal_points_a_sixth_from_the_middle_are_good():
    assert judge(left=replace(GOOD, cx=GOOD.cx + 752 / 6))["principal point"][0] == "ok"


def test_exchanged_coordinates_of_the_principal_point_are_named():
    severity, message = judge(left=replace(GOOD, cx=GOOD.cy, cy=GOOD.cx))["principal point"]
    assert severity == "warning"
    assert "exchanged" in message


@pytest.mark.parametrize(
    ("model", "words"),
    [
        (replace(GOOD, fx=4.0, fy=4.0), "in pixels"),
        (replace(GOOD, fx=50_000.0, fy=50_000.0), "in pixels"),
        (replace(GOOD, fx=0.5 * GOOD.fx), "square"),
    ],
)
def test_focal_lengths_that_no_camera_has_are_named(model: CameraModel, words: str):
    severity, message = judge(left=model)["focal length"]
    assert severity == "warning"
    assert words in message


def test_a_fisheye_lens_may_see_more_than_a_plane_holds():
    fisheye = replace(GOOD, fx=60.0, fy=60.0, distortion_model="equidistant", distortion=(0.0, 0.0, 0.0, 0.0))
    assert judge(left=fisheye, right=fisheye)["focal length"][0] == "ok"


@pytest.mark.parametrize(
    ("interval", "severity", "words"),
    [
        (0.05, "ok", ""),
        (0.002, "ok", ""),
        (4.0, "ok", ""),
        (100.0, "warning", "milliseconds (0.1 s)"),
        (5e4, "warning", "microseconds (0.05 s)"),
        (33_333_333.0, "warning", "nanoseconds (0.03333 s)"),
        (1e-4, "warning", "give seconds"),
    ],
)
def test_the_likely_unit_of_time_stamps_is_named(interval: float, severity: str, words: str):
    finding = check_time_stamps([interval, interval, 7 * interval])
    assert finding.severity == severity
    assert words in finding.message


def test_the_blur_of_a_step_is_its_standard_deviation():
    """Of a step smoothed by a Gaussian, sampled as pixels are."""
    from math import erf

    u = np.arange(200) - 99.7
    for sigma in (2.0, 4.0, 6.0):
        row = np.array([128 + 100 * erf(each / (sigma * 2**0.5)) for each in u])
        image = np.tile(np.rint(row).astype(np.uint8), (120, 1))
        # The measure smooths a little itself, and grey values are rounded.
        assert blur_radius(image) == pytest.approx(sigma, rel=0.15)


def test_images_that_differ_by_less_than_noise_are_the_same():
    rng = np.random.default_rng(0)
    left = rng.integers(0, 255, (120, 160)).astype(np.uint8)
    noisy = np.clip(left + rng.normal(scale=3.0, size=left.shape), 0, 255).astype(np.uint8)
    assert {each.name: each.severity for each in check_images([(left, left.copy())])}["same image"] == "error"
    assert {each.name: each.severity for each in check_images([(left, noisy)])}["same image"] == "ok"


def test_interlaced_images_and_raw_mosaics_are_named_and_noise_is_not():
    rng = np.random.default_rng(0)
    image = cv2.GaussianBlur(rng.normal(0.0, 900.0, (120, 160)), (0, 0), 4.0) + 128.0
    interlaced, mosaic = image.copy(), image.copy()
    interlaced[1::2] = np.roll(image, 3, axis=1)[1::2]
    mosaic[::2, ::2] *= 0.7

    def found(scene: np.ndarray, noise: float) -> Finding:
        pair = [np.clip(scene + rng.normal(0.0, noise, scene.shape), 0, 255).astype(np.uint8) for _ in range(2)]
        return next(each for each in check_images([(pair[0], pair[1])]) if each.name == "lines")

    assert (found(image, 1.0).severity, found(image, 25.0).severity) == ("ok", "ok")
    assert found(0.0 * image, 0.0).severity == "ok"
    assert "deinterlace" in found(interlaced, 1.0).message
    assert "mosaic" in found(mosaic, 1.0).message


def test_stamps_of_a_host_are_named():
    stamps = 0.05 * np.arange(60) + np.random.default_rng(0).normal(0.0, 0.01, 60)
    finding = check_time_stamps(np.diff(stamps).tolist())
    assert finding.severity == "warning"
    assert "host stamps" in finding.message
    assert finding.figure == pytest.approx(0.01, rel=0.3)


@pytest.mark.parametrize(("eyes", "severity"), [((), "ok"), ((0,), "ok"), ((0, 1), "warning")])
def test_text_that_stays_in_both_images_is_named_with_its_place(demo: Demo, eyes: tuple[int, ...], severity: str):
    frames = [replace(each, left=each.left.copy(), right=each.right.copy()) for each in demo[1][::3]]
    for frame in frames:
        for eye in eyes:
            image = (frame.left, frame.right)[eye]
            cv2.putText(image, "REC 2026-11-29", (20, 40), cv2.FONT_HERSHEY_SIMPLEX, 0.6, 255, 2)
    found = check_overlay(frames)
    assert found.severity == severity
    if severity == "warning":
        u0, u1, v0, v1 = map(int, re.findall(r"\d+", found.message))
        assert (20 <= u0 < u1 <= 200, 20 <= v0 < v1 <= 45) == (True, True)
        assert "--mask" in found.message
    mask = np.ones(frames[0].left.shape, np.uint8)
    mask[15:50, 15:205] = 0
    assert check_overlay([replace(each, mask=mask) for each in frames]).severity == "ok"


def test_a_camera_that_stands_sees_no_overlay(demo: Demo):
    frame, rng = demo[1][0], np.random.default_rng(0)
    noisy = np.clip(frame.left + rng.normal(0.0, 1.5, (8, *frame.left.shape)), 0, 255).astype(np.uint8)
    assert check_overlay([replace(frame, left=each, right=each) for each in noisy]).severity == "ok"
