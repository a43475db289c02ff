"""Beliefs by samples: the bootstrap particle filter (Gordon et al. 1993), (9.21), and the ensemble Kalman filter."""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sigmaslam_filters.core.factors import apply
from sigmaslam_filters.core.noise_covariance import Noise, as_noise
from sigmaslam_filters.core.tensors import shapes_of
from sigmaslam_filters.gaussian_belief import Gaussian
from sigmaslam_filters.manifolds import Space, is_flat
from sigmaslam_filters.models import AnyMeasurement, AnyMotion, LinearMeasurement, LinearMotion

# Share of the particles below which the effective number makes a resampling.
_RESAMPLED_BELOW = 0.5
_ROUNDS_OF_THE_MEAN = 3


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Particles:
    """A belief by N weighted samples, for any batch (...,).

    Attributes:
        states: (N, ..., p), as the models' functions take them.
        log_weights: (N, ...) whose exponentials add up to 1.
        beliefs: batch (N, ...), what each particle knows of the part of the state that is not sampled, see `weigh`.
    """

    states: Tensor
    log_weights: Tensor
    beliefs: Gaussian | None = None

    __repr__ = shapes_of

    @property
    def effective_number(self) -> Tensor:
        """1 / sum w^2, (...,), from 1 to N."""
        return torch.exp(-torch.logsumexp(2.0 * self.log_weights, dim=0))


@dataclass(frozen=True, slots=True, eq=False)
class ParticleFilter:
    """Moves samples by the motion, noise included, and weighs them by the likelihood of what is measured.

    For beliefs that are no Gaussian: several peaks, bounds, long tails. The error falls with the root of the number of
    particles, and the number needed grows quickly with the dimensions: beyond 4 or so take another filter.

    Attributes:
        generator: of the random numbers; on the states' device.
        space: manifold of the state; None: R^n.
    """

    generator: torch.Generator
    space: Space | None = None

    def sample(self, belief: Gaussian, number: int) -> Particles:
        """Particles of equal weight from a Gaussian belief (...,)."""
        states = belief.sample(number, self.generator, self.space)
        return Particles(states, torch.full_like(states[..., 0], -math.log(number)))

    def predict(self, particles: Particles, motion: AnyMotion, *inputs: Tensor) -> Particles:
        """The particles after a motion, each with noise of its own."""
        states = particles.states
        factor = as_noise(motion.noise).factor()
        noise = apply(factor, self._normal((*states.shape[:-1], factor.shape[-1]), states))
        if not isinstance(motion, LinearMotion) and not motion.additive:
            return replace(particles, states=motion.evaluate(states, noise, *inputs))
        if motion.noise_matrix is not None:
            noise = apply(motion.noise_matrix, noise)
        return replace(particles, states=self._retract(motion.evaluate(states, *inputs), noise))

    def update(
        self, particles: Particles, measurement: AnyMeasurement, value: Tensor, *inputs: Tensor
    ) -> tuple[Particles, Tensor]:
        """The particles after a measurement, resampled where few carry the weight, and its log-likelihood (...,).

        Args:
            particles: batch (...,).
            measurement: with additive noise.
            value: (..., m); NaN for a component that is missing.
            inputs: passed on to the measurement's function.
        Raises:
            ValueError: the noise is not additive, so that its density is not known.
        """
        difference, noise, present = _differences(particles.states, measurement, value, inputs)
        white = noise.whitened(difference.unsqueeze(-1)).squeeze(-1)
        constant = noise.log_determinant() + present.sum(dim=-1) * math.log(2.0 * math.pi)
        return self.weigh(particles, -0.5 * (white.square().sum(dim=-1) + constant))

    def weigh(self, particles: Particles, log_likelihood: Tensor) -> tuple[Particles, Tensor]:
        """As `update`, given the log-likelihood (N, ...) of a measurement by each particle.

        So Rao-Blackwellised particles (Doucet et al. 2000) sample a part of the state alone. A Kalman filter has the
        others as a batch, `beliefs`, whose matrices may depend on the samples: its updates say the log-likelihoods.
        """
        log_weights = particles.log_weights + log_likelihood
        likelihood = torch.logsumexp(log_weights, dim=0)
        return self._resampled(replace(particles, log_weights=log_weights - likelihood)), likelihood

    def gaussian(self, particles: Particles) -> Gaussian:
        """Mean and covariance of the particles, in the chart at the mean."""
        mean, offsets = self._spread(particles)
        weighted = (torch.exp(0.5 * particles.log_weights).unsqueeze(-1) * offsets).movedim(0, -1)
        return Gaussian(mean, weighted @ weighted.mT, is_symmetric=True)

    def _spread(self, particles: Particles) -> tuple[Tensor, Tensor]:
        """Mean (..., p), and tangents (N, ..., n) from it to the particles."""
        weights, states = torch.exp(particles.log_weights).unsqueeze(-1), particles.states
        if self.space is None or is_flat(self.space):
            mean = (weights * states).sum(dim=0)
            return mean, states - mean
        mean = states[0]
        for _ in range(_ROUNDS_OF_THE_MEAN):
            offsets = self.space.local(mean.expand_as(states), states)
            mean = self.space.retract(mean, (weights * offsets).sum(dim=0))
        return mean, self.space.local(mean.expand_as(states), states)

    def _resampled(self, particles: Particles) -> Particles:
        """Systematic resampling (Kitagawa 1996) of the elements whose effective number is low."""
        number = particles.states.shape[0]
        poor = particles.effective_number < _RESAMPLED_BELOW * number
        total = torch.exp(particles.log_weights).cumsum(dim=0).movedim(0, -1).contiguous()
        first = torch.rand(poor.shape, generator=self.generator, dtype=total.dtype, device=total.device)
        steps = torch.arange(number, dtype=total.dtype, device=total.device)
        at = ((steps + first.unsqueeze(-1)) / number * total[..., -1:]).contiguous()
        drawn = torch.searchsorted(total, at).clamp_max(number - 1)
        drawn = torch.where(poor.unsqueeze(-1), drawn, steps.long()).movedim(-1, 0)

        def taken(given: Tensor) -> Tensor:
            return given.gather(0, drawn[(..., *[None] * (given.ndim - drawn.ndim))].expand_as(given))

        beliefs = particles.beliefs
        if beliefs is not None:
            beliefs = Gaussian(taken(beliefs.mean), taken(beliefs.covariance), is_symmetric=True)
        log_weights = torch.where(poor, -math.log(number), particles.log_weights)
        return Particles(taken(particles.states), log_weights, beliefs)

    def _normal(self, shape: tuple[int, ...], like: Tensor) -> Tensor:
        return torch.randn(shape, generator=self.generator, dtype=like.dtype, device=like.device)

    def _retract(self, points: Tensor, tangents: Tensor) -> Tensor:
        return points + tangents if self.space is None else self.space.retract(points, tangents)


@dataclass(frozen=True, slots=True, eq=False)
class EnsembleKalmanFilter(ParticleFilter):
    """Corrects each sample by the gain of their common covariance (Evensen 1994; Burgers et al. 1998).

    Weights stay equal, so that a hundred samples serve a hundred dimensions; beliefs stay near to Gaussian.
    """

    def update(
        self, particles: Particles, measurement: AnyMeasurement, value: Tensor, *inputs: Tensor
    ) -> tuple[Particles, Tensor]:
        """The samples after a measurement, each given its own draw of the noise, and its log-likelihood (...,)."""
        difference, noise, present = _differences(particles.states, measurement, value, inputs)
        _, offsets = self._spread(particles)
        innovation = difference.mean(dim=0)
        spread, freedom = innovation - difference, len(difference) - 1
        own, cross = (torch.einsum("n...i,n...j->...ij", spread, each) / freedom for each in (spread, offsets))
        root = torch.linalg.cholesky(own + noise.covariance())
        gain = torch.cholesky_solve(cross, root).mT
        drawn = apply(noise.factor(), self._normal(tuple(difference.shape), difference))
        states = self._retract(particles.states, apply(gain, difference + torch.where(present, drawn, 0.0)))
        white = torch.linalg.solve_triangular(root, innovation.unsqueeze(-1), upper=False).squeeze(-1)
        squared = white.square().sum(dim=-1) + present.sum(dim=-1) * math.log(2.0 * math.pi)
        likelihood = -0.5 * squared - torch.diagonal(root, dim1=-2, dim2=-1).log().sum(dim=-1)
        return replace(particles, states=states), likelihood


def _differences(
    states: Tensor, measurement: AnyMeasurement, value: Tensor, inputs: tuple[Tensor, ...]
) -> tuple[Tensor, Noise, Tensor]:
    """Measured minus predicted (N, ..., m), zero where nothing was measured; the noise; what was measured (..., m)."""
    if not isinstance(measurement, LinearMeasurement) and not measurement.additive:
        raise ValueError("particles need the density of the measurement's noise: declare it additive")
    present = ~torch.isnan(value)
    if measurement.mask is not None:
        present = present & measurement.mask
    residual = None if isinstance(measurement, LinearMeasurement) else measurement.residual
    seen, filled = measurement.evaluate(states, *inputs), torch.where(present, value, 0.0)
    difference = filled - seen if residual is None else residual(filled, seen)
    noise = as_noise(measurement.noise)
    variance = noise.variance()
    if value.shape[-1:] != variance.shape[-1:] or torch.isinf(value).any() or (variance < 0.0).any():
        shown = f"{value.tolist()} by variances {variance.tolist()}"
        raise ValueError(f"a measurement is finite, and has as many components as variances, none negative: {shown}")
    return torch.where(present, difference, 0.0), noise.masked(present), present
