"""A filter over whole sequences as machine code."""

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from sigmaslam_filters.bayes import BayesFilter
from sigmaslam_filters.compiler.compiled_step import compile_step
from sigmaslam_filters.compiler.event_kinds import RESULTS, Group, Kind, Stream, as_belief, grouped, streams_of
from sigmaslam_filters.core.factors import is_differentiated
from sigmaslam_filters.core.tensors import Inputs, as_inputs
from sigmaslam_filters.gaussian_belief import Gaussian
from sigmaslam_filters.models import AnyMeasurement, AnyMotion
from sigmaslam_filters.results import TimeUpdate
from sigmaslam_filters.robust import Robust
from sigmaslam_filters.time_series import Event, Track, check_streams, count_steps, interleaved

_log = logging.getLogger(__name__)
# Larger batches fill a processor's registers, and a loop around compiled steps over them is faster.
LARGEST_SCALAR_BATCH = 32


def compile_filter(
    bayes: BayesFilter,
    motion: AnyMotion | None = None,
    measurement: AnyMeasurement | None = None,
    *,
    gate: float | None = None,
    robust: Robust | None = None,
) -> "CompiledFilter":
    """`filter_events` as machine code, and `filter` of a motion and a measurement, for any number of steps.

    For up to `LARGEST_SCALAR_BATCH` filters each kind of event is a function of scalars, see
    `sigmaslam_filters.compiler.scalar_step`; otherwise it is a step from `compile_step`. Events are of one kind if
    their models have the same functions, and tensors of the same shapes.

    Args:
        bayes: a Kalman, extended or unscented filter.
        motion, measurement: what a call filters with; taken as they are now: compile anew after changing one.
        gate, robust: as `update`.
    """
    return CompiledFilter(bayes, motion, measurement, gate, robust)


@dataclass(frozen=True, slots=True, eq=False)
class CompiledFilter:
    """What `compile_filter` returns; attributes as there."""

    bayes: BayesFilter
    motion: AnyMotion | None = None
    measurement: AnyMeasurement | None = None
    gate: float | None = None
    robust: Robust | None = None
    # By kinds and shapes: a `CompiledStep`, None where there is none, or a step from `compile_step`.
    _scalar_steps: dict[Any, Any] = field(default_factory=dict, repr=False)
    _steps: dict[Any, Callable[..., tuple[Tensor, ...]]] = field(default_factory=dict, repr=False)
    _varying: set[Any] = field(default_factory=set, repr=False)
    _constants: dict[Any, Any] = field(default_factory=dict, repr=False)

    def __call__(
        self, belief: Gaussian, values: Tensor, motion_inputs: Inputs = (), measurement_inputs: Inputs = ()
    ) -> Track:
        """As `BayesFilter.filter` with the motion and the measurement; see `filter_events`."""
        motion, measurement, gate, robust = self.motion, self.measurement, self.gate, self.robust
        if motion is None or measurement is None:
            raise ValueError("compile_filter was given no motion or no measurement to filter values with")
        moving, seeing = as_inputs(motion_inputs), as_inputs(measurement_inputs)
        steps = count_steps(values, moving, seeing)
        batch = torch.broadcast_shapes(belief.batch_shape, values.shape[1:-1])
        prior = belief if belief.batch_shape == batch else belief.expand(batch)
        groups = []
        for k, (first, last) in enumerate(((0, 1), (1, steps))):
            if first == last:
                continue
            given = [values[first:last], *(moving if k else []), *(each[first:last] for each in seeing)]
            kind = Kind(
                self.bayes, motion if k else None, measurement, gate, robust, (), len(moving) if k else 0,
                self.bayes.goes_on_with_roots(prior),
            )  # fmt: skip
            groups.append(Group(k, kind, torch.arange(first, last), given, [1] + [None] * (len(given) - 1)))

        def uncompiled() -> Track:
            return self.bayes.filter(belief, motion, measurement, values, moving, seeing, gate=gate, robust=robust)

        def moves(k: int) -> tuple[AnyMotion | None, Sequence[Tensor]]:
            return (motion, [each[k - 1] for each in moving]) if k else (None, ())

        return self._track(prior, steps, groups, moves, uncompiled)

    def filter_events(self, belief: Gaussian, events: Sequence[Event]) -> Track:
        """As `BayesFilter.filter_events`; a track can be smoothed, and filtered on from any of its beliefs.

        The first call for each kind of event compiles, some ten seconds; with derivatives, twice. Derivatives by the
        prior, by values and inputs, and by noises and matrices of the models are those of `filter_events`; a number
        that a model's function refers to is a constant: make it an input.

        Raises:
            FilterError: as `filter_events`, by which a sequence that fails is filtered once more.
            ValueError: shapes do not fit.
        """
        return self._of_streams(belief, streams_of(events), lambda: events)

    def filter_streams(self, belief: Gaussian, streams: Sequence[Event], order: Tensor) -> Track:
        """`filter_events` of `interleaved(streams, order)`, which takes a tenth of the time without so many objects."""
        check_streams(streams, order)
        given = []
        for k, stream in enumerate(streams):
            inputs = list(as_inputs(stream.motion_inputs)), list(as_inputs(stream.measurement_inputs))
            if len(times := (order == k).nonzero()[:, 0]):
                given.append(Stream(stream, times, stream.value, *inputs))
        return self._of_streams(belief, given, lambda: interleaved(streams, order))

    def _of_streams(self, belief: Gaussian, streams: Sequence[Stream], events: Callable[[], Sequence[Event]]) -> Track:
        shapes = {stream.value.shape[1:-1] for stream in streams if stream.value is not None}
        if not streams:
            raise ValueError("a sequence needs one event at least")
        batch = torch.broadcast_shapes(belief.batch_shape, *shapes)
        prior = belief if belief.batch_shape == batch else belief.expand(batch)
        by_root = self.bayes.goes_on_with_roots(prior)
        groups = grouped(self.bayes, streams, by_root, self._varying, self._constants)
        made: list[Sequence[Event]] = []

        def moves(k: int) -> tuple[AnyMotion | None, Sequence[Tensor]]:
            if not made:
                made.append(events())
            event = made[0][k]
            return event.motion, as_inputs(event.motion_inputs)

        count = sum(len(stream.times) for stream in streams)
        return self._track(prior, count, groups, moves, lambda: self.bayes.filter_events(belief, events()))

    def _track(
        self,
        prior: Gaussian,
        events: int,
        groups: Sequence[Group],
        moves: Callable[[int], tuple[AnyMotion | None, Sequence[Tensor]]],
        uncompiled: Callable[[], Track],
    ) -> Track:
        by_root = self.bayes.goes_on_with_roots(prior)
        held, sound = prior.checked_factor() if by_root else (prior.covariance, None)
        if sound is not None and not bool(sound.all()):
            return uncompiled()
        if events == 1 and by_root != prior.is_square_root:
            return uncompiled()  # its only prediction is the prior, held as it was given
        start = as_belief(prior.mean, held, by_root)
        for group in groups:
            group.inputs[:] = [
                _with_batch(each, trailing, start.batch_shape)
                for each, trailing in zip(group.inputs, group.trailing, strict=True)
            ]
        differentiated = any(is_differentiated(each) for group in groups for each in (prior.mean, held, *group.inputs))
        found = self._scalar(start, events, groups)
        if found is None:
            if differentiated:
                return uncompiled()
            found = self._looped(start, events, groups)
        named = dict(zip(RESULTS, found, strict=True))
        if self.bayes.on_failure == "raise" and not bool(named["healthy"].all()):
            return uncompiled()
        before = [torch.cat([first[None], named[name][:-1]]) for first, name in ((start.mean, "mean"), (held, "held"))]
        predicted = [named["predicted_mean"], named["predicted_held"]]
        for group in groups:
            stays = group.kind.motion is None
            if stays or group.kind.measurement is None:
                sources = before if stays else [named["mean"], named["held"]]
                if len(group.times) == events:
                    predicted = sources
                else:
                    predicted = [
                        each.index_copy(0, group.times, source[group.times])
                        for each, source in zip(predicted, sources, strict=True)
                    ]
        filtered = as_belief(named["mean"], named["held"], by_root)
        return Track(
            as_belief(predicted[0], predicted[1], by_root),
            filtered,
            named["innovation"],
            named["nis"],
            named["count"],
            named["log_likelihood"],
            named["healthy"],
            _Predictions(self.bayes, prior, filtered, moves),
        )

    def _scalar(self, start: Gaussian, events: int, groups: Sequence[Group]) -> list[Tensor] | None:
        """`RESULTS` of each event, (T, *batch, ...), by functions of scalars; None: it cannot be written so."""
        batch = start.batch_shape
        if math.prod(batch) > LARGEST_SCALAR_BATCH or start.mean.device.type != "cpu":
            return None
        # It brings the compiler with it, which takes a second to load.
        from sigmaslam_filters.compiler.scalar_sequence import CompiledStep, Plan, run_sequence
        from sigmaslam_filters.compiler.scalar_step import ScalarStep, ScalarStepError

        state = [each.reshape(-1, *each.shape[len(batch) :]) for each in (start.mean, start.held)]
        compiled = []
        for group in groups:
            ones = [each[0].detach() for each in state] + [each[0, 0].detach() for each in group.inputs]
            key = group.key, start.is_square_root, tuple((each.dtype, each.shape) for each in ones)
            if key not in self._scalar_steps:
                step = group.kind.step()
                with torch.no_grad():
                    step(*ones)  # says what does not fit
                try:
                    scalar = ScalarStep(step, ones)
                    self._scalar_steps[key] = CompiledStep(scalar.source, group.kind.slots, scalar.adjoint_source)
                except ScalarStepError as error:
                    _log.info("a loop around compiled steps, because %s", error)
                    self._scalar_steps[key] = None
            compiled.append(self._scalar_steps[key])
        if any(each is None for each in compiled):
            return None
        kind, index = _order(events, groups)
        plan = Plan(compiled, kind, index, [len(group.inputs) for group in groups], self._results(start, groups))
        try:
            found = run_sequence(plan, state, [group.inputs for group in groups])
        except ScalarStepError as error:
            _log.info("filtered without compilation, because %s", error)
            return None
        return [each.unflatten(1, batch) if batch else each.squeeze(1) for each in found]

    def _looped(self, start: Gaussian, events: int, groups: Sequence[Group]) -> list[Tensor]:
        """The same by a loop around compiled steps."""
        batch, count = start.batch_shape, math.prod(start.batch_shape)
        inputs = [[each.expand(each.shape[0], count, *each.shape[2:]) for each in group.inputs] for group in groups]
        if batch:
            inputs = [[each.unflatten(1, batch) for each in given] for given in inputs]
            start = start.batch_last()
        else:
            inputs = [[each.squeeze(1) for each in given] for given in inputs]
        results = [
            torch.zeros(events, *batch, *shape, dtype=dtype, device=start.mean.device)
            for shape, dtype in self._results(start, groups)
        ]
        state = start.mean, start.held
        for t, (kind, index) in enumerate(zip(*(each.tolist() for each in _order(events, groups)), strict=True)):
            group = groups[kind]
            key = group.key, start.is_square_root
            if key not in self._steps:
                self._steps[key] = compile_step(group.kind.step())
            given = (each[index if len(each) > 1 else 0] for each in inputs[kind])
            with torch.no_grad():
                found = self._steps[key](*state, *given)
            state = found[0], found[1]
            for slot, each in zip(group.kind.slots, found, strict=True):
                into = results[slot][t]
                into[(..., slice(0, each.shape[-1])) if RESULTS[slot] == "innovation" else ...] = each
        return results

    def _results(self, start: Gaussian, groups: Sequence[Group]) -> list[tuple[Sequence[int], torch.dtype]]:
        """Shape and dtype of `RESULTS` of one element."""
        dtype, point, held = start.mean.dtype, start.mean.shape[-1:], start.held.shape[-2:]
        measured = [
            group.inputs[len(group.kind.places)].shape[-1] for group in groups if group.kind.measurement is not None
        ]
        sizes = [(point, dtype), (held, dtype), ((), torch.bool), (point, dtype), (held, dtype)]
        return [*sizes, ((max(measured, default=0),), dtype), ((), dtype), ((), torch.int64), ((), dtype)]


@dataclass(frozen=True, slots=True, eq=False)
class _Predictions(Sequence["TimeUpdate | None"]):
    """The predictions of a track, made again when a smoother asks for them."""

    bayes: BayesFilter
    prior: Gaussian
    filtered: Gaussian
    moves: Callable[[int], tuple[AnyMotion | None, Sequence[Tensor]]]

    def __len__(self) -> int:
        return len(self.filtered.mean)

    def __getitem__(self, k: Any) -> Any:
        motion, inputs = self.moves(k)
        if motion is None:
            return None
        return self.bayes.predict(self.filtered[k - 1] if k else self.prior, motion, *inputs)


def _order(events: int, groups: Sequence[Group]) -> tuple[Tensor, Tensor]:
    """Of each event the group and the place in it."""
    kind, index = torch.empty(events, dtype=torch.int64), torch.empty(events, dtype=torch.int64)
    for k, group in enumerate(groups):
        kind[group.times] = k
        index[group.times] = torch.arange(len(group.times))
    return kind, index


def _with_batch(given: Tensor, trailing: int | None, batch: torch.Size) -> Tensor:
    """(T, *batch, ...) as (T, B, ...), and (T, ...) of all elements as (T, 1, ...)."""
    lead, rest = given.shape[1 : 1 + len(batch)], given.shape[1 + len(batch) :]
    if trailing is None:
        batched = bool(rest) and all(length in (1, size) for length, size in zip(lead, batch, strict=True))
    else:
        batched = given.ndim - 1 - trailing > 0
        missing = len(batch) - (given.ndim - 1 - trailing)
        if batched and missing:
            given = given.reshape(len(given), *[1] * missing, *given.shape[1:])
            rest = given.shape[1 + len(batch) :]
    if not batched or not batch:
        return given.unsqueeze(1)
    return given.expand(len(given), *batch, *rest).reshape(len(given), math.prod(batch), *rest)
