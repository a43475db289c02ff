"""Rendered sequences, whose world and calibration are known exactly, and calibrations with errors for them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sigmaslam.geometry.calibration_sigmas import CalibrationSigmas
from sigmaslam.geometry.camera import CameraModel, StereoCamera
from sigmaslam.geometry.se3 import rotation_exp
from sigmaslam.readers import StereoSequence, open_sequence

if TYPE_CHECKING:
    from sigmaslam_synthetic.simulation import Simulation


def read_simulation(source: Path) -> Simulation:
    """What a rendered sequence was made of."""
    from sigmaslam_synthetic.render_sequence import SCENE_NAME
    from sigmaslam_synthetic.simulation import Simulation

    return Simulation.from_json(json.loads((source / SCENE_NAME).read_text(encoding="utf-8"))["simulation"])


def open_rendered(source: Path) -> StereoSequence:
    """A rendered sequence whose calibration counts as free of errors."""
    sequence = open_sequence(source)
    sequence.camera = replace(sequence.camera, sigmas=CalibrationSigmas.none())
    return sequence


def draw_calibration(camera: StereoCamera, rng: np.random.Generator) -> StereoCamera:
    """The calibration of a pair without distortion, with errors drawn from `camera.sigmas`.

    Focal length, principal point and lens are off in both eyes alike, lens and focal length of the right eye besides,
    and its orientation and the baseline.
    """
    sigmas = camera.sigmas
    focal, baseline = 1.0 + sigmas.focal * rng.standard_normal(), 1.0 + sigmas.baseline * rng.standard_normal()
    centre = sigmas.principal_point * rng.standard_normal(2)
    lens, other_lens, zoom = sigmas.distortion * rng.standard_normal(3)
    T_left_right = camera.T_left_right.copy()
    T_left_right[:3, :3] = T_left_right[:3, :3] @ rotation_exp(sigmas.rotation * rng.standard_normal(3))
    T_left_right[:3, 3] *= baseline
    left = _changed(camera.left, focal, centre, lens)
    right = _changed(camera.right, focal * (1.0 + zoom), centre, lens + other_lens)
    return replace(camera, left=left, right=right, T_left_right=T_left_right)


def _changed(model: CameraModel, focal: float, centre: np.ndarray, lens: float) -> CameraModel:
    """Another focal length (a factor), principal point (shares of the focal length) and radial distortion."""
    return replace(
        model,
        fx=focal * model.fx,
        fy=focal * model.fy,
        cx=model.cx + centre[0] * model.fx,
        cy=model.cy + centre[1] * model.fx,
        distortion_model="radtan",
        distortion=(lens, 0.0, 0.0, 0.0),
    )
