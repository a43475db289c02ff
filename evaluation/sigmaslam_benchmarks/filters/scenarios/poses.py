"""A robot in the plane and a stereo camera in space."""

import math
from collections.abc import Sequence

import torch
from torch import Generator, Tensor

from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam_benchmarks.filters.scenarios.scenario import Scenario, normal
from sigmaslam_filters import Diagonal, Gaussian, LinearMotion, MeasurementModel, MotionModel, stack, wrap_angle
from sigmaslam_filters.systems import constant_velocity_over, project_stereo

CAMERA = RectifiedStereo(fx=718.0, fy=718.0, cx=607.0, cy=185.0, baseline=0.54, width=1241, height=376)


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
    odometry = control + sigma * normal(generator, steps, runs, 3)
    values = torch.full((steps, runs, 2), torch.nan, dtype=torch.float64)
    values[rate - 1 :: rate] = truth[rate - 1 :: rate, :, :2] + normal(generator, seconds, runs, 2)
    heading = math.radians(45.0)
    mean = torch.zeros(runs, 3, dtype=torch.float64)
    mean[:, 2] = wrap_angle(heading * normal(generator, runs))
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
    """The chapter's 12 states with the model that made them, (9.37)-(9.42).

    A camera drives towards points 10 to 40 m away.

    Args:
        points: m, known points, others in each run.
        pixel_sigma: of each pixel coordinate.
        prior_sigma: of position, velocity, angles and their rates; metres, radians and seconds.
    """
    T = 0.1
    motion = constant_velocity_over(torch.tensor([0.02] * 3 + [0.0002] * 3, dtype=torch.float64), T)
    mean, covariance = _pose_prior(prior_sigma)
    seen = _points_ahead(runs, points, generator)
    assert isinstance(motion.noise, Tensor)
    root = torch.linalg.cholesky(motion.noise)
    x, truth = mean + normal(generator, runs, 12) @ covariance.sqrt(), []
    for _ in range(steps):
        x = x @ motion.matrix.mT + normal(generator, runs, 12) @ root.mT
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
    states = (mean + normal(generator, runs, 12) @ covariance.sqrt()).unsqueeze(0)
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
    values = pixels + pixel_sigma * normal(generator, *pixels.shape)
    noise = Diagonal(torch.full(pixels.shape[-1:], pixel_sigma**2, dtype=torch.float64))
    measurement = MeasurementModel(lambda state: project_stereo(state, points, CAMERA), noise)
    return Scenario(states, values, prior, motion, measurement, position=(0, 2, 4))


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
