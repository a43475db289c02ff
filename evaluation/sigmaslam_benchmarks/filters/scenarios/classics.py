"""Systems of the literature on nonlinear filters, with the figures they are known by."""

import math

import torch
from torch import Generator, Tensor

from sigmaslam_benchmarks.filters.scenarios.scenario import Scenario, matrix, normal
from sigmaslam_filters import Diagonal, Gaussian, LinearMotion, MeasurementModel, MotionModel, stack, wrap_angle
from sigmaslam_filters.systems import constant_velocity_over


def growth(runs: int, generator: Generator, steps: int = 500) -> Scenario:
    """Univariate nonstationary growth: two modes, for accuracy only, never for consistency.

    x' = x / 2 + 25 x / (1 + x^2) + 8 cos(1.2 (k - 1)) + w, z = x^2 / 20 + v, unit noises, x ~ N(0.1, 1) believed and
    0.1 true at the start, as in the EKF/UKF toolbox of Hartikainen, Solin and Särkkä (2011), section 2.5.
    """
    wave = (8.0 * torch.cos(1.2 * torch.arange(steps, dtype=torch.float64))).unsqueeze(-1)
    unit = matrix([1.0])
    motion = MotionModel(_grow, unit)
    measurement = MeasurementModel(lambda x: 0.05 * x * x, unit)
    x, truth = torch.full((runs, 1), 0.1, dtype=torch.float64), []
    for step in range(steps):
        x = _grow(x, wave[step]) + normal(generator, runs, 1)
        truth.append(x)
    states = torch.stack(truth)
    values = 0.05 * states * states + normal(generator, steps, runs, 1)
    prior = Gaussian(torch.full((runs, 1), 0.1, dtype=torch.float64), unit)
    return Scenario(states, values, prior, motion, measurement, (wave,))


def bearings(runs: int, generator: Generator) -> Scenario:
    """A target that turns three times, seen as two bearings: states (x, y, dx, dy).

    500 steps of 0.01 s; sensors at (-1, -2) and (1, 1), 0.05 rad; constant-velocity model with densities of 0.1 and the
    prior N(0, 4 I), as in the EKF/UKF toolbox, section 2.6.
    """
    T, sigma, steps = 0.01, 0.05, 500
    rate = torch.zeros(steps, runs, dtype=torch.float64)
    for first in (49, 199, 349):
        rate[first : first + 51] = 0.5 * math.pi / (51 * T) + 0.01 * normal(generator, 51, runs)
    # Each step is an arc: the chord has the heading of its middle.
    end = -torch.cumsum(rate * T, dim=0)
    middle, half = end + 0.5 * T * rate, 0.5 * T * rate
    chord = T * torch.sinc(half / math.pi)
    x, y = torch.cumsum(chord * torch.cos(middle), dim=0), torch.cumsum(chord * torch.sin(middle), dim=0)
    truth = torch.stack([x, y, torch.cos(end), torch.sin(end)], dim=-1)

    sensors = matrix([-1.0, -2.0], [1.0, 1.0])

    def see(state: Tensor) -> Tensor:
        return stack([torch.atan2(state[..., 1] - y, state[..., 0] - x) for x, y in sensors.tolist()])

    noise = sigma**2 * torch.eye(2, dtype=torch.float64)
    pairs = constant_velocity_over(torch.full((2,), 0.1, dtype=torch.float64), T)
    order = torch.tensor([0, 2, 1, 3])
    assert isinstance(pairs.noise, Tensor)
    motion = LinearMotion(pairs.matrix[order][:, order], pairs.noise[order][:, order])
    values = see(truth) + sigma * normal(generator, steps, runs, 2)
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
        return stack(
            [torch.hypot(state[..., 0] - radius, state[..., 1]), torch.atan2(state[..., 1], state[..., 0] - radius)]
        )

    spread = torch.tensor([1e-6, 1e-6, 1e-6, 1e-6, 0.0], dtype=torch.float64)
    x, truth = start + spread.sqrt() * normal(generator, runs, 5), []
    for _ in range(steps):
        x = fall(x) + drift.sqrt() * normal(generator, runs, 5)
        truth.append(x)
    states = torch.stack(truth)
    values = see(states) + sigma * normal(generator, steps, runs, 2)
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
    pairs = constant_velocity_over(torch.full((2,), 0.1, dtype=torch.float64), T).noise
    assert isinstance(pairs, Tensor)
    noise = torch.block_diag(pairs, matrix([turn_density * T]))

    def turn(state: Tensor) -> Tensor:
        x, dx, y, dy, rate = state.unbind(-1)
        angle = rate * T
        # sin(a) / rate and (1 - cos(a)) / rate, whole at a rate of zero.
        along = T * torch.sinc(angle / math.pi)
        across = T * torch.sin(0.5 * angle) * torch.sinc(0.5 * angle / math.pi)
        sine, cosine = torch.sin(angle), torch.cos(angle)
        return stack(
            [
                x + along * dx - across * dy,
                cosine * dx - sine * dy,
                y + across * dx + along * dy,
                sine * dx + cosine * dy,
                rate,
            ]
        )

    def see(state: Tensor) -> Tensor:
        return stack([torch.hypot(state[..., 0], state[..., 2]), torch.atan2(state[..., 2], state[..., 0])])

    def residual(measured: Tensor, predicted: Tensor) -> Tensor:
        difference = measured - predicted
        return stack([difference[..., 0], wrap_angle(difference[..., 1])])

    root = torch.linalg.cholesky(noise)
    x, truth = start.expand(runs, 5), []
    for _ in range(steps):
        x = turn(x) + normal(generator, runs, 5) @ root.mT
        truth.append(x)
    states = torch.stack(truth)
    values = see(states) + sigma * normal(generator, steps, runs, 2)
    mean = start + spread.sqrt() * normal(generator, runs, 5)
    return Scenario(
        states,
        values,
        Gaussian(mean, torch.diag(spread)),
        MotionModel(turn, noise),
        MeasurementModel(see, Diagonal(sigma.square()), residual=residual),
        position=(0, 2),
    )


def _grow(x: Tensor, wave: Tensor) -> Tensor:
    return 0.5 * x + 25.0 * x / (1.0 + x * x) + wave
