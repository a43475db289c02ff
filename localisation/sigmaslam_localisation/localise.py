"""Localisation of robots among known landmarks: predict, look at the sightings, learn their noise, update."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, Protocol

import numpy as np
import torch
from torch import Tensor

from sigmaslam_filters import (
    BayesFilter,
    Diagonal,
    ExtendedKalmanFilter,
    Gaussian,
    MeasurementModel,
    MotionModel,
    UnscentedKalmanFilter,
    Update,
    several,
)
from sigmaslam_filters.manifolds import Space
from sigmaslam_localisation.sighting_noise import STUDENT_DOF, NoiseScale, repetition
from sigmaslam_localisation.smoothing import Prediction, Smoother
from sigmaslam_localisation.steps import Steps

FilterName = Literal["ukf", "ekf", "iterated"]


def make_filter(name: FilterName, space: Space) -> BayesFilter:
    """The filter of that name; "iterated" linearises an update three times, each at the posterior of the one before."""
    if name == "ekf":
        return ExtendedKalmanFilter(space)
    return UnscentedKalmanFilter(space, iterations=3 if name == "iterated" else "auto")


class Platform(Protocol):
    """What moves and sees: its models."""

    def motion(self, path: Tensor, duration: Tensor) -> MotionModel:
        """Of a step."""
        ...

    def measurement(self) -> MeasurementModel:
        """Of one sighting."""
        ...

    def variance(self, value: Tensor) -> Tensor:
        """Of each component of sightings (..., m)."""
        ...


class Admission(Protocol):
    """Takes landmarks into the state at their first sighting; see `MappingRobot.admit`."""

    def __call__(
        self, bayes: BayesFilter, belief: Gaussian, value: Tensor, variance: Tensor, landmark: Tensor, new: Tensor
    ) -> Gaussian:
        """The belief with the new landmarks."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Localisation:
    """What a filter says of each step; time first, then robots.

    Attributes:
        mean: (K + 1, B, p) points of the state's space, or what was to be kept of them; the first is the start.
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


@dataclass(frozen=True, slots=True, eq=False)
class _Sighted:
    """Sightings compared with a belief: all (B, L, ...)."""

    innovation: Tensor
    covariance: Tensor
    distance: Tensor
    weight: Tensor


@torch.no_grad()
def localise(
    bayes: BayesFilter,
    platform: Platform,
    prior: Gaussian,
    steps: Steps,
    scale: Tensor | None = None,
    tell: Callable[[float], None] | None = None,
    admit: Admission | None = None,
    kept: int | None = None,
    smoothing: bool = False,
) -> Localisation:
    """Filter all robots at once.

    Args:
        bayes: the filter.
        platform: models of the robots.
        prior: (B,) beliefs at the start.
        steps: (K, B) motions and sightings.
        scale: (B, m) variance of the noise at the start, over the nominal one; None: 1.
        tell: called with the share that is done.
        admit: for a map that is not known: first sightings go to it and update nothing, and the measurement's input is
            the number of the landmark (..., 1) instead of its place.
        kept: components of the state whose history is returned, in points and tangents; None: all.
        smoothing: keep what smoothers need; not with `kept`.
    """
    K, B, L, m = steps.value.shape
    path, duration, value, position = (
        torch.from_numpy(column) for column in (steps.path, steps.duration, steps.value, steps.position)
    )
    present = ~value.isnan().any(dim=-1)
    landmark, new = torch.from_numpy(steps.landmark), torch.zeros_like(present)
    if admit is not None:
        new = present & torch.from_numpy(steps.since).isinf()
        present, position = present & ~new, landmark[..., None]
    admitted = new.any(dim=-1).any(dim=-1).tolist()
    anything = present.any(dim=-1).any(dim=-1).tolist()
    growth = repetition(torch.from_numpy(steps.since))
    nominal = platform.variance(value)
    noise = NoiseScale(torch.ones(B, m, dtype=torch.float64) if scale is None else scale)
    see = several(platform.measurement(), L)
    belief = prior
    predictions: list[Prediction] = []
    means, covariances = [belief.mean[:, :kept]], [belief.covariance[:, :kept, :kept]]
    nis = torch.full((K, B, L), torch.nan, dtype=torch.float64)
    weight, innovation, scales = torch.ones(K, B, L), torch.full_like(value, torch.nan), torch.ones(K, B, m)
    log_likelihood = torch.zeros(B, dtype=torch.float64)
    for k in range(K):
        if tell is not None and k % 100 == 0:
            tell(k / K)
        moved = bayes.predict(belief, platform.motion(path[k], duration[k]), path[k], duration[k, :, None])
        belief = moved.belief
        if smoothing:
            predictions.append(Prediction.of(moved))
        if anything[k]:
            there = present[k]
            inputs = torch.where(there[..., None], value[k], torch.nan).flatten(-2), position[k]
            expected = torch.where(there[..., None], nominal[k] * noise.scale[:, None], 1.0)
            noisy = replace(see, noise=Diagonal((expected * growth[k, ..., None]).flatten(-2)))
            updated = bayes.update(belief, noisy, *inputs, robust="student_t")
            belief = updated.belief
            sighted = _compare(updated, expected, growth[k], there)
            log_likelihood += torch.where(there, _log_student(sighted, m) / growth[k], 0.0).sum(dim=-1)
            predicted = (torch.diagonal(sighted.covariance, dim1=-2, dim2=-1) - expected).clamp_min(0.0)
            noise = noise.learn(sighted.innovation, predicted, expected, sighted.weight / growth[k], there)
            nis[k] = torch.where(there, sighted.distance, torch.nan)
            innovation[k] = torch.where(there[..., None], sighted.innovation, torch.nan)
            weight[k] = torch.where(there, sighted.weight, 1.0)
        if admit is not None and admitted[k]:
            # The variance of Student's t: a first sighting may be an outlier, and nothing tells.
            spread = nominal[k] * noise.scale[:, None] * (STUDENT_DOF / (STUDENT_DOF - 2.0))
            belief = admit(bayes, belief, value[k], spread, landmark[k], new[k])
        scales[k] = noise.scale
        means.append(belief.mean[:, :kept])
        covariances.append(belief.covariance[:, :kept, :kept])
    filtered = Gaussian(torch.stack(means), torch.stack(covariances))
    return Localisation(
        filtered.mean.numpy(),
        filtered.covariance.numpy(),
        nis.numpy(),
        weight.numpy(),
        innovation.numpy(),
        scales.numpy(),
        log_likelihood.numpy(),
        belief,
        tuple(Smoother.of(bayes, filtered, predictions, robot) for robot in range(B)) if smoothing else (),
    )


def _compare(updated: Update, expected: Tensor, growth: Tensor, there: Tensor) -> _Sighted:
    """What an update says of each sighting, with the variance (B, L, m) that it would have if it were new."""
    L, m = expected.shape[-2:]
    assert updated.weight is not None
    weight = torch.where(there, updated.weight, 1.0)
    innovation = updated.innovation.unflatten(-1, (L, m))
    blocks = updated.innovation_covariance.unflatten(-1, (L, m)).unflatten(-3, (L, m))
    used = torch.diag_embed(expected * (growth / weight)[..., None])
    covariance = torch.diagonal(blocks, dim1=-4, dim2=-2).movedim(-1, -3) - used + torch.diag_embed(expected)
    distance = (innovation * torch.linalg.solve(covariance, innovation)).sum(dim=-1)
    return _Sighted(innovation, covariance, distance, weight)


def _log_student(sighted: _Sighted, components: int) -> Tensor:
    """Log-density (B, L) of innovations, but for a constant."""
    half = 0.5 * torch.linalg.slogdet(sighted.covariance)[1]
    return -half - 0.5 * (STUDENT_DOF + components) * torch.log1p(sighted.distance / STUDENT_DOF)
