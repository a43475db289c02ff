"""Whole sequences: filtering, and Rauch-Tung-Striebel smoothing by square roots, on manifolds too."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from sigmaslam_filters.checks import BY_TIME, check_model
from sigmaslam_filters.core.factors import apply, multiply, solve_lower_transposed, square, triangularise
from sigmaslam_filters.core.failure import FilterError
from sigmaslam_filters.core.tensors import Inputs, as_inputs, require_tensor, shapes_of
from sigmaslam_filters.gaussian_belief import Gaussian
from sigmaslam_filters.linearisation import Linearisation
from sigmaslam_filters.models import MEASUREMENTS, MOTIONS, AnyMeasurement, AnyMotion
from sigmaslam_filters.results import TimeUpdate, Update
from sigmaslam_filters.robust import Robust


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Event:
    """What happens to a belief: a motion, then a measurement, either of which may be missing.

    Sensors, rates, time steps and noises may differ from event to event.

    Attributes:
        motion: since the event before; None: no time passed.
        measurement: None: nothing was measured.
        value: (..., m) of the measurement.
        motion_inputs: what `predict` passes on: a tensor, several in order, or several by names, in order.
        measurement_inputs: what `update` passes on.
        gate, robust: as `update`.
    """

    motion: AnyMotion | None = None
    measurement: AnyMeasurement | None = None
    value: Tensor | None = None
    motion_inputs: Inputs = ()
    measurement_inputs: Inputs = ()
    gate: float | None = None
    robust: Robust | None = None

    __repr__ = shapes_of

    def __post_init__(self) -> None:
        if self.motion is not None:
            check_model(self.motion, MOTIONS, "an event's motion, its first argument,")
        if self.measurement is not None:
            check_model(self.measurement, MEASUREMENTS, "an event's measurement, its second argument,")
        if (self.measurement is None) != (self.value is None):
            raise ValueError("an event with a measurement needs a value, and one with a value a measurement")


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Track:
    """A filtered sequence; time is the first dimension of everything.

    Attributes:
        predicted: beliefs before each measurement, (T, ...).
        filtered: beliefs after each measurement, (T, ...).
        innovation: (T, ..., m); of events with measurements of several sizes, zeros fill up to the largest.
        nis: (T, ...), with `count` degrees of freedom.
        count: (T, ...) components that took part.
        log_likelihood: (T, ...) of each measurement given those before; its sum is that of the sequence.
        healthy: (T, ...) bool, False where the policy on failure had to act.
    """

    predicted: Gaussian
    filtered: Gaussian
    innovation: Tensor
    nis: Tensor
    count: Tensor
    log_likelihood: Tensor
    healthy: Tensor
    _predictions: Sequence[TimeUpdate | None] = field(repr=False)

    __repr__ = shapes_of

    @classmethod
    def of(cls, prior: Gaussian, steps: Sequence[tuple[TimeUpdate | None, Update | None]]) -> "Track":
        """The track of a loop of one's own, which can be smoothed.

        Args:
            prior: before the first step.
            steps: what `predict` and `update` returned in each, each of the belief before; None where it was not asked.
        Raises:
            ValueError: the batch changes on the way.
        """
        predicted: list[Gaussian] = []
        filtered: list[Gaussian] = []
        for prediction, update in steps:
            predicted.append((filtered[-1] if filtered else prior) if prediction is None else prediction.belief)
            filtered.append(predicted[-1] if update is None else update.belief)
        return _track(predicted, filtered, *zip(*steps, strict=True))


class SequenceFilter(ABC):
    """What a filter of single steps does with whole sequences."""

    __slots__ = ()

    linearisation: Linearisation

    @abstractmethod
    def predict(self, belief: Gaussian, motion: AnyMotion, *inputs: Tensor) -> TimeUpdate:
        """The belief after a motion."""

    @abstractmethod
    def update(
        self,
        belief: Gaussian,
        measurement: AnyMeasurement,
        value: Tensor,
        *inputs: Tensor,
        gate: float | None = None,
        robust: Robust | None = None,
    ) -> Update:
        """The belief after a measurement."""

    def filter(
        self,
        belief: Gaussian,
        motion: AnyMotion | Sequence[AnyMotion],
        measurement: AnyMeasurement | Sequence[AnyMeasurement],
        values: Tensor,
        motion_inputs: Inputs = (),
        measurement_inputs: Inputs = (),
        *,
        gate: float | None = None,
        robust: Robust | None = None,
    ) -> Track:
        """Update, predict, update, ...: T measurements and the T - 1 motions between them.

        Args:
            belief: at the time of the first measurement, before it; batch (...,), to which that of the values
                broadcasts, or the other way round.
            motion: the same for all steps, but for its inputs; or T - 1 of them, of matrices or noises that change.
            measurement: likewise, or T of them, of masks that change too.
            values: (T, ..., m); NaN for what is missing.
            motion_inputs: (T - 1, ...) each: element k moves step k to k + 1. One tensor, several in order, or by
                names, in order.
            measurement_inputs: (T, ...) each.
            gate, robust: as `update`.
        Raises:
            FilterError: as `predict` and `update`; the message begins with the step.
            ValueError: lengths do not fit.
        """
        moving, seeing = as_inputs(motion_inputs), as_inputs(measurement_inputs)
        steps = count_steps(values, moving, seeing)
        motions, measurements = _each(motion, steps - 1, "motions"), _each(measurement, steps, "measurements")
        events = (
            Event(
                motions[k - 1] if k else None,
                measurements[k],
                values[k],
                [given[k - 1] for given in moving] if k else (),
                [given[k] for given in seeing],
                gate,
                robust,
            )
            for k in range(steps)
        )
        return self.filter_events(belief, list(events))

    def filter_events(self, belief: Gaussian, events: Sequence[Event]) -> Track:
        """Predict and update, event by event; the track has one entry for each and can be smoothed.

        Args:
            belief: before the first event; batch (...,), to which those of the values broadcast, or the other way
                round.
            events: in the order of time.
        Raises:
            FilterError: as `predict` and `update`; the message begins with the step.
            ValueError: there is no event, or shapes do not fit.
        """
        if not events:
            raise ValueError("a sequence needs one event at least")
        shapes = {event.value.shape[:-1] for event in events if isinstance(event.value, Tensor)}
        batch = torch.broadcast_shapes(belief.batch_shape, *shapes)
        if belief.batch_shape != batch:
            belief = belief.expand(batch)
        prior, steps = belief, []
        for k, event in enumerate(events):
            moved, seen = None, None
            try:
                if event.motion is not None:
                    moved = self.predict(belief, event.motion, *as_inputs(event.motion_inputs))
                    belief = moved.belief
                if event.measurement is not None and event.value is not None:
                    seen = self.update(
                        belief,
                        event.measurement,
                        event.value,
                        *as_inputs(event.measurement_inputs),
                        gate=event.gate,
                        robust=event.robust,
                    )
                    belief = seen.belief
            except FilterError as error:
                raise FilterError(f"step {k} of {len(events)}: {error}") from error
            if belief.batch_shape != batch:
                raise ValueError(
                    f"step {k} of {len(events)}: models or inputs make of the batch {tuple(batch)} one of "
                    f"{tuple(belief.batch_shape)}. {BY_TIME}; for a model with a batch expand the prior "
                    "(Gaussian.expand)"
                )
            steps.append((moved, seen))
        return Track.of(prior, steps)

    def smooth(self, track: Track, lag: int | None = None) -> Gaussian:
        """Beliefs given all measurements, (T, ...), by the RTS recursion.

        Rauch et al. 1965; Särkkä 2008 for sigma points.

        The backward gain and the covariance of a state given the next come from one triangularisation of their joint
        deviations, so nothing is subtracted: the result is positive semidefinite in any dtype.

        Args:
            track: from `filter` or `filter_events`.
            lag: fixed-lag smoothing: each belief is given the measurements of as many later steps at most, at a cost
                of as many recursions; None: of all.
        Raises:
            ValueError: the lag is negative.
        """
        if lag is not None and lag < 0:
            raise ValueError(f"lag is {lag} steps; it must not be negative")
        last = len(track.filtered.mean) - 1
        if lag is None or lag >= last:
            later = track.filtered[last]
            smoothed = [later]
            for k in reversed(range(last)):
                later = self._smooth_step(track.filtered[k], track._predictions[k + 1], later)
                smoothed.append(later)
            return _stack(smoothed[::-1])
        smoothed = []
        for k in range(last + 1):
            later = track.filtered[min(k + lag, last)]
            for j in reversed(range(k, min(k + lag, last))):
                later = self._smooth_step(track.filtered[j], track._predictions[j + 1], later)
            smoothed.append(later)
        return _stack(smoothed)

    def _smooth_step(self, filtered: Gaussian, prediction: TimeUpdate | None, later: Gaussian) -> Gaussian:
        if prediction is None:
            return later
        odd, others, root = prediction.joint_root()
        size = root.shape[-1]
        pieces = [torch.cat([odd, root], dim=-2)]
        pieces += [torch.nn.functional.pad(other, (0, 0, 0, size)) for other in others]
        joint = triangularise(pieces)
        marginal, cross, conditional = joint[..., :size, :size], joint[..., size:, :size], joint[..., size:, size:]
        gain = solve_lower_transposed(marginal, cross.mT).mT
        expected = prediction.belief.mean
        chart = self.linearisation.chart
        difference = later.mean - expected if chart is None else chart(later.mean, expected)
        # The later belief's deviations, seen from the predicted mean instead of its own.
        deviations = self.linearisation.carry(later.mean, None, later.factor, expected)
        shift = apply(gain, difference)
        columns = triangularise([*(multiply(gain, part) for part in deviations), conditional])
        mean = self.linearisation.retract(filtered.mean, shift)
        carried = self.linearisation.carry(filtered.mean, shift, columns, mean)
        if filtered.is_square_root:
            lower = columns if chart is None else triangularise(carried)
            return Gaussian(mean, factor=lower, factor_is_lower=True)
        return Gaussian(mean, square(carried), is_symmetric=True)


def interleaved(streams: Sequence[Event], order: Tensor) -> list[Event]:
    """Events in the order of time, of streams by sensors.

    Args:
        streams: for each sensor an event whose value (n, ..., m) and inputs (n, ...) are those of its n readings.
        order: (T,) which stream each event is the next of.
    Raises:
        ValueError: a stream has another length than the order says.
    """
    check_streams(streams, order)
    taken, events = [0] * len(streams), []
    for k in order.tolist():
        stream, at = streams[k], taken[k]
        taken[k] += 1
        moving, seeing = (
            tuple(each[at] for each in as_inputs(given)) for given in (stream.motion_inputs, stream.measurement_inputs)
        )
        value = None if stream.value is None else stream.value[at]
        events.append(
            Event(stream.motion, stream.measurement, value, moving, seeing, gate=stream.gate, robust=stream.robust)
        )
    return events


def check_streams(streams: Sequence[Event], order: Tensor) -> None:
    """Lengths of streams are those that the order (T,) has of each.

    Raises:
        ValueError: they are not.
    """
    if order.numel() and not 0 <= int(order.min()) <= int(order.max()) < len(streams):
        raise ValueError(
            f"the order names streams {int(order.min())} to {int(order.max())}, but {len(streams)} are given"
        )
    for k, stream in enumerate(streams):
        count = int((order == k).sum())
        values = () if stream.value is None else (stream.value,)
        given = [*values, *as_inputs(stream.motion_inputs), *as_inputs(stream.measurement_inputs)]
        if any(len(each) != count for each in given):
            lengths = ", ".join(str(len(each)) for each in given)
            raise ValueError(f"stream {k} comes {count} times in the order, but its value and inputs have {lengths}")


def _each(given: Any, count: int, name: str) -> Sequence[Any]:
    """A model for each step."""
    if not isinstance(given, Sequence):
        return [given] * count
    if len(given) != count:
        raise ValueError(f"{count} {name} expected, one for each step, got {len(given)}")
    return given


def count_steps(values: Tensor, motion_inputs: Sequence[Tensor], measurement_inputs: Sequence[Tensor]) -> int:
    """T of a sequence's values (T, ..., m).

    Raises:
        ValueError: there is none, or the inputs' lengths do not fit.
    """
    require_tensor("values", values)
    steps = values.shape[0] if values.ndim else 0
    if values.ndim < 2 or steps == 0:
        raise ValueError(f"values (T, ..., m) with T > 0 expected, got {tuple(values.shape)}")
    for inputs, length, name in ((motion_inputs, steps - 1, "motion"), (measurement_inputs, steps, "measurement")):
        if any(len(given) != length for given in inputs):
            lengths = ", ".join(str(len(given)) for given in inputs)
            raise ValueError(f"{steps} measurements need {name} inputs of length {length}, got {lengths}")
    return steps


def _track(
    predicted: Sequence[Gaussian],
    filtered: Sequence[Gaussian],
    predictions: Sequence[TimeUpdate | None],
    updates: Sequence[Update | None],
) -> Track:
    nothing = torch.zeros_like(filtered[-1].mean[..., 0])
    unharmed = torch.ones_like(nothing, dtype=torch.bool)
    size = max((update.innovation.shape[-1] for update in updates if update is not None), default=0)
    innovation, nis, count, likelihood, healthy = [], [], [], [], []
    for prediction, update in zip(predictions, updates, strict=True):
        sound = unharmed if prediction is None else prediction.healthy
        if update is None:
            innovation.append(nothing.unsqueeze(-1).expand(*nothing.shape, size))
            nis.append(nothing)
            count.append(torch.zeros_like(nothing, dtype=torch.int64))
            likelihood.append(nothing)
            healthy.append(sound)
            continue
        found = update.innovation
        innovation.append(torch.nn.functional.pad(found, (0, size - found.shape[-1])))
        nis.append(update.nis)
        count.append(torch.as_tensor(update.count, device=nothing.device).expand(nothing.shape))
        likelihood.append(update.log_likelihood)
        healthy.append(sound & update.healthy)
    return Track(
        _stack(predicted),
        _stack(filtered),
        torch.stack(innovation),
        torch.stack(nis),
        torch.stack(count),
        torch.stack(likelihood),
        torch.stack(healthy),
        predictions,
    )


def _stack(beliefs: Sequence[Gaussian]) -> Gaussian:
    """Beliefs of one batch shape with time before it, (T, ...)."""
    mean = torch.stack([belief.mean for belief in beliefs])
    # The first belief may be held otherwise than those that a filter returns.
    if beliefs[-1].is_square_root:
        return Gaussian(mean, factor=torch.stack([belief.factor for belief in beliefs]), factor_is_lower=True)
    return Gaussian(mean, torch.stack([belief.covariance for belief in beliefs]), is_symmetric=True)
