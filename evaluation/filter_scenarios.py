"""Monte-Carlo scenarios for filters: simulated runs, all at once, and what a filter makes of them.

A scenario is data and models; `run` sends a filter through all runs of it as one batch, so that filters are compared on
the same data. Every step is a motion and then, where there is one, a measurement.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Generator, Tensor

from sigmaslam.camera import RectifiedStereo
from sigmaslam.filters import (
    BayesFilter,
    Diagonal,
    Gaussian,
    LinearMeasurement,
    LinearMotion,
    MeasurementModel,
    MotionModel,
    stack,
    wrap_angle,
)
from sigmaslam.filters.consistency import nees
from sigmaslam.filters.systems import constant_velocity, project_stereo, stereo_measurement

CAMERA = RectifiedStereo(fx=718.0, fy=718.0, cx=607.0, cy=185.0, baseline=0.54, width=1241, height=376)


@dataclass(frozen=True, slots=True, eq=False)
class Scenario:
    """Simulated runs of one system.

    Attributes:
        truth: (T, runs, p) states.
        values: (T, runs, m) measurements; NaN throughout at a step without one.
        prior: belief of each run before the first motion.
        motion: None if there is none.
        measurement: of every step.
        motion_inputs: (T, ...) each; element k leads to step k.
        position: components of the state that are its position, in metres unless the scenario says otherwise.
    """

    truth: Tensor
    values: Tensor
    prior: Gaussian
    motion: LinearMotion | MotionModel | None
    measurement: LinearMeasurement | MeasurementModel
    motion_inputs: tuple[Tensor, ...] = ()
    position: tuple[int, ...] = (0,)


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What a filter made of a scenario.

    Attributes:
        estimate: (T, runs, p) means after each step.
        covariance: (T, runs, n, n) in the chart at the mean.
        error: (T, runs, n) truth minus estimate, in the same chart.
        nees: (T, runs) with n degrees of freedom; NaN where the covariance is singular.
        position_error: (T, runs, d) truth minus estimate.
        healthy: (T, runs) bool.
    """

    estimate: Tensor
    covariance: Tensor
    error: Tensor
    nees: Tensor
    position_error: Tensor
    healthy: Tensor

    @property
    def rmse_by_run(self) -> Tensor:
        """(runs,) root mean square length of the position error over the steps."""
        return self.position_error.square().sum(dim=-1).mean(dim=0).sqrt()

    @property
    def rmse(self) -> float:
        """Root mean square length of the position error over steps and runs."""
        return float(self.position_error.square().sum(dim=-1).mean().sqrt())

    def block_nees(self, components: Sequence[int]) -> Tensor:
        """(T, runs) NEES of some of the chart's components alone."""
        index = torch.tensor(components)
        block = self.covariance.index_select(-1, index).index_select(-2, index)
        return nees(self.error.index_select(-1, index), block)


def run(scenario: Scenario, bayes: BayesFilter) -> Outcome:
    """A filter on all runs of a scenario.

    Raises:
        FilterError: a run fails and the filter's policy is to raise.
    """
    belief = scenario.prior
    beliefs, healthy = [], []
    for step, value in enumerate(scenario.values):
        well = torch.ones(belief.batch_shape, dtype=torch.bool)
        if scenario.motion is not None:
            moved = bayes.predict(belief, scenario.motion, *(given[step] for given in scenario.motion_inputs))
            belief, well = moved.belief, well & moved.healthy
        if not bool(value.isnan().all()):
            seen = bayes.update(belief, scenario.measurement, value)
            belief, well = seen.belief, well & seen.healthy
        beliefs.append(belief)
        healthy.append(well)
    estimate = torch.stack([belief.mean for belief in beliefs])
    covariance = torch.stack([belief.covariance for belief in beliefs])
    error = scenario.truth - estimate if bayes.space is None else bayes.space.local(estimate, scenario.truth)
    position = list(scenario.position)
    return Outcome(
        estimate,
        covariance,
        error,
        nees(error, covariance),
        (scenario.truth - estimate)[..., position],
        torch.stack(healthy),
    )


def growth(runs: int, generator: Generator, steps: int = 500) -> Scenario:
    """Univariate nonstationary growth: two modes, for accuracy only, never for consistency.

    x' = x / 2 + 25 x / (1 + x^2) + 8 cos(1.2 (k - 1)) + w, z = x^2 / 20 + v, unit noises, x ~ N(0.1, 1) believed and
    0.1 true at the start, as in the EKF/UKF toolbox of Hartikainen, Solin and Särkkä (2011), section 2.5.
    """
    wave = (8.0 * torch.cos(1.2 * _range(steps))).unsqueeze(-1)
    unit = _matrix([[1.0]])
    motion = MotionModel(_grow, unit)
    measurement = MeasurementModel(lambda x: 0.05 * x * x, unit)
    x, truth = torch.full((runs, 1), 0.1, dtype=torch.float64), []
    for step in range(steps):
        x = _grow(x, wave[step]) + _normal(generator, runs, 1)
        truth.append(x)
    states = torch.stack(truth)
    values = 0.05 * states * states + _normal(generator, steps, runs, 1)
    prior = Gaussian(torch.full((runs, 1), 0.1, dtype=torch.float64), unit)
    return Scenario(states, values, prior, motion, measurement, (wave,))


def growth_with_kept_points(scenario: Scenario, bayes: BayesFilter) -> Tensor:
    """Estimates (T, runs, 1) of `growth` by one set of sigma points for state and both noises, not redrawn between.

    State and measurement are moved as one state of two components, of which the second is then given exactly.
    """

    def move_and_see(x: Tensor, noise: Tensor, wave: Tensor) -> Tensor:
        moved = _grow(x[..., 0], wave[..., 0]) + noise[..., 0]
        return stack([moved, 0.05 * moved * moved + noise[..., 1]])

    both = MotionModel(move_and_see, torch.eye(2, dtype=torch.float64), additive=False)
    given = LinearMeasurement(_matrix([[0.0, 1.0]]), _matrix([[0.0]]))
    belief, means = scenario.prior, []
    for wave, value in zip(scenario.motion_inputs[0], scenario.values, strict=True):
        seen = bayes.update(bayes.predict(belief, both, wave).belief, given, value).belief
        belief = Gaussian(seen.mean[..., :1], seen.covariance[..., :1, :1])
        means.append(belief.mean)
    return torch.stack(means)


def bearings(runs: int, generator: Generator) -> Scenario:
    """A target that turns three times, seen as two bearings: states (x, y, dx, dy).

    500 steps of 0.01 s; sensors at (-1, -2) and (1, 1), 0.05 rad; constant-velocity model with densities of 0.1 and the
    prior N(0, 4 I), as in the EKF/UKF toolbox, section 2.6.
    """
    T, sigma, steps = 0.01, 0.05, 500
    rate = torch.zeros(steps, runs, dtype=torch.float64)
    for first in (49, 199, 349):
        rate[first : first + 51] = 0.5 * math.pi / (51 * T) + 0.01 * _normal(generator, 51, runs)
    # Each step is an arc: the chord has the heading of its middle.
    end = -torch.cumsum(rate * T, dim=0)
    middle, half = end + 0.5 * T * rate, 0.5 * T * rate
    chord = T * torch.sinc(half / math.pi)
    x, y = torch.cumsum(chord * torch.cos(middle), dim=0), torch.cumsum(chord * torch.sin(middle), dim=0)
    truth = torch.stack([x, y, torch.cos(end), torch.sin(end)], dim=-1)

    sensors = _matrix([[-1.0, -2.0], [1.0, 1.0]])

    def see(state: Tensor) -> Tensor:
        return stack([torch.atan2(state[..., 1] - y, state[..., 0] - x) for x, y in sensors.tolist()])

    noise = sigma**2 * torch.eye(2, dtype=torch.float64)
    pairs = constant_velocity(torch.full((2,), 0.1, dtype=torch.float64), T)
    order = torch.tensor([0, 2, 1, 3])
    assert isinstance(pairs.noise, Tensor)
    motion = LinearMotion(pairs.matrix[order][:, order], pairs.noise[order][:, order])
    values = see(truth) + sigma * _normal(generator, steps, runs, 2)
    prior = Gaussian(torch.zeros(runs, 4, dtype=torch.float64), 4.0 * torch.eye(4, dtype=torch.float64))
    measurement = MeasurementModel(see, noise, residual=lambda a, b: wrap_angle(a - b))
    return Scenario(truth, values, prior, motion, measurement, position=(0, 1))


def reentry(runs: int, generator: Generator, steps: int = 2000) -> Scenario:
    """A body that falls into the atmosphere, seen by a radar at 10 Hz: states (x, y, dx, dy, log drag), kilometres.

    The numbers are those of Julier and Uhlmann as in the EKF/UKF toolbox, section 2.7: the drag's exponent is believed
    to be 0 +- 1 and is 0.6932.
    """
    T, radius = 0.1, 6374.0
    sigma = torch.tensor([1e-3, 0.17e-3], dtype=torch.float64)
    start = torch.tensor([6500.4, 349.14, -1.8093, -6.7967, 0.6932], dtype=torch.float64)
    drift = torch.tensor([0.0, 0.0, 2.4064e-5, 2.4064e-5, 0.0], dtype=torch.float64)

    def fall(state: Tensor) -> Tensor:
        x, y, dx, dy, drag = state.unbind(-1)
        distance = torch.hypot(x, y)
        slowing = -0.59783 * torch.exp(drag + (radius - distance) / 13.406) * torch.hypot(dx, dy)
        gravity = -3.9860e5 / distance**3
        return stack(
            [x + T * dx, y + T * dy, dx + T * (slowing * dx + gravity * x), dy + T * (slowing * dy + gravity * y), drag]
        )

    def see(state: Tensor) -> Tensor:
        return stack([torch.hypot(state[..., 0] - radius, state[..., 1]), torch.atan2(state[..., 1], state[..., 0] - radius)])

    spread = torch.tensor([1e-6, 1e-6, 1e-6, 1e-6, 0.0], dtype=torch.float64)
    x, truth = start + spread.sqrt() * _normal(generator, runs, 5), []
    for _ in range(steps):
        x = fall(x) + drift.sqrt() * _normal(generator, runs, 5)
        truth.append(x)
    states = torch.stack(truth)
    values = see(states) + sigma * _normal(generator, steps, runs, 2)
    believed = torch.tensor([1e-6, 1e-6, 1e-6, 1e-6, 1.0], dtype=torch.float64)
    mean = start * torch.tensor([1.0, 1.0, 1.0, 1.0, 0.0], dtype=torch.float64)
    noise = drift + torch.tensor([0.0, 0.0, 0.0, 0.0, 1e-6], dtype=torch.float64)
    return Scenario(
        states,
        values,
        Gaussian(mean.expand(runs, 5), torch.diag(believed)),
        MotionModel(fall, Diagonal(noise)),
        MeasurementModel(see, Diagonal(sigma.square())),
        position=(0, 1),
    )


def coordinated_turn(runs: int, generator: Generator, turn_density: float = 1.75e-4, steps: int = 100) -> Scenario:
    """An aircraft that turns at an unknown rate, seen by a radar: states (x, dx, y, dy, rate), metres and rad/s.

    Arasaratnam and Haykin, "Cubature Kalman filters", 2009, section V: 1 s steps, 10 m and sqrt(10) mrad.
    """
    T = 1.0
    sigma = torch.tensor([10.0, math.sqrt(10.0) * 1e-3], dtype=torch.float64)
    start = torch.tensor([1000.0, 300.0, 1000.0, 0.0, math.radians(-3.0)], dtype=torch.float64)
    spread = torch.tensor([100.0, 10.0, 100.0, 10.0, 100e-6], dtype=torch.float64)
    pairs = constant_velocity(torch.full((2,), 0.1, dtype=torch.float64), T).noise
    assert isinstance(pairs, Tensor)
    noise = torch.block_diag(pairs, _matrix([[turn_density * T]]))

    def turn(state: Tensor) -> Tensor:
        x, dx, y, dy, rate = state.unbind(-1)
        angle = rate * T
        # sin(a) / rate and (1 - cos(a)) / rate, whole at a rate of zero.
        along = T * torch.sinc(angle / math.pi)
        across = T * torch.sin(0.5 * angle) * torch.sinc(0.5 * angle / math.pi)
        sine, cosine = torch.sin(angle), torch.cos(angle)
        return stack(
            [x + along * dx - across * dy, cosine * dx - sine * dy, y + across * dx + along * dy, sine * dx + cosine * dy, rate]
        )

    def see(state: Tensor) -> Tensor:
        return stack([torch.hypot(state[..., 0], state[..., 2]), torch.atan2(state[..., 2], state[..., 0])])

    def residual(measured: Tensor, predicted: Tensor) -> Tensor:
        difference = measured - predicted
        return stack([difference[..., 0], wrap_angle(difference[..., 1])])

    root = torch.linalg.cholesky(noise)
    x, truth = start.expand(runs, 5), []
    for _ in range(steps):
        x = turn(x) + _normal(generator, runs, 5) @ root.mT
        truth.append(x)
    states = torch.stack(truth)
    values = see(states) + sigma * _normal(generator, steps, runs, 2)
    mean = start + spread.sqrt() * _normal(generator, runs, 5)
    return Scenario(
        states,
        values,
        Gaussian(mean, torch.diag(spread)),
        MotionModel(turn, noise),
        MeasurementModel(see, Diagonal(sigma.square()), residual=residual),
        position=(0, 2),
    )


def localisation(runs: int, generator: Generator, rate: int = 100) -> Scenario:
    """A robot on a circle of 5 m radius for 40 s with odometry and GPS: states (x, y, theta), metres and radians.

    The benchmark of the ukfm package (Brossard et al. 2020): GPS at 1 Hz with 1 m; odometry of 0.01 m/s, 0.01 m/s and
    1 deg/s for each sample at 100 Hz; the position known at the start, the heading to 45 degrees.

    Args:
        rate: of the odometry, Hz. Its noise is scaled to the same random walk.
    """
    seconds, radius = 40, 5.0
    steps, T = seconds * rate, 1.0 / rate
    sigma = torch.tensor([0.01, 0.01, math.radians(1.0)], dtype=torch.float64) * math.sqrt(rate / 100)
    control = torch.tensor([2 * math.pi * radius / seconds, 0.0, 2 * math.pi / seconds], dtype=torch.float64)

    def drive(state: Tensor, noise: Tensor, odometry: Tensor) -> Tensor:
        velocity = odometry - noise
        cosine, sine = torch.cos(state[..., 2]), torch.sin(state[..., 2])
        forward, left = T * velocity[..., 0], T * velocity[..., 1]
        return stack(
            [
                state[..., 0] + cosine * forward - sine * left,
                state[..., 1] + sine * forward + cosine * left,
                state[..., 2] + T * velocity[..., 2],
            ]
        )

    x, path = torch.zeros(3, dtype=torch.float64), []
    for _ in range(steps):
        x = drive(x, torch.zeros(3, dtype=torch.float64), control)
        path.append(x)
    truth = torch.stack(path)
    truth[:, 2] = wrap_angle(truth[:, 2])
    truth = truth.unsqueeze(1).expand(steps, runs, 3)
    odometry = control + sigma * _normal(generator, steps, runs, 3)
    values = torch.full((steps, runs, 2), torch.nan, dtype=torch.float64)
    values[rate - 1 :: rate] = truth[rate - 1 :: rate, :, :2] + _normal(generator, seconds, runs, 2)
    heading = math.radians(45.0)
    mean = torch.zeros(runs, 3, dtype=torch.float64)
    mean[:, 2] = wrap_angle(heading * _normal(generator, runs))
    return Scenario(
        truth,
        values,
        Gaussian(mean, torch.diag(torch.tensor([0.0, 0.0, heading**2], dtype=torch.float64))),
        MotionModel(drive, Diagonal(sigma.square()), additive=False),
        MeasurementModel(lambda state: state[..., :2], torch.eye(2, dtype=torch.float64)),
        (odometry,),
        position=(0, 1),
    )


def stereo_pose(
    runs: int,
    generator: Generator,
    points: int = 4,
    steps: int = 60,
    pixel_sigma: float = 0.5,
    prior_sigma: Sequence[float] = (0.05, 0.1, 0.01, 0.02),
) -> Scenario:
    """The chapter's 12 states with the model that made them, (9.37)-(9.42): a camera drives towards points 10 to 40 m away.

    Args:
        points: m, known points, others in each run.
        pixel_sigma: of each pixel coordinate.
        prior_sigma: of position, velocity, angles and their rates; metres, radians and seconds.
    """
    T = 0.1
    motion = constant_velocity(torch.tensor([0.02] * 3 + [0.0002] * 3, dtype=torch.float64), T)
    mean, covariance = _pose_prior(prior_sigma)
    seen = _points_ahead(runs, points, generator)
    assert isinstance(motion.noise, Tensor)
    root = torch.linalg.cholesky(motion.noise)
    x, truth = mean + _normal(generator, runs, 12) @ covariance.sqrt(), []
    for _ in range(steps):
        x = x @ motion.matrix.mT + _normal(generator, runs, 12) @ root.mT
        truth.append(x)
    states = torch.stack(truth)
    return _stereo_scenario(states, motion, Gaussian(mean.expand(runs, 12), covariance), seen, pixel_sigma, generator)


def vague_prior(
    runs: int,
    generator: Generator,
    points: int = 200,
    pixel_sigma: float = 0.1,
    prior_sigma: Sequence[float] = (0.04, 0.1, 0.06, 0.1),
) -> Scenario:
    """One update with many precise points from a prior that is worse by far; arguments as `stereo_pose`."""
    mean, covariance = _pose_prior(prior_sigma)
    states = (mean + _normal(generator, runs, 12) @ covariance.sqrt()).unsqueeze(0)
    seen = _points_ahead(runs, points, generator)
    return _stereo_scenario(states, None, Gaussian(mean.expand(runs, 12), covariance), seen, pixel_sigma, generator)


def _stereo_scenario(
    states: Tensor,
    motion: LinearMotion | None,
    prior: Gaussian,
    points: Tensor,
    pixel_sigma: float,
    generator: Generator,
) -> Scenario:
    pixels = project_stereo(states, points, CAMERA)
    values = pixels + pixel_sigma * _normal(generator, *pixels.shape)
    noise = Diagonal(torch.full(pixels.shape[-1:], pixel_sigma**2, dtype=torch.float64))
    return Scenario(states, values, prior, motion, stereo_measurement(points, CAMERA, noise), position=(0, 2, 4))


def _pose_prior(sigma: Sequence[float]) -> tuple[Tensor, Tensor]:
    """Mean (12,) and diagonal covariance (12, 12) at the start, 0.5 m/s ahead."""
    mean = torch.zeros(12, dtype=torch.float64)
    mean[5] = 0.5
    position, velocity, angle, rate = sigma
    deviations = torch.tensor([position, velocity] * 3 + [angle, rate] * 3, dtype=torch.float64)
    return mean, torch.diag(deviations.square())


def _points_ahead(runs: int, points: int, generator: Generator) -> Tensor:
    """Points (runs, m, 3) in the image of a camera at the origin, 10 to 40 m ahead."""
    draws = torch.rand(runs, points, 3, generator=generator, dtype=torch.float64)
    Z = 10.0 + 30.0 * draws[..., 2]
    X = (draws[..., 0] * CAMERA.width - CAMERA.cx) / CAMERA.fx * Z
    Y = (draws[..., 1] * CAMERA.height - CAMERA.cy) / CAMERA.fy * Z
    return torch.stack([X, Y, Z], dim=-1)


def _grow(x: Tensor, wave: Tensor) -> Tensor:
    return 0.5 * x + 25.0 * x / (1.0 + x * x) + wave


def _normal(generator: Generator, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def _range(count: int) -> Tensor:
    return torch.arange(count, dtype=torch.float64)


def _matrix(rows: Sequence[Sequence[float]]) -> Tensor:
    return torch.tensor(rows, dtype=torch.float64)
