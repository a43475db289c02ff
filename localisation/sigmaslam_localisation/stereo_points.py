"""A body with a stereo camera that sees points at known places: pose on SE(3), (9.34) and (9.39)-(9.42).

The state is the pose of the body in the world, then what all points of a frame have in common and what the filter
estimates on the way:

| component | unit | what it is |
|---|---|---|
| speed offset (3), turn offset (3) | m/s, rad/s | what the sensors of motion say of a body at rest; constant |
| turn scale (3) | 1 | relative error of the turn rates; constant |
| camera turn (3) | rad | the camera's rotation beside the calibrated one; a first-order Markov process |

The camera's turn shifts all points of a frame alike: errors of mounting, of time and of calibration. A filter that
takes them for independent noise of each point averages what does not average out.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from sigmaslam_filters import SE3, Diagonal, Euclidean, Gaussian, MeasurementModel, MotionModel, Product, stack
from sigmaslam_filters.core.layout import concatenate
from sigmaslam_filters.manifolds.lie_groups import exp_so3, matrix_from_quaternion

BODY = SE3("right")
SPACE = Product(BODY, Euclidean(12))
CONSTANTS = slice(6, 15)
"""Of the tangent: offsets and scales, which a second pass begins with."""
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
        turn_scale: of the turn rates' scale.
        velocity: of the speed during a step, m/s, anew in each.
        turn_rate: of the turn rate, rad/s, likewise.
        camera_turn: rad.
        camera_seconds: time constant of the camera's turn.
        pixels: of a point's columns and rows.
    """

    start: tuple[float, float] = (0.01, 0.01)
    offsets: tuple[float, float] = (0.02, 0.02)
    turn_scale: float = 0.1
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
        sizes = (*noise.start, *noise.offsets, noise.turn_scale, noise.camera_turn)
        deviations = start.new_tensor(sizes).repeat_interleave(3)
        mean = torch.nn.functional.pad(start, (0, 12))
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
        driven = path[..., :3] + duration * state[..., 7:10] + noise[..., :3]
        turned = path[..., 3:] * (1.0 + state[..., 13:16]) + duration * state[..., 10:13] + noise[..., 3:6]
        # The path is a translation, then a rotation, as the sensors' rates are integrated.
        still = torch.zeros_like(driven)
        moved = BODY.retract(state[..., :7], torch.cat([driven, still], dim=-1))
        moved = BODY.retract(moved, torch.cat([still, turned], dim=-1))
        turn = state[..., 16:] * torch.exp(-duration / self.noise.camera_seconds) + noise[..., 6:]
        return concatenate([moved, state[..., 7:16], turn])

    def _project(self, state: Tensor, point: Tensor) -> Tensor:
        rig = self.rig
        R_world_body = BODY.to_matrix(state[..., :7])[..., :3, :3]
        in_body = (R_world_body.mT @ (point - state[..., :3])[..., None])[..., 0] - rig.camera_in_body
        in_camera = (rig.R_camera_body @ in_body[..., None])[..., 0]
        turn = matrix_from_quaternion(exp_so3((state[..., 16], state[..., 17], state[..., 18])))
        x, y, z = (turn @ in_camera[..., None])[..., 0].unbind(-1)
        inverse = 1.0 / z.clamp_min(NEAREST)
        row = rig.fy * y * inverse + rig.cy
        left = rig.fx * x * inverse + rig.cx
        return stack([left, row, left - rig.fx * rig.baseline * inverse, row])
