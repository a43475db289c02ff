"""A filter over whole sequences as machine code."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from sigmaslam_filters.bayes import BayesFilter
from sigmaslam_filters.compiler.compiled_step import compile_step
from sigmaslam_filters.gaussian_belief import Gaussian
from sigmaslam_filters.models import AnyMeasurement, AnyMotion
from sigmaslam_filters.results import TimeUpdate
from sigmaslam_filters.robust import Robust
from sigmaslam_filters.time_series import Track, count_steps

_log = logging.getLogger(__name__)
# Larger batches fill a processor's registers, and a loop around compiled steps over them is faster.
LARGEST_SCALAR_BATCH = 32


def compile_filter(
    bayes: BayesFilter,
    motion: AnyMotion,
    measurement: AnyMeasurement,
    *,
    gate: float | None = None,
    robust: Robust | None = None,
) -> CompiledFilter:
    """`BayesFilter.filter` of a motion and a measurement as machine code, for any number of steps.

    For up to `LARGEST_SCALAR_BATCH` filters of up to 8 states a sequence is one call of a function of scalars, see
    `sigmaslam_filters.compiler.scalar_loop`; otherwise it is a loop around a step from `compile_step`.

    Args:
        bayes: a Kalman, extended or unscented filter.
        motion, measurement: taken as they are now: compile anew after changing one.
        gate, robust: as `update`.
    """
    return CompiledFilter(bayes, motion, measurement, gate, robust)


@dataclass(frozen=True, slots=True, eq=False)
class CompiledFilter:
    """What `compile_filter` returns; attributes as there."""

    bayes: BayesFilter
    motion: AnyMotion
    measurement: AnyMeasurement
    gate: float | None = None
    robust: Robust | None = None
    _scalar_loops: dict[Any, Callable[..., list[Tensor]] | None] = field(default_factory=dict, repr=False)
    _steps: dict[Any, Callable[..., tuple[Tensor, ...]]] = field(default_factory=dict, repr=False)

    def __call__(
        self,
        belief: Gaussian,
        values: Tensor,
        motion_inputs: Sequence[Tensor] = (),
        measurement_inputs: Sequence[Tensor] = (),
    ) -> Track:
        """As `BayesFilter.filter`, without derivatives; a track can be smoothed.

        The first call for each set of sizes and dtypes compiles, ten seconds to a minute.

        Args:
            belief, values, motion_inputs, measurement_inputs: as of `filter`.
        Raises:
            FilterError: as `filter`, by which a sequence that fails is filtered once more.
            ValueError: shapes do not fit.
        """
        steps = count_steps(values, motion_inputs, measurement_inputs)
        batch = torch.broadcast_shapes(belief.batch_shape, values.shape[1:-1])
        prior = belief if belief.batch_shape == batch else belief.expand(batch)
        by_root = self.bayes.goes_on_with_roots(prior)
        held, sound = prior.checked_factor() if by_root else (prior.covariance, None)
        start = _belief(prior.mean, held, by_root)

        def uncompiled() -> Track:
            return self.bayes.filter(
                belief, self.motion, self.measurement, values, motion_inputs, measurement_inputs,
                gate=self.gate, robust=self.robust,
            )  # fmt: skip

        if steps == 1 or (sound is not None and not bool(sound.all())):
            return uncompiled()
        # The last state is moved as well, by any inputs, so that all steps are alike.
        moving = [torch.cat([given, given[-1:]]) for given in motion_inputs]
        missing = [1] * (len(batch) + 2 - values.ndim)
        value = values.reshape(steps, *missing, *values.shape[1:]).expand(steps, *batch, -1)
        inputs = [value, *moving, *measurement_inputs]
        with torch.no_grad():
            found = self._run(start, inputs, len(moving))
        next_mean, next_held, mean, after, innovation, nis, count, log_likelihood, seen, moved = found
        healthy = torch.cat([seen[:1], seen[1:] & moved[:-1]])
        if self.bayes.on_failure == "raise" and not bool(healthy.all()):
            return uncompiled()
        predicted = _belief(_after(prior.mean, next_mean), _after(held, next_held), by_root)
        filtered = _belief(mean, after, by_root)
        again = _Predictions(self.bayes, self.motion, filtered, motion_inputs)
        return Track(predicted, filtered, innovation, nis, count, log_likelihood, healthy, again)

    def _run(self, start: Gaussian, inputs: Sequence[Tensor], motions: int) -> list[Tensor]:
        """What each step returns, (T, *batch, ...)."""
        batch, state = start.batch_shape, (start.mean, start.held)
        if math.prod(batch) <= LARGEST_SCALAR_BATCH and start.mean.device.type == "cpu":
            states = [_by_element(each[None], batch)[0] for each in state]
            each_input = [_by_element(each, batch) for each in inputs]
            ones = [each[0] for each in states], [each[0, 0] for each in each_input]
            key = start.is_square_root, *((one.dtype, one.shape) for one in (*ones[0], *ones[1]))
            if key not in self._scalar_loops:
                self._scalar_loops[key] = self._scalar_loop(start, inputs, motions, ones)
            loop = self._scalar_loops[key]
            if loop is not None:
                found = loop(states, each_input)
                return [each.unflatten(1, batch) if batch else each.squeeze(1) for each in found]
        kind = start.is_square_root, motions
        if kind not in self._steps:
            self._steps[kind] = compile_step(self._step(*kind))
        run, results = self._steps[kind], []
        if batch:
            start = start.batch_last()
        mean, held = start.mean, start.held
        for given in zip(*inputs, strict=True):
            mean, held, *others = run(mean, held, *given)
            results.append((mean, held, *others))
        return [torch.stack(each) for each in zip(*results, strict=True)]

    def _scalar_loop(
        self, start: Gaussian, inputs: Sequence[Tensor], motions: int, ones: tuple[list[Tensor], list[Tensor]]
    ) -> Callable[..., list[Tensor]] | None:
        """The sequence as one function, if the step can be written so."""
        # It brings the compiler with it, which takes a second to load.
        from sigmaslam_filters.compiler.scalar_loop import ScalarLoop, ScalarLoopError

        step = self._step(start.is_square_root, motions)
        step(start.mean, start.held, *(given[0] for given in inputs))  # says what does not fit
        try:
            return ScalarLoop(step, *ones)
        except ScalarLoopError as error:
            _log.info("a loop around compiled steps, because %s", error)
            return None

    def _step(self, by_root: bool, motions: int) -> Callable[..., tuple[Tensor, ...]]:
        """(mean, held, value, *inputs) -> mean and held after the next motion, and what the track has of the step."""
        bayes = replace(self.bayes, on_failure="hold") if self.bayes.on_failure == "raise" else self.bayes
        motion, measurement, gate, robust = self.motion, self.measurement, self.gate, self.robust

        def step(mean: Tensor, held: Tensor, value: Tensor, *inputs: Tensor) -> tuple[Tensor, ...]:
            belief = _belief(mean, held, by_root)
            seen = bayes.update(belief, measurement, value, *inputs[motions:], gate=gate, robust=robust)
            moved = bayes.predict(seen.belief, motion, *inputs[:motions])
            count = torch.zeros_like(seen.nis, dtype=torch.int64) + seen.count
            return (
                moved.belief.mean, moved.belief.held, seen.belief.mean, seen.belief.held, seen.innovation, seen.nis,
                count, seen.log_likelihood, seen.healthy, moved.healthy,
            )  # fmt: skip

        return step


@dataclass(frozen=True, slots=True, eq=False)
class _Predictions(Sequence["TimeUpdate | None"]):
    """The predictions of a track, made again when a smoother asks for them."""

    bayes: BayesFilter
    motion: AnyMotion
    filtered: Gaussian
    inputs: Sequence[Tensor]

    def __len__(self) -> int:
        return len(self.filtered.mean)

    def __getitem__(self, k: Any) -> Any:
        if k == 0:
            return None
        return self.bayes.predict(self.filtered[k - 1], self.motion, *(given[k - 1] for given in self.inputs))


def _after(first: Tensor, later: Tensor) -> Tensor:
    """What each step began with, of what each ended with."""
    return torch.cat([first[None], later[:-1]])


def _belief(mean: Tensor, held: Tensor, by_root: bool) -> Gaussian:
    return Gaussian(mean, factor=held, factor_is_lower=True) if by_root else Gaussian(mean, held)


def _by_element(given: Tensor, batch: torch.Size) -> Tensor:
    """(T, *batch, ...) into (T, B, ...); what has no batch is that of all elements."""
    lead, rest = given.shape[1 : 1 + len(batch)], given.shape[1 + len(batch) :]
    if rest and all(length in (1, size) for length, size in zip(lead, batch, strict=True)):
        return given.expand(len(given), *batch, *rest).reshape(len(given), math.prod(batch), *rest)
    return given.unsqueeze(1).expand(len(given), math.prod(batch), *given.shape[1:])
