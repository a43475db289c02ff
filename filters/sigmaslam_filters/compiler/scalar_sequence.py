"""Scalar steps of several kinds over time, one element after the other, and the gradient of it by the adjoint steps."""

import ctypes
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor
from torch._inductor.codecache import CppCodeCache

# Of each element and time: the kind's step, with pointers to the state before, to its inputs and to its results.
_DRIVER = """#include <cstdint>
typedef void (*Step)(const void* const*, void* const*);
typedef void (*Adjoint)(const void* const*, const void* const*, void* const*);
struct Array { char* start; int64_t by_time, by_element; };
static void fill(const Array* from, int64_t count, int64_t t, int64_t b, void** to) {
    for (int64_t i = 0; i < count; ++i) to[i] = from[i].start + t * from[i].by_time + b * from[i].by_element;
}
extern "C" void run(int64_t events, int64_t batch, const int64_t* kind, const int64_t* index, void* const* steps,
                    const Array* before, const Array* const* inputs, const int64_t* counts,
                    const Array* const* results, const int64_t* sizes, const Array* gradient_before,
                    const Array* const* gradients) {
    void *in[66], *out[66], *grad[66];
    for (int64_t b = 0; b < batch; ++b)
        for (int64_t step = 0; step < events; ++step) {
            const int64_t t = gradients ? events - 1 - step : step, k = kind[t];
            fill(before, 2, t, b, in);
            fill(inputs[k], counts[k], index[t], b, in + 2);
            fill(results[k], sizes[k], t, b, out);
            if (!gradients) { ((Step)steps[k])(in, out); continue; }
            fill(gradient_before, 2, t, b, grad);
            fill(gradients[k], counts[k], index[t], b, grad + 2);
            ((Adjoint)steps[k])(in, out, grad);
        }
}
"""


# The driver has places for as many.
_MOST_INPUTS = 64


class _Array(ctypes.Structure):
    _fields_ = (("start", ctypes.c_void_p), ("by_time", ctypes.c_int64), ("by_element", ctypes.c_int64))

    @classmethod
    def of(cls, given: Tensor) -> "_Array":
        """Of (T, B, ...) contiguous; a length of 1 is for all times, or all elements."""
        size = given[0, 0].numel() * given.element_size() if given.numel() else 0
        times, batch = given.shape[:2]
        return cls(given.data_ptr(), size * batch if times > 1 else 0, size if batch > 1 else 0)


class CompiledStep:
    """A kind of step as machine code: the state's two arrays and inputs -> results that begin with the next state."""

    def __init__(
        self,
        source: Callable[[], str],
        slots: Sequence[int],
        adjoint_source: Callable[[Sequence[bool]], str] | None = None,
    ) -> None:
        """Takes what `ScalarStep` writes, and for each of the step's results the place among the sequence's."""
        self.slots = slots
        self._source, self._adjoint_source = source, adjoint_source
        self._functions: dict[tuple[bool, ...], Any] = {}

    def step(self) -> Any:
        """The C function."""
        return self._function((), "step")

    def adjoint(self, wanted: Sequence[bool]) -> Any:
        """The C function that adds to the gradients by the state and by wanted inputs.

        Raises:
            ScalarStepError: an operation of the step has no derivative here.
        """
        return self._function((True, True, *wanted), "adjoint")

    def _function(self, key: tuple[bool, ...], name: str) -> Any:
        if key not in self._functions:
            source = self._source()
            if key:
                assert self._adjoint_source is not None
                source = self._adjoint_source(key)
            library = CppCodeCache.load(source)
            self._functions[key] = library, ctypes.cast(getattr(library, name), ctypes.c_void_p)
        return self._functions[key][1]


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """What happens in a sequence.

    Attributes:
        steps: the kinds.
        kind: (T,) of each event.
        index: (T,) which of its kind's inputs it has.
        inputs: of each kind, how many.
        results: shape and dtype of those of one element; the first two are the state.
    """

    steps: Sequence[CompiledStep]
    kind: Tensor
    index: Tensor
    inputs: Sequence[int]
    results: Sequence[tuple[Sequence[int], torch.dtype]]


def run_sequence(plan: Plan, state: Sequence[Tensor], inputs: Sequence[Sequence[Tensor]]) -> list[Tensor]:
    """Results (T, B, ...), zero where a kind has none; with derivatives where they are asked for.

    Args:
        plan: see there.
        state: (B, ...) before the first event.
        inputs: of each kind, (n, B, ...) for its n events; a length of 1 is for all events, or all elements.
    """
    flat = [each for kind in inputs for each in kind]
    return list(_Run.apply(plan, *state, *flat))  # type: ignore[no-untyped-call]


class _Run(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, plan: Plan, *given: Tensor) -> tuple[Tensor, ...]:
        events, batch = len(plan.kind), len(given[0])
        arrays = [each.detach().contiguous() for each in given]
        states = [torch.cat([first[None], first.new_zeros(events, *first.shape)]) for first in arrays[:2]]
        others = [torch.zeros(events, batch, *shape, dtype=dtype) for shape, dtype in plan.results[2:]]
        results = [states[0][1:], states[1][1:], *others]
        functions = [step.step() for step in plan.steps]
        _call(plan, functions, states, arrays[2:], results)
        ctx.plan, ctx.wanted = plan, [bool(each) for each in ctx.needs_input_grad[1:]]
        ctx.save_for_backward(*states, *arrays[2:])
        ctx.mark_non_differentiable(*(each for each in results if not each.is_floating_point()))
        ctx.set_materialize_grads(False)
        return tuple(results)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> Any:
        plan, wanted = ctx.plan, ctx.wanted
        states, inputs = ctx.saved_tensors[:2], ctx.saved_tensors[2:]
        by_state = [torch.zeros_like(each) for each in states]
        results = [each[1:] for each in by_state]
        for k, gradient in enumerate(gradients):
            shape, dtype = plan.results[k]
            if k < 2:
                if gradient is not None:
                    results[k].copy_(gradient)
            elif gradient is None:
                results.append(torch.zeros(1, 1, *shape, dtype=dtype))
            else:
                results.append(gradient.contiguous())
        by_input = [torch.zeros_like(each) for each in inputs]
        functions, first = [], 2
        for step, count in zip(plan.steps, plan.inputs, strict=True):
            functions.append(step.adjoint(wanted[first : first + count]))
            first += count
        _call(plan, functions, states, inputs, results, (by_state, by_input))
        found = [by_state[0][0], by_state[1][0], *by_input]
        return (None, *(each if asked else None for each, asked in zip(found, wanted, strict=True)))


def _call(
    plan: Plan,
    functions: Sequence[Any],
    before: Sequence[Tensor],
    inputs: Sequence[Tensor],
    results: Sequence[Tensor],
    gradients: tuple[Sequence[Tensor], Sequence[Tensor]] | None = None,
) -> None:
    if max(plan.inputs) > _MOST_INPUTS:
        raise ValueError(f"a step has {max(plan.inputs)} inputs, more than {_MOST_INPUTS}")
    kinds = len(plan.steps)
    arrays = [(_Array * len(step.slots))(*(_Array.of(results[slot]) for slot in step.slots)) for step in plan.steps]
    sizes = (ctypes.c_int64 * kinds)(*(len(step.slots) for step in plan.steps))

    def by_kind(flat: Sequence[Tensor]) -> Any:
        groups, first = [], 0
        for count in plan.inputs:
            groups.append((_Array * max(1, count))(*map(_Array.of, flat[first : first + count])))
            first += count
        return groups

    def pointers(groups: Sequence[Any]) -> Any:
        return (ctypes.c_void_p * kinds)(*(ctypes.addressof(group) for group in groups))

    def pair(tensors: Sequence[Tensor]) -> Any:
        return (_Array * 2)(*map(_Array.of, tensors))

    given, slopes = by_kind(inputs), None if gradients is None else by_kind(gradients[1])
    load_driver().run(
        ctypes.c_int64(len(plan.kind)),
        ctypes.c_int64(before[0].shape[1]),
        ctypes.c_void_p(plan.kind.data_ptr()),
        ctypes.c_void_p(plan.index.data_ptr()),
        (ctypes.c_void_p * kinds)(*functions),
        pair(before),
        pointers(given),
        (ctypes.c_int64 * kinds)(*plan.inputs),
        pointers(arrays),
        sizes,
        None if gradients is None else pair(gradients[0]),
        None if slopes is None else pointers(slopes),
    )


@lru_cache(maxsize=1)
def load_driver() -> Any:
    """The loop over time, compiled."""
    return CppCodeCache.load(_DRIVER)
