"""Systems of the chapter as models: constant velocity in 12 states, stereo points, and a robot in a landmark map.

The 12 states are (x, dx, y, dy, z, dz, alpha, dalpha, beta, dbeta, phi, dphi): position of the left camera in the
world in metres and its Euler angles in radians, each followed by its rate per second. The rotation from camera to
world is R = Rz(phi) Ry(beta) Rx(alpha), singular at beta = 90 degrees.

A time step is an input of each step, (..., 1) in seconds: sensors need not be regular, nor the elements of a batch
alike.
"""

import math
from typing import Protocol

import torch
from torch import Tensor

from sigmaslam_filters.core.layout import stack
from sigmaslam_filters.core.noise_covariance import Diagonal, Noise
from sigmaslam_filters.manifolds.lie_groups import wrap_angle
from sigmaslam_filters.models import LinearMotion, MeasurementModel, MotionModel


class Rectified(Protocol):
    """A rectified stereo camera, such as `sigmaslam.RectifiedStereo`: pixels, and the baseline in metres."""

    @property
    def fx(self) -> float:
        """Focal length in columns."""
        ...

    @property
    def fy(self) -> float:
        """Focal length in rows."""
        ...

    @property
    def cx(self) -> float:
        """Principal point's column."""
        ...

    @property
    def cy(self) -> float:
        """Principal point's row."""
        ...

    @property
    def baseline(self) -> float:
        """Distance between the cameras."""
        ...


def constant_velocity(densities: Tensor) -> MotionModel:
    """Pairs of a value and its rate, driven by white acceleration over any time step, (9.37) and (9.38).

    The time step (..., 1) in seconds, which may differ from step to step and from element to element, is an input of
    `predict`. Noise that gathers in it enters by its exact root, so the model is not additive; two steps are one step
    of their length. Where all steps are of one length, `constant_velocity_over` is the same by a matrix.

    Args:
        densities: (p,) power spectral density of the acceleration of each value, its unit squared by s^3; six for the
            12 states.
    Returns:
        Motion of 2p states.
    """

    def move(state: Tensor, noise: Tensor, time_step: Tensor) -> Tensor:
        T = time_step[..., :1]
        value, rate = state[..., 0::2], state[..., 1::2]
        first, second = noise[..., 0::2], noise[..., 1::2]
        root = torch.sqrt(T)
        moved = value + T * rate + T * root / math.sqrt(3) * first
        changed = rate + root * (0.5 * math.sqrt(3) * first + 0.5 * second)
        return torch.stack([moved, changed], dim=-1).flatten(-2)

    return MotionModel(move, Diagonal(densities.repeat_interleave(2)), additive=False)


def constant_velocity_over(densities: Tensor, time_step: float) -> LinearMotion:
    """Motion of `constant_velocity` over one time step, for the Kalman filter and where all steps are of one length.

    Args:
        densities: as there.
        time_step: Ts, seconds.
    Returns:
        Motion of 2p states with the exact covariance of the noise that gathers in a time step.
    """
    T = time_step
    step = densities.new_tensor([[1.0, T], [0.0, 1.0]])
    spread = densities.new_tensor([[T**3 / 3, T**2 / 2], [T**2 / 2, T]])
    identity = torch.eye(len(densities), dtype=densities.dtype, device=densities.device)
    return LinearMotion(torch.kron(identity, step), torch.kron(torch.diag(densities), spread))


def project_stereo(state: Tensor, points: Tensor, camera: Rectified) -> Tensor:
    """Pixels of world points in both cameras, (9.39)-(9.42) with the right axis not mirrored.

    Args:
        state: (..., 12) as in the module's description; depths of the points must be positive (not checked).
        points: (m, 3) in the world, metres, or (..., m, 3) with leading dimensions that broadcast to the state's. The
            first is several times faster.
        camera: both eyes.
    Returns:
        (..., 4m) pixels (u_L, v_L, u_R, v_R) of each point in turn.
    """
    entries = _projection(state, camera)
    if points.ndim == 2:
        # All states at once: one product (3k, 4) (4, m) is a tenth of the time of as many sums of products.
        rows = torch.stack(entries).unflatten(0, (3, 4)).movedim(1, -1)
        u, v, z = (rows[..., :3] @ points.mT + rows[..., 3:]).unbind(0)
    else:
        X, Y, Z = points.unbind(-1)
        a = [entry.unsqueeze(-1) for entry in entries]
        u, v, z = (
            torch.addcmul(torch.addcmul(torch.addcmul(a[i + 3], a[i], X), a[i + 1], Y), a[i + 2], Z) for i in (0, 4, 8)
        )
    inverse = torch.reciprocal(z)
    u, v = u * inverse, v * inverse
    right = torch.sub(u, inverse, alpha=camera.fx * camera.baseline)
    return torch.stack([u, v, right, v], dim=-1).flatten(-2)


def differential_drive(noise: Noise | Tensor) -> MotionModel:
    """Robot with four wheels that drives and turns, (9.43) and (9.44): states (x, y, theta), metres and radians.

    The control (..., 2), speed v in m/s and turn rate omega in rad/s, and the time step (..., 1) in seconds are inputs
    of `predict`, in this order; the step may differ from step to step and from element to element. The noise of the
    control, w_v and w_omega, is constant over a step and goes through the kinematics with it: the model is not
    additive.

    Args:
        noise: covariance of (w_v, w_omega), (..., 2, 2).
    """

    def drive(state: Tensor, noise: Tensor, control: Tensor, time_step: Tensor) -> Tensor:
        theta, T = state[..., 2], time_step[..., 0]
        distance = (control[..., 0] + noise[..., 0]) * T
        turn = (control[..., 1] + noise[..., 1]) * T
        return stack(
            [state[..., 0] + distance * torch.cos(theta), state[..., 1] + distance * torch.sin(theta), theta + turn]
        )

    return MotionModel(drive, noise, additive=False)


def range_and_bearing(noise: Noise | Tensor) -> MeasurementModel:
    """Distance of a landmark in metres and its direction seen from the robot in radians; what differs is wrapped.

    The state is (x, y, theta); the landmark (..., 2), its known position in the world, metres, is an input of `update`.

    Args:
        noise: covariance (..., 2, 2), square metres and square radians.
    """

    def see(state: Tensor, landmark: Tensor) -> Tensor:
        x, y = landmark[..., 0] - state[..., 0], landmark[..., 1] - state[..., 1]
        return stack([torch.hypot(x, y), wrap_angle(torch.atan2(y, x) - state[..., 2])])

    return MeasurementModel(see, noise, residual=range_and_bearing_residual)


def range_and_bearing_residual(measured: Tensor, predicted: Tensor) -> Tensor:
    """Of a range and a bearing (..., 2): the difference, its angle in (-pi, pi]."""
    difference = measured - predicted
    return stack([difference[..., 0], wrap_angle(difference[..., 1])])


def _projection(state: Tensor, camera: Rectified) -> list[Tensor]:
    """Entries (...,) of K R^T [I, -t] row by row, (3, 4): homogeneous left pixels of homogeneous world points."""
    angles = state[..., 6::2]
    sa, sb, sp = torch.sin(angles).unbind(-1)
    ca, cb, cp = torch.cos(angles).unbind(-1)
    x, y, z = state[..., 0], state[..., 2], state[..., 4]
    # The columns of R are the axes of the camera in the world.
    right = (cp * cb, sp * cb, -sb)
    sine, cosine = sb * sa, sb * ca
    down = (cp * sine - sp * ca, sp * sine + cp * ca, cb * sa)
    forward = (cp * cosine + sp * sa, sp * cosine - cp * sa, cb * ca)
    u = [camera.fx * a + camera.cx * b for a, b in zip(right, forward, strict=True)]
    v = [camera.fy * a + camera.cy * b for a, b in zip(down, forward, strict=True)]
    entries: list[Tensor] = []
    for row in (u, v, forward):
        entries += [*row, -(row[0] * x + row[1] * y + row[2] * z)]
    return entries
