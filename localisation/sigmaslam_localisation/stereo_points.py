"""A body with a stereo camera that sees points at known places: pose on SE(3), (9.34) and (9.39)-(9.42).

The state is the pose of the body in the world, then constants that the filter estimates on the way:

| component | unit | what it is |
|---|---|---|
| turn offset (3), turn scale (3) | rad/s, 1 | what the gyroscopes say of a body at rest, and their relative error |
| speed sensor (3) | m | the place on the body whose speed is measured |
| disparity offset | px | by which left columns minus right ones are too large |

How the camera is mounted on the body is not among them: no pixel and no rate shows it, so an estimate's covariance has
it beside the filter's (`StereoNoise.mounting`).
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from sigmaslam_filters import SE3, Diagonal, Euclidean, Gaussian, MeasurementModel, MotionModel, Product, stack
from sigmaslam_filters.core.layout import concatenate

BODY = SE3("right")
SPACE = Product(BODY, Euclidean(10))
CONSTANTS = slice(6, 16)
"""Of the tangent; a second pass begins with them."""
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

    Those of motion maximise the likelihood of the first half of a recording ("Starry Night"); the truth was not used.

    Attributes:
        start: of the first pose: metres, radians.
        mounting: of the camera on the body, the same.
        constants: of turn offset (rad/s), turn scale, place of the speed sensor (m), disparity offset (px).
        drive: of the metres driven: per square root of a second, and per square root of a metre.
        turn: of the radians turned: per square root of a second, and per square root of a radian.
        pixels: of a point's columns and rows.
        correlation: seconds after which the errors of a point's pixels are no longer alike.
    """

    start: tuple[float, float] = (0.01, 0.01)
    mounting: tuple[float, float] = (0.01, 0.02)
    constants: tuple[float, float, float, float] = (0.02, 0.1, 0.05, 0.5)
    drive: tuple[float, float] = (0.002, 0.02)
    turn: tuple[float, float] = (0.002, 0.04)
    pixels: float = 1.0
    correlation: float = 0.4


@dataclass(frozen=True, slots=True)
class StereoBody:
    """Models of a body whose stereo camera sees known points.

    Attributes:
        noise: standard deviations.
    """

    rig: StereoRig
    noise: StereoNoise = StereoNoise()

    def prior(self, start: Tensor) -> Gaussian:
        """The belief at the first pose (..., 7), a translation and a quaternion."""
        sizes = (*self.noise.start, *self.noise.constants)
        deviations = start.new_tensor(sizes).repeat_interleave(3)[:-2]
        mean = torch.nn.functional.pad(start, (0, 10))
        return Gaussian(mean, torch.diag(deviations.square()).expand(*start.shape[:-1], -1, -1))

    def motion(self, path: Tensor, duration: Tensor) -> MotionModel:
        """A step's motion; its inputs are the path (..., 12) of `StereoRecording.steps` and the duration (..., 1)."""
        of_time, of_way = path.new_tensor([self.noise.drive, self.noise.turn]).square().unbind(dim=-1)
        length = path[..., :6].unflatten(-1, (2, 3)).square().sum(dim=-1).sqrt()
        spread = (of_time * duration[..., None] + of_way * length).repeat_interleave(3, dim=-1)
        # Between its samples a rate is a Brownian bridge, whose area has this variance.
        spread = spread + path[..., 6:].square() / 12.0
        return MotionModel(_move, Diagonal(spread), additive=False)

    def measurement(self) -> MeasurementModel:
        """Pixels (u_left, v_left, u_right, v_right) of one point (..., 3), of unit noise."""
        return MeasurementModel(self._project, Diagonal(torch.ones(4, dtype=torch.float64)))

    def variance(self, value: Tensor) -> Tensor:
        """Variances (..., 4) of pixels."""
        return torch.full_like(value, self.noise.pixels**2)

    def _project(self, state: Tensor, point: Tensor) -> Tensor:
        rig = self.rig
        R_world_body = BODY.to_matrix(state[..., :7])[..., :3, :3]
        in_body = (R_world_body.mT @ (point - state[..., :3])[..., None])[..., 0] - rig.camera_in_body
        x, y, z = (rig.R_camera_body @ in_body[..., None])[..., 0].unbind(-1)
        inverse = 1.0 / z.clamp_min(NEAREST)
        row = rig.fy * y * inverse + rig.cy
        left = rig.fx * x * inverse + rig.cx
        return stack([left, row, left - rig.fx * rig.baseline * inverse - state[..., 16], row])


def _move(state: Tensor, noise: Tensor, path: Tensor, duration: Tensor) -> Tensor:
    """Half of the step's turn, the way in the direction then, the other half."""
    turned = path[..., 3:6] * (1.0 + state[..., 10:13]) + duration * state[..., 7:10]
    driven = path[..., :3] - torch.linalg.cross(turned, state[..., 13:16].expand_as(turned)) + noise[..., :3]
    half = 0.5 * (turned + noise[..., 3:])
    turn, way = (torch.cat(parts, dim=-1) for parts in ((0.0 * half, half), (driven, 0.0 * half)))
    moved = BODY.retract(BODY.retract(BODY.retract(state[..., :7], turn), way), turn)
    return concatenate([moved, state[..., 7:]])
