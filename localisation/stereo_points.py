"""A body with a stereo camera that sees points at known places: pose on SE(3), (9.34) and (9.39)-(9.42).

The state is the pose of the body in the world, then what all points of a frame have in common and what the filter
estimates on the way:

| component | unit | what it is |
|---|---|---|
| speed offset (3), turn offset (3) | m/s, rad/s | what the sensors of motion say of a body at rest; constant |
| camera turn (3) | rad | the camera's rotation beside the one that calibration gives it; a first-order Markov process |

The camera's turn shifts all points of a frame alike: errors of mounting, of time and of calibration. A filter that takes
them for independent noise of each point averages what does not average out.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sigmaslam.filters import SE3, Diagonal, Euclidean, Gaussian, MeasurementModel, MotionModel, Product, stack
from sigmaslam.filters.layout import concatenate
from sigmaslam.filters.lie_groups import exp_so3, matrix_from_quaternion

BODY = SE3("right")
SPACE = Product(BODY, Euclidean(9))
NEAREST = 0.05
"""Metres. A sigma point's depth is no less, so that what it sees is finite."""


@dataclass(frozen=True, slots=True)
class StereoRig:
    """A rectified stereo camera on a body.

    Attributes:
        fx, fy, cx, cy: pixels.
        baseline: metres.
        R_camera_body: (3, 3).
        camera_in_body: (3,) metres.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    baseline: float
    R_camera_body: Tensor
    camera_in_body: Tensor


@dataclass(frozen=True, slots=True)
class StereoNoise:
    """Standard deviations at the start; those of the pixels are learned.

    Attributes:
        start: of the first pose: metres, radians.
        offsets: of speed and turn rate: m/s, rad/s.
        velocity: of the speed per step: m/s and per second^1/2 of it.
        turn_rate: likewise, rad/s.
        camera_turn: rad.
        camera_seconds: time constant of the camera's turn.
        pixels: of a point's columns and rows.
    """

    start: tuple[float, float] = (0.01, 0.01)
    offsets: tuple[float, float] = (0.02, 0.02)
    velocity: float = 0.05
    turn_rate: float = 0.1
    camera_turn: float = 0.02
    camera_seconds: float = 2.0
    pixels: float = 1.0


@dataclass(frozen=True, slots=True)
class StereoBody:
    """Models of a body whose stereo camera sees known points.

    Attributes:
        rig: the camera.
        noise: standard deviations.
    """

    rig: StereoRig
    noise: StereoNoise = StereoNoise()

    def prior(self, start: Tensor) -> Gaussian:
        """The belief at the first pose (..., 7), a translation and a quaternion."""
        noise = self.noise
        sizes = zip((*noise.start, *noise.offsets, noise.camera_turn), [3] * 5, strict=True)
        deviations = start.new_tensor([size for size, count in sizes for _ in range(count)])
        mean = torch.nn.functional.pad(start, (0, 9))
        return Gaussian(mean, torch.diag(deviations.square()).expand(*start.shape[:-1], -1, -1))

    def motion(self, path: Tensor, duration: Tensor) -> MotionModel:
        """A step's motion; its inputs are the path (..., 6), metres and radians, and the duration (..., 1)."""
        noise, ones = self.noise, torch.ones_like(path[..., :3])
        # White noise of the rates, sampled with every step.
        spread = [(rate * duration)[..., None] ** 2 * ones for rate in (noise.velocity, noise.turn_rate)]
        kept = torch.exp(-2.0 * duration / noise.camera_seconds)
        turn = (noise.camera_turn**2 * (1.0 - kept))[..., None] * ones
        return MotionModel(self._move, Diagonal(torch.cat([*spread, turn], dim=-1)), additive=False)

    def measurement(self) -> MeasurementModel:
        """Pixels (u_left, v_left, u_right, v_right) of one point (..., 3), of unit noise."""
        return MeasurementModel(self._project, Diagonal(torch.ones(4, dtype=torch.float64)))

    def variance(self, value: Tensor) -> Tensor:
        """Variances (..., 4) of pixels."""
        return torch.full_like(value, self.noise.pixels**2)

    def _move(self, state: Tensor, noise: Tensor, path: Tensor, duration: Tensor) -> Tensor:
        step = path + duration * state[..., 7:13] + noise[..., :6]
        # The path is a translation, then a rotation, as the sensors' rates are integrated.
        still = torch.zeros_like(step[..., :3])
        moved = BODY.retract(state[..., :7], torch.cat([step[..., :3], still], dim=-1))
        moved = BODY.retract(moved, torch.cat([still, step[..., 3:]], dim=-1))
        turn = state[..., 13:] * torch.exp(-duration / self.noise.camera_seconds) + noise[..., 6:]
        return concatenate([moved, state[..., 7:13], turn])

    def _project(self, state: Tensor, point: Tensor) -> Tensor:
        rig = self.rig
        R_world_body = BODY.to_matrix(state[..., :7])[..., :3, :3]
        in_body = (R_world_body.mT @ (point - state[..., :3])[..., None])[..., 0] - rig.camera_in_body
        in_camera = (rig.R_camera_body @ in_body[..., None])[..., 0]
        turn = matrix_from_quaternion(exp_so3(tuple(state[..., 13:].unbind(-1))))
        x, y, z = (turn @ in_camera[..., None])[..., 0].unbind(-1)
        inverse = 1.0 / z.clamp_min(NEAREST)
        row = rig.fy * y * inverse + rig.cy
        left = rig.fx * x * inverse + rig.cx
        return stack([left, row, left - rig.fx * rig.baseline * inverse, row])
