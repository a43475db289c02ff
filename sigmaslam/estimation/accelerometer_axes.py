"""Which axes an accelerometer has: the signed permutation with which its samples give the path that cameras saw."""

from itertools import permutations, product

import numpy as np

from sigmaslam.geometry.inertial_sensor import STANDARD_GRAVITY, InertialSamples
from sigmaslam.geometry.se3 import rotation_exp, rotation_log

SIGNED_AXES = np.array(
    [
        np.diag(signs) @ np.eye(3)[list(order)]
        for order in permutations(range(3))
        for signs in product((1.0, -1.0), repeat=3)
    ]
)
"""(48, 3, 3) all orders and signs of three axes, the right one first."""


def fit_axes(times: np.ndarray, bodies: np.ndarray, samples: InertialSamples, shift: float) -> np.ndarray:
    """By how much the path misses with each of `SIGNED_AXES`, (48,) root mean squares, metres.

    Specific force, turned by the camera's rotation and integrated twice, is the path but for place, speed and gravity,
    which are fitted. It is linear in the axes, so that all are tried with nine integrals. The unit does not matter.

    Args:
        times: (N,) of the images, seconds; more than four, a few seconds in all, and at a rate to interpolate turns.
        bodies: (N, 4, 4) poses of the sensor, as the cameras have them.
        shift: its clock minus that of the camera, seconds.
    """
    t = samples.timestamp - shift
    at = np.r_[times[0], t[(t > times[0]) & (t < times[-1])], times[-1]]
    force = samples.accel * (STANDARD_GRAVITY / np.median(np.linalg.norm(samples.accel, axis=1)))
    force = np.column_stack([np.interp(at, t, each) for each in force.T])
    k = np.clip(np.searchsorted(times, at, "right") - 1, 0, len(times) - 2)
    R = bodies[:, :3, :3]
    turns = rotation_log(R[:-1].transpose(0, 2, 1) @ R[1:])
    share = ((at - times[k]) / (times[k + 1] - times[k]))[:, None]
    # (M, 27): component of the world by axis of the sensor by component of the force.
    pushes = np.einsum("nci,nj->ncij", R[k] @ rotation_exp(share * turns[k]), force).reshape(len(at), -1)
    h = np.diff(at)[:, None]
    velocity = np.cumsum(np.r_[np.zeros((1, 27)), 0.5 * h * (pushes[:-1] + pushes[1:])], axis=0)
    place = np.cumsum(
        np.r_[np.zeros((1, 27)), h * velocity[:-1] + h * h * (2.0 * pushes[:-1] + pushes[1:]) / 6.0], axis=0
    )
    columns = np.column_stack([np.interp(times, at, each) for each in place.T])
    free = np.linalg.qr(np.vander(times - times[0], 3))[0]  # place, speed, gravity
    columns, path = (each - free @ (free.T @ each) for each in (columns, bodies[:, :3, 3]))
    missed = path - np.einsum("ncij,kij->knc", columns.reshape(-1, 3, 3, 3), SIGNED_AXES)
    return np.sqrt(np.mean(np.sum(missed**2, axis=2), axis=1))
