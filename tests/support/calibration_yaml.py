"""Calibration files in the form that `StereoCamera.from_yaml` reads."""

from dataclasses import asdict
from pathlib import Path

import yaml

from sigmaslam.geometry.camera import StereoCamera


def write_calibration(camera: StereoCamera, path: Path) -> None:
    """Writes the calibration exactly."""
    content = {
        "left": {**asdict(camera.left), "distortion": list(camera.left.distortion)},
        "right": {**asdict(camera.right), "distortion": list(camera.right.distortion)},
        "T_left_right": camera.T_left_right.tolist(),
        "sigmas": asdict(camera.sigmas),
    }
    path.write_text(yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=200), encoding="utf-8")
