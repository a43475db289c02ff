"""Events that one compiled step serves: models of one structure, whose tensors are constants or inputs of the step."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sigmaslam_filters.bayes import BayesFilter
from sigmaslam_filters.core.noise_covariance import BlockDiagonal, Dense, Diagonal
from sigmaslam_filters.core.tensors import as_inputs
from sigmaslam_filters.gaussian_belief import Gaussian
from sigmaslam_filters.models import AnyMeasurement, AnyMotion
from sigmaslam_filters.robust import Robust
from sigmaslam_filters.time_series import Event

# Dimensions of a model's tensors behind the batch; of a tensor as a noise 2, of a matrix 2.
_OF_NOISE: dict[type, tuple[int, Callable[[Any], Tensor]]] = {
    Diagonal: (1, lambda noise: noise.variance()),
    Dense: (2, lambda noise: noise.covariance()),
    BlockDiagonal: (3, lambda noise: noise.blocks(noise.block_size)),
}
# What a step returns, as a sequence keeps it; where there is no motion or no measurement, less.
RESULTS = "mean", "held", "healthy", "predicted_mean", "predicted_held", "innovation", "nis", "count", "log_likelihood"


@dataclass(frozen=True, slots=True, eq=False)
class Kind:
    """A step, its models taken apart.

    Attributes:
        motion, measurement: with tensors that are constants; those of `places` are replaced.
        places: of each input that is a model's: whether it is the motion's, the field, and the noise's type or None.
        motion_inputs: how many.
        by_root: whether beliefs are held by roots.
    """

    bayes: BayesFilter
    motion: AnyMotion | None
    measurement: AnyMeasurement | None
    gate: float | None
    robust: Robust | None
    places: Sequence[tuple[bool, str, type | None]]
    motion_inputs: int
    by_root: bool

    @property
    def slots(self) -> list[int]:
        """Places of the step's results in `RESULTS`."""
        if self.measurement is None:
            return [0, 1, 2]
        return [0, 1, 2, *([] if self.motion is None else [3, 4]), 5, 6, 7, 8]

    def step(self) -> Callable[..., tuple[Tensor, ...]]:
        """(mean, held, *tensors of the models, value if there is one, *inputs) -> results at `slots`."""
        bayes = replace(self.bayes, on_failure="hold") if self.bayes.on_failure == "raise" else self.bayes
        places, count, gate, robust, by_root = self.places, self.motion_inputs, self.gate, self.robust, self.by_root
        fixed_motion, fixed_measurement = self.motion, self.measurement

        def step(mean: Tensor, held: Tensor, *given: Tensor) -> tuple[Tensor, ...]:
            motion, measurement, rest = fixed_motion, fixed_measurement, given[len(places) :]
            for (is_motion, name, kind), each in zip(places, given, strict=False):
                value = each if kind is None else kind(each)
                if is_motion:
                    motion = replace(motion, **{name: value})  # type: ignore[type-var]
                else:
                    measurement = replace(measurement, **{name: value})  # type: ignore[type-var]
            belief = as_belief(mean, held, by_root)
            seeing = rest if measurement is None else rest[1:]
            if motion is not None:
                moved = bayes.predict(belief, motion, *seeing[:count])
                belief = moved.belief
            if measurement is None:
                return belief.mean, belief.held, moved.healthy
            seen = bayes.update(belief, measurement, rest[0], *seeing[count:], gate=gate, robust=robust)
            healthy = seen.healthy if motion is None else seen.healthy & moved.healthy
            before = () if motion is None else (belief.mean, belief.held)
            counted = torch.zeros_like(seen.nis, dtype=torch.int64) + seen.count
            return (
                seen.belief.mean, seen.belief.held, healthy, *before, seen.innovation, seen.nis, counted,
                seen.log_likelihood,
            )  # fmt: skip

        return step


@dataclass(frozen=True, slots=True, eq=False)
class Group:
    """Events of one kind.

    Attributes:
        key: what is the same for all whose step is the same code.
        kind: of the step.
        times: (n,) places in the sequence.
        inputs: of the step, each (n, ...) or, of all events, (1, ...).
        trailing: dimensions of each input behind time and batch; None: what is left.
    """

    key: Any
    kind: Kind
    times: Tensor
    inputs: list[Tensor]
    trailing: list[int | None]


@dataclass(frozen=True, slots=True, eq=False)
class Stream:
    """Events of the same models.

    Attributes:
        event: their models and options.
        times: (n,) places in the sequence.
        value: (n, ..., m); None: nothing is measured.
        moving, seeing: inputs, each (n, ...) or, of all events, (1, ...).
    """

    event: Event
    times: Tensor
    value: Tensor | None
    moving: list[Tensor]
    seeing: list[Tensor]


def streams_of(events: Sequence[Event]) -> list[Stream]:
    """Events by their models, as arrays."""
    alike: dict[Any, list[int]] = {}
    for k, event in enumerate(events):
        shape = None if event.value is None else event.value.shape
        key = id(event.motion), id(event.measurement), event.gate, event.robust, shape
        alike.setdefault(key, []).append(k)
    streams = []
    for places in alike.values():
        mine = [events[k] for k in places]
        values = [event.value for event in mine if event.value is not None]
        moving = _stacked([as_inputs(event.motion_inputs) for event in mine], "motion")
        seeing = _stacked([as_inputs(event.measurement_inputs) for event in mine], "measurement")
        times = torch.from_numpy(np.array(places))
        streams.append(Stream(mine[0], times, _stack(values) if values else None, moving, seeing))
    return streams


def grouped(
    bayes: BayesFilter, streams: Sequence[Stream], by_root: bool, varying: set[Any], constants: dict[Any, Any]
) -> list[Group]:
    """Streams by the kind of their events.

    A model's tensor is a constant of the step if it is the same for all events of the kind, as it was at the last call,
    and no derivative by it is asked for; else it is an input. What was an input once stays one.

    Args:
        streams: all of a sequence.
        by_root: whether beliefs are held by roots.
        varying: keys of tensors that are inputs, to which more are added.
        constants: tensors by the same keys, as they are in compiled steps, to which more are added.
    """
    families: dict[Any, list[tuple[list[_Part], Stream]]] = {}
    for stream in streams:
        event = stream.event
        parts = [*_parts(event.motion, True), *_parts(event.measurement, False)]
        given = [each for each in (stream.value, *stream.moving, *stream.seeing) if each is not None]
        family = (
            _structure(event.motion), _structure(event.measurement), event.gate, event.robust, len(stream.moving),
            tuple((part.is_motion, part.name, part.type, part.tensor.shape) for part in parts),
            tuple(each.shape[1:] for each in given),
        )  # fmt: skip
        families.setdefault(family, []).append((parts, stream))
    groups = []
    for (*rest, _), members in families.items():
        # Steps are of one element: sizes of the batch make no other kind.
        family = tuple(rest)
        (first_parts, first), counts = members[0], [len(stream.times) for _, stream in members]
        inputs: list[Tensor] = []
        trailing: list[int | None] = []
        places: list[tuple[bool, str, type | None]] = []
        for i, part in enumerate(first_parts):
            tensors = [parts[i].tensor for parts, _ in members]
            same = all(each is part.tensor for each in tensors)
            if (
                not same
                or part.tensor.requires_grad
                or constants.setdefault((family, i), part.tensor) is not part.tensor
            ):
                varying.add((family, i))
            if (family, i) in varying:
                places.append((part.is_motion, part.name, part.type))
                trailing.append(part.trailing)
                inputs.append(part.tensor[None] if same else _joined([each[None] for each in tensors], counts))
        if first.value is not None:
            inputs.append(_joined([stream.value for _, stream in members], counts))  # type: ignore[misc]
            trailing.append(1)
        for name in ("moving", "seeing"):
            columns = zip(*(getattr(stream, name) for _, stream in members), strict=True)
            inputs += [_joined(column, counts) for column in columns]
        trailing += [None] * (len(first.moving) + len(first.seeing))
        event = first.event
        kind = Kind(
            bayes, event.motion, event.measurement, event.gate, event.robust, places, len(first.moving), by_root
        )
        times = torch.cat([stream.times for _, stream in members])
        groups.append(Group((family, tuple(places)), kind, times, inputs, trailing))
    return groups


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """A tensor of a model."""

    is_motion: bool
    name: str
    type: type | None
    trailing: int
    tensor: Tensor


def _parts(model: AnyMotion | AnyMeasurement | None, is_motion: bool) -> list[_Part]:
    found = []
    for field in fields(model) if model is not None else ():
        value = getattr(model, field.name)
        if isinstance(value, Tensor):
            found.append(_Part(is_motion, field.name, None, 1 if field.name == "mask" else 2, value))
        elif type(value) in _OF_NOISE:
            trailing, tensor_of = _OF_NOISE[type(value)]
            found.append(_Part(is_motion, field.name, type(value), trailing, tensor_of(value)))
    return found


def _structure(model: AnyMotion | AnyMeasurement | None) -> Any:
    """What a model has beside tensors."""
    if model is None:
        return None
    values = [getattr(model, field.name) for field in fields(model)]
    return type(model), *(None if isinstance(v, Tensor) or type(v) in _OF_NOISE else v for v in values)


def _joined(arrays: Sequence[Tensor], counts: Sequence[int]) -> Tensor:
    """Arrays (n, ...), or (1, ...) for n events, of several streams one after the other."""
    if len(arrays) == 1:
        return arrays[0]
    return torch.cat([each.expand(count, *each.shape[1:]) for each, count in zip(arrays, counts, strict=True)])


def _stacked(rows: list[tuple[Tensor, ...]], name: str) -> list[Tensor]:
    """Inputs of several events (n, ...)."""
    if not any(rows):
        return []
    try:
        return [_stack(column) for column in zip(*rows, strict=True)]
    except ValueError as error:
        raise ValueError(f"{name} inputs of events with one {name} differ in number or shape: {error}") from error


def _stack(column: Sequence[Tensor]) -> Tensor:
    """Tensors of one shape as (n, ...); (1, ...) if they are one."""
    first, shapes = column[0], {each.shape for each in column}
    if len(shapes) > 1:
        raise ValueError(", ".join(str(tuple(shape)) for shape in shapes))
    if column[-1] is first and all(each is first for each in column):
        return first[None]
    # Many times as fast as `torch.stack`, which makes a view of each.
    return torch.cat(list(column)).reshape(len(column), *first.shape) if first.ndim else torch.stack(list(column))


def as_belief(mean: Tensor, held: Tensor, by_root: bool) -> Gaussian:
    """A belief by what it is held by."""
    if by_root:
        return Gaussian(mean, factor=held, factor_is_lower=True)
    return Gaussian(mean, held, is_symmetric=True)
