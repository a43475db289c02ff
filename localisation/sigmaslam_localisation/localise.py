"""Localisation of robots among known landmarks: predict, look at the sightings, learn their noise, update."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from sigmaslam.errors import InputError
from sigmaslam_filters import BayesFilter, ExtendedKalmanFilter, Gaussian, UnscentedKalmanFilter
from sigmaslam_filters.manifolds import Space
from sigmaslam_localisation.compiled_robot import run_compiled
from sigmaslam_localisation.mapping_robot import ROBOT_SIZE, MappingRobot
from sigmaslam_localisation.robot_step import Platform, RobotStep
from sigmaslam_localisation.sighting_noise import STUDENT_DOF, repetition
from sigmaslam_localisation.smoothing import Smoother
from sigmaslam_localisation.steps import Steps

FilterName = Literal["ukf", "ekf", "iterated"]


def make_filter(name: FilterName, space: Space) -> BayesFilter:
    """The filter of that name; "iterated" linearises an update three times, each at the posterior of the one before."""
    if name == "ekf":
        return ExtendedKalmanFilter(space)
    return UnscentedKalmanFilter(space, iterations=3 if name == "iterated" else "auto")


@dataclass(frozen=True, slots=True, eq=False)
class Localisation:
    """What a filter says of each step; time first, then robots.

    Attributes:
        mean: (K + 1, B, p) points of the state's space, without the landmarks; the first is the start.
        covariance: (K + 1, B, n, n) of the tangent, likewise.
        nis: (K, B, L) squared normalised innovation of each sighting; NaN for none.
        weight: (K, B, L) that robust weights leave of a sighting.
        innovation: (K, B, L, m), NaN for none.
        scale: (K, B, m) learned variance of the noise over the nominal one.
        log_likelihood: (B,) of all sightings, by Student's t; a repetition counts for what it tells.
        final: the belief at the end.
        smoothers: (B) of each robot, if they were asked for.
    """

    mean: np.ndarray
    covariance: np.ndarray
    nis: np.ndarray
    weight: np.ndarray
    innovation: np.ndarray
    scale: np.ndarray
    log_likelihood: np.ndarray
    final: Gaussian
    smoothers: tuple[Smoother, ...] = ()


@torch.no_grad()
def localise(
    bayes: BayesFilter,
    platform: Platform,
    prior: Gaussian,
    steps: Steps,
    scale: Tensor | None = None,
    tell: Callable[[float], None] | None = None,
    smoothing: bool = False,
) -> Localisation:
    """Filter all robots at once.

    Args:
        platform: models of the robots. The first sightings of a `MappingRobot` go into its map and update nothing.
        prior: (B,) beliefs at the start.
        steps: (K, B) motions and sightings.
        scale: (B, m) variance of the noise at the start, over the nominal one; None: 1.
        tell: called with the share that is done.
        smoothing: keep what smoothers need; not with a `MappingRobot`.
    Raises:
        InputError: there is no step.
    """
    K, B, L, m = steps.value.shape
    if not K:
        raise InputError("no command and no sighting is later than the start: do truth.csv and they have one clock?")
    path, duration, value, position = (
        torch.from_numpy(column) for column in (steps.path, steps.duration, steps.value, steps.position)
    )
    present = ~value.isnan().any(dim=-1)
    landmark, new = torch.from_numpy(steps.landmark), torch.zeros_like(present)
    mapper = platform if isinstance(platform, MappingRobot) else None
    kept = None if mapper is None else ROBOT_SIZE
    if mapper is not None:
        new = present & torch.from_numpy(steps.since).isinf()
        present, position = present & ~new, landmark[..., None]
    seen = torch.where(present[..., None], value, torch.nan)
    growth = repetition(torch.from_numpy(steps.since), steps.correlation)
    nominal = platform.variance(value)
    robot = RobotStep(bayes, platform, L)
    start = torch.ones(B, m, dtype=torch.float64) if scale is None else scale
    moves, sights = (path, duration), (seen, position, growth, nominal)
    found = None if mapper is not None else run_compiled(robot, prior, start, moves, sights, tell)
    if found is None:
        belief, known = prior, start
        admitted, anything = (each.any(dim=-1).any(dim=-1).tolist() for each in (new, present))
        rows = []
        for k in range(K):
            if tell is not None and k % 100 == 0:
                tell(k / K)
            belief = robot.move(belief, path[k], duration[k]).belief
            said = [torch.zeros(B, *shape, dtype=torch.float64) for shape in ((L,), (L,), (L, m), ())]
            if anything[k]:
                belief, known, *said = robot.look(belief, known, *(each[k] for each in sights))
            if mapper is not None and admitted[k]:
                # The variance of Student's t: a first sighting may be an outlier, and nothing tells.
                spread = nominal[k] * known[:, None] * (STUDENT_DOF / (STUDENT_DOF - 2.0))
                belief = mapper.admit(bayes, belief, value[k], spread, landmark[k], new[k])
            rows.append((belief.mean[:, :kept], belief.covariance[:, :kept, :kept], known, *said))
        found = belief, tuple(torch.stack(column) for column in zip(*rows, strict=True))
    final, (means, covariances, scales, nis, weight, innovation, log_likelihood) = found
    filtered = Gaussian(
        torch.cat([prior.mean[None, :, :kept], means]),
        torch.cat([prior.covariance[None, :, :kept, :kept], covariances]),
    )
    smoothers: tuple[Smoother, ...] = ()
    if smoothing:
        assert bayes.space is not None
        moved = robot.move(Gaussian(filtered.mean[:-1], filtered.covariance[:-1]), path, duration)
        smoothers = tuple(Smoother.of(bayes.space, filtered, moved))
    return Localisation(
        filtered.mean.numpy(),
        filtered.covariance.numpy(),
        torch.where(present, nis, torch.nan).numpy(),
        torch.where(present, weight, 1.0).numpy(),
        torch.where(present[..., None], innovation, torch.nan).numpy(),
        scales.numpy(),
        log_likelihood.sum(dim=0).numpy(),
        final,
        smoothers,
    )
