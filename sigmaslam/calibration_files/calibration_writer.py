"""Writes a calibration in the project's YAML, and describes one in words."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from sigmaslam.files import atomic_write_text
from sigmaslam.geometry.calibration_sigmas import CalibrationSigmas
from sigmaslam.geometry.camera import CameraModel, StereoCamera
from sigmaslam.geometry.se3 import rotation_log


def write_calibration(path: Path, camera: StereoCamera, more: dict[str, Any] | None = None) -> None:
    """Write what `StereoCamera.from_yaml` reads back exactly; sigmas only where they are not the defaults.

    Args:
        more: further entries, which `from_yaml` leaves alone.

    Raises:
        InputError: the folder cannot be written.
    """
    content: dict[str, Any] = {
        "left": camera_entries(camera.left),
        "right": camera_entries(camera.right),
        "T_left_right": camera.T_left_right.tolist(),
    }
    if camera.sigmas != CalibrationSigmas():
        content["sigmas"] = asdict(camera.sigmas)
    if camera.covariance is not None:
        content["covariance"] = {"names": list(camera.covariance.names), "matrix": camera.covariance.matrix.tolist()}
    content |= more or {}
    head = "# Pixels and metres; T_left_right takes points of the right camera into the left one.\n"
    write_yaml(path, content, head)


def write_yaml(path: Path, content: dict[str, Any], head: str = "") -> None:
    """Write a mapping, behind comments; PyYAML writes the shortest digits that give the same number."""
    atomic_write_text(path, head + yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120))


def camera_entries(camera: CameraModel) -> dict[str, Any]:
    """One camera as a mapping of a calibration file."""
    return {**asdict(camera), "distortion": list(camera.distortion)}


def describe_calibration(camera: StereoCamera) -> str:
    """Baseline, rotation, lens models and fields of view, a line each."""
    x, y, z = 1e3 * camera.T_left_right[:3, 3]
    turned = np.degrees(rotation_log(camera.T_left_right[:3, :3]))
    return "\n".join(
        [
            f"left      {_describe_eye(camera.left)}",
            f"right     {_describe_eye(camera.right)}",
            f"baseline  {1e3 * camera.baseline:.3f} mm; the right camera is at ({x:.3f}, {y:.3f}, {z:.3f}) mm in the "
            f"left one, turned by ({turned[0]:.4f}, {turned[1]:.4f}, {turned[2]:.4f}) deg about x, y, z",
            f"images    {'rectified' if camera.is_rectified else 'raw: they are rectified while tracking'}",
        ]
    )


def _describe_eye(eye: CameraModel) -> str:
    horizontal = _angle(eye, (0.0, eye.cy), (eye.width - 1.0, eye.cy))
    vertical = _angle(eye, (eye.cx, 0.0), (eye.cx, eye.height - 1.0))
    lens = f"{eye.distortion_model} ({len(eye.distortion)})" if eye.distortion else eye.distortion_model
    return (
        f"{eye.width}x{eye.height} px, f ({eye.fx:.3f}, {eye.fy:.3f}), c ({eye.cx:.3f}, {eye.cy:.3f}), "
        f"lens {lens}, field of view {horizontal} x {vertical}"
    )


def _angle(eye: CameraModel, first: tuple[float, float], second: tuple[float, float]) -> str:
    """Angle between the rays of two pixels, in words, as a lens need not reach to the border."""
    rays = eye.unproject(np.array([first, second]))
    cosine = float(rays[0] @ rays[1] / np.prod(np.linalg.norm(rays, axis=1)))
    return f"{np.degrees(np.arccos(cosine)):.1f} deg" if np.isfinite(cosine) else "more than the lens model holds for"
