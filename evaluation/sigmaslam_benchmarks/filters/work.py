"""The work that the filter benchmark times: problems with their data, and one step of each in plain numpy.

A unit of work is one prediction and one update of an unscented filter with the cubature set (alpha 1, beta 0, kappa 0),
additive noises, and sigma points redrawn after the process noise is added. The linear problem is for a Kalman filter.

The models take the array module as their first argument (numpy, jax.numpy or torch), so that every library runs the
same arithmetic and differs in its filter only.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]
Belief: TypeAlias = tuple[Array, Array]
Function: TypeAlias = Callable[[Array], Array]

TIME_STEP = 0.1
FOCAL_LENGTH = 718.0
PRINCIPAL_POINT = (607.0, 185.0)
BASELINE = 0.54
PIXEL_SIGMA = 0.5

# Positions and angles of the interleaved state (x, dx, y, dy, z, dz, alpha, dalpha, beta, dbeta, phi, dphi).
_POSITION = slice(0, 6, 2)
_ANGLES = slice(6, 12, 2)
_IMAGE = (1241.0, 376.0)


@dataclass(frozen=True, slots=True)
class StereoWork:
    """One 12-state camera pose with constant velocity, seeing m known points in stereo, eq. (9.37)-(9.42).

    Attributes:
        mean: (12,) prior (x, dx, y, dy, z, dz, alpha, dalpha, beta, dbeta, phi, dphi) metres and radians (per second).
        covariance: (12, 12) prior covariance, correlated.
        transition: (12, 12) blocks [[1, Ts], [0, 1]].
        process_noise: (12, 12) white acceleration over one time step.
        points: (m, 3) static points in the world, metres.
        measurement: (4m,) pixels, (u_L, v_L, u_R, v_R) of each point.
        measurement_noise: (4m, 4m) diagonal covariance, pixels squared.
    """

    mean: Array
    covariance: Array
    transition: Array
    process_noise: Array
    points: Array
    measurement: Array
    measurement_noise: Array


@dataclass(frozen=True, slots=True)
class LocalisationWork:
    """B independent unicycles in the plane, each measuring range and bearing of a known landmark.

    Attributes:
        mean: (B, 3) prior (x, y, theta), metres and radians.
        covariance: (B, 3, 3) prior covariances.
        control: (B, 2) speed and turn rate.
        process_noise: (3, 3) covariance added by the motion.
        landmark: (B, 2) positions in the plane, metres.
        measurement: (B, 2) range in metres and bearing in (-pi, pi].
        measurement_noise: (2, 2) diagonal covariance.
    """

    mean: Array
    covariance: Array
    control: Array
    process_noise: Array
    landmark: Array
    measurement: Array
    measurement_noise: Array


@dataclass(frozen=True, slots=True)
class PositionWork:
    """B independent unicycles in the plane, each with a position fix.

    Attributes:
        mean, covariance, control, process_noise: as in `LocalisationWork`.
        measurement: (B, 2) measured position (x, y), metres.
        measurement_noise: (2, 2) diagonal covariance.
    """

    mean: Array
    covariance: Array
    control: Array
    process_noise: Array
    measurement: Array
    measurement_noise: Array


@dataclass(frozen=True, slots=True)
class LandmarkWork:
    """B independent static points in the frame of a stereo camera.

    Attributes:
        mean: (B, 3) prior (X, Y, Z), metres.
        covariance: (B, 3, 3) prior covariances, long in depth.
        process_noise: (3, 3) small covariance that keeps the filter awake.
        measurement: (B, 3) pixels (u, v, disparity).
        measurement_noise: (3, 3) diagonal covariance, pixels squared.
    """

    mean: Array
    covariance: Array
    process_noise: Array
    measurement: Array
    measurement_noise: Array


@dataclass(frozen=True, slots=True)
class LinearWork:
    """B independent constant-velocity targets in the plane with measured position, for Kalman filters.

    Attributes:
        mean: (B, 4) prior (x, dx, y, dy).
        covariance: (B, 4, 4) prior covariances.
        transition: (4, 4) blocks [[1, Ts], [0, 1]].
        process_noise: (4, 4) white acceleration over one time step.
        observation: (2, 4) picks the position out.
        measurement: (B, 2) measured position, metres.
        measurement_noise: (2, 2) diagonal covariance.
    """

    mean: Array
    covariance: Array
    transition: Array
    process_noise: Array
    observation: Array
    measurement: Array
    measurement_noise: Array


BatchedWork: TypeAlias = LocalisationWork | PositionWork | LandmarkWork | LinearWork
Work: TypeAlias = StereoWork | BatchedWork


def stereo(m: int, seed: int) -> StereoWork:
    """A camera that sees m points 5 to 40 m in front of it; the prior mean is off by a draw from the prior."""
    generator = np.random.default_rng(seed)
    transition, process_noise = _constant_velocity([0.5] * 3 + [0.1] * 3)
    sigma = np.array([0.05, 0.1] * 3 + [0.01, 0.1] * 3)
    covariance = _correlated(generator, sigma)
    truth = np.array([0.3, 0.1, -0.2, 0.0, 1.0, 2.0, 0.05, 0.02, -0.1, 0.1, 0.03, -0.05])
    mean = truth + _draw(generator, covariance)
    truth = transition @ truth + _draw(generator, process_noise)

    pixels = generator.uniform((30.0, 10.0), (_IMAGE[0] - 30.0, _IMAGE[1] - 10.0), (m, 2))
    depth = generator.uniform(5.0, 40.0, m)
    in_camera = np.column_stack([(pixels - PRINCIPAL_POINT) / FOCAL_LENGTH * depth[:, None], depth])
    points = in_camera @ rotation(np, truth[_ANGLES]).T + truth[_POSITION]
    expected = project_stereo(np, truth, points)
    measurement = expected + PIXEL_SIGMA * generator.standard_normal(4 * m)
    return StereoWork(
        mean, covariance, transition, process_noise, points, measurement, PIXEL_SIGMA**2 * np.eye(len(measurement))
    )


def localisation(batch: int, seed: int) -> LocalisationWork:
    """Unicycles all over the plane; bearings go all around, so some innovations wrap."""
    generator = np.random.default_rng(seed)
    mean, covariance, control, process_noise, truth = _unicycles(batch, generator)
    distance, direction = generator.uniform((5.0, -np.pi), (20.0, np.pi), (batch, 2)).T
    landmark = truth[:, :2] + distance[:, None] * np.column_stack([np.cos(direction), np.sin(direction)])
    noise = np.diag([0.1**2, 0.01**2])
    measurement = range_and_bearing(np, truth, landmark) + _draw(generator, noise, batch)
    measurement[:, 1] = wrap(measurement[:, 1])
    return LocalisationWork(mean, covariance, control, process_noise, landmark, measurement, noise)


def position(batch: int, seed: int) -> PositionWork:
    """The unicycles of `localisation` with a position fix of 0.5 m instead of a landmark."""
    generator = np.random.default_rng(seed)
    mean, covariance, control, process_noise, truth = _unicycles(batch, generator)
    noise = 0.5**2 * np.eye(2)
    return PositionWork(mean, covariance, control, process_noise, truth[:, :2] + _draw(generator, noise, batch), noise)


def landmark(batch: int, seed: int) -> LandmarkWork:
    """Points 5 to 40 m in front of a camera, known to 3 % in depth and 0.5 % across."""
    generator = np.random.default_rng(seed)
    pixels = generator.uniform((0.0, 0.0), _IMAGE, (batch, 2))
    depth = generator.uniform(5.0, 40.0, batch)
    mean = np.column_stack([(pixels - PRINCIPAL_POINT) / FOCAL_LENGTH * depth[:, None], depth])
    covariance = _correlated(generator, depth[:, None] * np.array([0.005, 0.005, 0.03]))
    process_noise = 0.01**2 * np.eye(3)
    truth = mean + _draw(generator, covariance) + _draw(generator, process_noise, batch)
    noise = PIXEL_SIGMA**2 * np.eye(3)
    measurement = project_landmark(np, truth) + _draw(generator, noise, batch)
    return LandmarkWork(mean, covariance, process_noise, measurement, noise)


def linear(batch: int, seed: int) -> LinearWork:
    """Targets in a square of 100 m at walking speed, positions measured to 0.3 m."""
    generator = np.random.default_rng(seed)
    transition, process_noise = _constant_velocity([0.5, 0.5])
    covariance = _correlated(generator, generator.uniform(0.2, 1.0, (batch, 4)))
    mean = generator.uniform(-1.0, 1.0, (batch, 4)) * np.array([50.0, 2.0, 50.0, 2.0])
    truth = (mean + _draw(generator, covariance)) @ transition.T + _draw(generator, process_noise, batch)
    observation = np.eye(4)[[0, 2]]
    noise = 0.3**2 * np.eye(2)
    measurement = truth @ observation.T + _draw(generator, noise, batch)
    return LinearWork(mean, covariance, transition, process_noise, observation, measurement, noise)


def advance(states: Any, transition: Any) -> Any:
    """Linear motion of states (..., n) by a transition matrix (n, n), eq. (9.37)."""
    return states @ transition.T


def rotation(xp: Any, angles: Any) -> Any:
    """Rz(phi) Ry(beta) Rx(alpha) of angles (..., 3) = (alpha, beta, phi), as (..., 3, 3)."""
    cosine, sine = xp.cos(angles), xp.sin(angles)
    ca, cb, cp = cosine[..., 0], cosine[..., 1], cosine[..., 2]
    sa, sb, sp = sine[..., 0], sine[..., 1], sine[..., 2]
    entries = [
        cp * cb, cp * sb * sa - sp * ca, cp * sb * ca + sp * sa,
        sp * cb, sp * sb * sa + cp * ca, sp * sb * ca - cp * sa,
        -sb, cb * sa, cb * ca,
    ]  # fmt: skip
    return xp.stack(entries, -1).reshape(*angles.shape[:-1], 3, 3)


def project_stereo(xp: Any, states: Any, points: Any) -> Any:
    """Pixels (..., 4m) of points (m, 3) in both cameras, from camera states (..., 12), eq. (9.39)-(9.42)."""
    # R^T (p - t) for every point is a product from the right with R.
    in_camera = (points - states[..., None, _POSITION]) @ rotation(xp, states[..., _ANGLES])
    x, y, z = in_camera[..., 0], in_camera[..., 1], in_camera[..., 2]
    scale = FOCAL_LENGTH / z
    u = scale * x + PRINCIPAL_POINT[0]
    v = scale * y + PRINCIPAL_POINT[1]
    return xp.stack([u, v, u - BASELINE * scale, v], -1).reshape(*states.shape[:-1], -1)


def drive(xp: Any, states: Any, control: Any) -> Any:
    """Unicycle states (..., 3) after one time step of control (..., 2) = (speed, turn rate)."""
    theta = states[..., 2]
    step = control[..., 0] * TIME_STEP
    turn = control[..., 1] * TIME_STEP
    return xp.stack([states[..., 0] + step * xp.cos(theta), states[..., 1] + step * xp.sin(theta), theta + turn], -1)


def range_and_bearing(xp: Any, states: Any, landmark: Any) -> Any:
    """Range and bearing, not wrapped, of landmarks (..., 2) from unicycles (..., 3)."""
    dx = landmark[..., 0] - states[..., 0]
    dy = landmark[..., 1] - states[..., 1]
    return xp.stack([xp.hypot(dx, dy), xp.arctan2(dy, dx) - states[..., 2]], -1)


def project_landmark(xp: Any, states: Any) -> Any:
    """Pixels (u, v, disparity) of points (..., 3) in the camera frame."""
    scale = FOCAL_LENGTH / states[..., 2]
    u = scale * states[..., 0] + PRINCIPAL_POINT[0]
    v = scale * states[..., 1] + PRINCIPAL_POINT[1]
    return xp.stack([u, v, BASELINE * scale], -1)


def wrap(angle: Any) -> Any:
    """The same angle in [-pi, pi)."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def step_stereo_low_rank(work: StereoWork) -> Belief:
    """One step of the stereo problem in O(m n^2): whitened by R^-1/2, then a system of the 2n deviations.

    The push-through identity turns X^T D (D^T D + I)^-1 into X^T (D D^T + I)^-1 D, with D the whitened deviations,
    Barfoot & McManus 2011.
    """
    mean, covariance = _predict(
        work.mean, work.covariance, lambda states: advance(states, work.transition), work.process_noise
    )
    states = _sigma_points(mean, covariance)
    pixels = project_stereo(np, states, work.points)
    sigma = np.sqrt(np.diagonal(work.measurement_noise))
    expected = pixels.mean(axis=0)
    X = (states - mean) / math.sqrt(len(states))
    D = (pixels - expected) / (sigma * math.sqrt(len(states)))
    system = np.eye(len(states)) + D @ D.T
    projected = D @ ((work.measurement - expected) / sigma)
    solution = np.linalg.solve(system, np.column_stack([projected, X]))
    return mean + X.T @ solution[:, 0], X.T @ solution[:, 1:]


def step_one(work: BatchedWork, index: int) -> Belief:
    """One step of one filter of a batch, as (n,) mean and (n, n) covariance."""
    mean, covariance, measurement = work.mean[index], work.covariance[index], work.measurement[index]
    if isinstance(work, LinearWork):
        mean = work.transition @ mean
        covariance = work.transition @ covariance @ work.transition.T + work.process_noise
        S = work.observation @ covariance @ work.observation.T + work.measurement_noise
        gain = np.linalg.solve(S, work.observation @ covariance).T
        return mean + gain @ (measurement - work.observation @ mean), covariance - gain @ S @ gain.T
    if isinstance(work, LandmarkWork):
        predicted = _predict(mean, covariance, lambda states: states, work.process_noise)
        return _update(*predicted, partial(project_landmark, np), work.measurement_noise, measurement)
    control = work.control[index]
    predicted = _predict(mean, covariance, lambda states: drive(np, states, control), work.process_noise)
    if isinstance(work, PositionWork):
        return _update(*predicted, lambda states: states[..., :2], work.measurement_noise, measurement)
    landmark = work.landmark[index]
    return _update(
        *predicted,
        lambda states: range_and_bearing(np, states, landmark),
        work.measurement_noise,
        measurement,
        _subtract_range_and_bearing,
    )


def step_loop(work: BatchedWork) -> Belief:
    """One step of every filter of a batch, one after the other, as (B, n) means and (B, n, n) covariances."""
    beliefs = [step_one(work, index) for index in range(len(work.mean))]
    return np.stack([mean for mean, _ in beliefs]), np.stack([covariance for _, covariance in beliefs])


def step(work: Work) -> Belief:
    """The reference result: one step in plain numpy and float64, of the shapes of `work.mean` and `work.covariance`."""
    return step_stereo_low_rank(work) if isinstance(work, StereoWork) else step_loop(work)


def _sigma_points(mean: Array, covariance: Array) -> Array:
    """Cubature points (2n, n): the mean plus and minus sqrt(n) times the columns of the lower Cholesky factor."""
    offsets = math.sqrt(len(mean)) * np.linalg.cholesky(covariance).T
    return np.concatenate([mean + offsets, mean - offsets])


def _predict(mean: Array, covariance: Array, transition: Function, process_noise: Array) -> Belief:
    """Moments of the propagated points, plus the process noise."""
    states = transition(_sigma_points(mean, covariance))
    mean = states.mean(axis=0)
    deviations = states - mean
    return mean, deviations.T @ deviations / len(states) + process_noise


def _update(
    mean: Array,
    covariance: Array,
    measure: Function,
    measurement_noise: Array,
    measurement: Array,
    subtract: Callable[[Array, Array], Array] = np.subtract,
) -> Belief:
    """The textbook update from points drawn anew; `subtract` is the difference of two measurements."""
    states = _sigma_points(mean, covariance)
    measured = measure(states)
    expected = measured[0] + subtract(measured, measured[0]).mean(axis=0)
    X = states - mean
    Z = subtract(measured, expected)
    S = Z.T @ Z / len(states) + measurement_noise
    gain = np.linalg.solve(S, Z.T @ X / len(states)).T
    return mean + gain @ subtract(measurement, expected), covariance - gain @ S @ gain.T


def _subtract_range_and_bearing(a: Array, b: Array) -> Array:
    """Difference of (..., 2) ranges and bearings, the latter wrapped."""
    difference = a - b
    difference[..., 1] = wrap(difference[..., 1])
    return difference


def _unicycles(batch: int, generator: Generator) -> tuple[Array, Array, Array, Array, Array]:
    """Prior means, covariances, controls and process noise of a batch, and its true states after the motion."""
    mean = generator.uniform((-5.0, -5.0, -np.pi), (5.0, 5.0, np.pi), (batch, 3))
    covariance = _correlated(generator, generator.uniform(0.5, 1.5, (batch, 3)) * np.array([0.1, 0.1, 0.05]))
    control = generator.uniform((0.5, -0.5), (2.0, 0.5), (batch, 2))
    process_noise = np.diag([0.02**2, 0.02**2, 0.01**2])
    truth = drive(np, mean + _draw(generator, covariance), control) + _draw(generator, process_noise, batch)
    return mean, covariance, control, process_noise, truth


def _constant_velocity(spectral_densities: list[float]) -> tuple[Array, Array]:
    """Transition and process noise of (position, velocity) pairs driven by white acceleration."""
    T = TIME_STEP
    transition: Array = np.kron(np.eye(len(spectral_densities)), np.array([[1.0, T], [0.0, 1.0]]))
    noise: Array = np.kron(np.diag(spectral_densities), np.array([[T**3 / 3, T**2 / 2], [T**2 / 2, T]]))
    return transition, noise


def _correlated(generator: Generator, sigma: Array) -> Array:
    """Random covariances (..., n, n) with the given standard deviations (..., n)."""
    size = sigma.shape[-1]
    draws = generator.standard_normal((*sigma.shape, 2 * size))
    product = draws @ draws.swapaxes(-1, -2)
    scale = sigma / np.sqrt(np.diagonal(product, axis1=-2, axis2=-1))
    return product * scale[..., :, None] * scale[..., None, :]


def _draw(generator: Generator, covariance: Array, *batch: int) -> Array:
    """Zero-mean normal vectors (..., n) of the given covariances (..., n, n)."""
    normal = generator.standard_normal((*batch, *covariance.shape[:-1]))
    return (np.linalg.cholesky(covariance) @ normal[..., None])[..., 0]
