"""A torch function of small tensors, written as C++ for one item at a time: a loop over items calls it.

The function is traced and done number by number. Zeros and ones that are known take no part, and what is computed
twice is computed once. What does not depend on the item itself but only on what many items have in common goes into a
function of its own, called once for all of them. The item's function is a template: a number may be a vector, one item
a lane.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, fx
from torch._decomp import core_aten_decompositions
from torch.fx.experimental.proxy_tensor import make_fx

aten = torch.ops.aten

_CONSTANT, _COMMON, _ITEM = range(3)
# Operations that only move numbers are done by torch itself, on the numbers' places in the program.
_MOVES = "expand slice select unsqueeze squeeze permute split_with_sizes diagonal clone cat index_select alias"
_COMPARED: dict[str, tuple[str, Callable[..., Any]]] = {
    "lt": ("<", operator.lt),
    "le": ("<=", operator.le),
    "gt": (">", operator.gt),
    "ge": (">=", operator.ge),
    "eq": ("==", operator.eq),
    "bitwise_and": ("&", operator.and_),
}
_ARITHMETIC: dict[str, tuple[str, Callable[..., Any]]] = {
    "add": ("+", operator.add),
    "sub": ("-", operator.sub),
    "mul": ("*", operator.mul),
    "div": ("/", operator.truediv),
}
_CALLS: dict[str, Callable[..., Any]] = {
    "sqrt": math.sqrt,
    "rsqrt": lambda x: 1.0 / math.sqrt(x),
    "sin": math.sin,
    "cos": math.cos,
    "isnan": math.isnan,
    "bitwise_not": operator.not_,
    "maximum": max,
}
_NAMES = {"clamp": "maximum", "clamp_min": "maximum", "logical_not": "bitwise_not", "logical_and": "bitwise_and"}


def write_functions(
    name: str, function: Callable[..., Sequence[Tensor]], common: Mapping[str, Tensor], item: Mapping[str, Tensor]
) -> str:
    """C++ of `{name}_common(in, out)` and of `{name}_item(shared, in, out)`, with the sizes of their arguments.

    Args:
        name: of the functions.
        function: (*common, *item) -> tensors; no branches on values, indices are constants.
        common: examples of what many items have in common, in order, laid out one after the other in `in`.
        item: examples of what each item has of its own, likewise; `out` has the results in order.
    Raises:
        ValueError: an operation has no form here.
    """
    arguments = [*common.values(), *item.values()]
    with torch.no_grad():
        module = make_fx(function, decomposition_table=dict(core_aten_decompositions().items()))(*arguments)
    program = _Program()
    inputs: list[Tensor] = []
    for level, group in ((_COMMON, common), (_ITEM, item)):
        place = 0
        for value in group.values():
            ids = [program.add("input", place + k, level=level) for k in range(value.numel())]
            inputs.append(torch.tensor(ids).reshape(value.shape))
            place += value.numel()
    results = _Interpreter(module, program, inputs).run_all()
    outputs = [int(each) for result in results for each in result.flatten()]
    sizes = [sum(value.numel() for value in group.values()) for group in (common, item)]
    return program.source(name, sizes, outputs)


class _Program:
    """Numbers by their place: each an operation on earlier ones, a constant or an input."""

    def __init__(self) -> None:
        self._known: dict[tuple[Any, ...], int] = {}
        self._entries: list[tuple[Any, ...]] = []
        self._levels: list[int] = []

    def add(self, operation: str, *arguments: Any, level: int | None = None) -> int:
        """The place of a number, which may be there already."""
        key = (operation, *arguments, level if operation == "input" else None)
        if operation == "constant":
            key = (operation, repr(arguments[0]), None)
        if key not in self._known:
            self._known[key] = len(self._entries)
            self._entries.append((operation, *arguments))
            self._levels.append(level if level is not None else max(self._levels[each] for each in arguments))
        return self._known[key]

    def constant(self, value: float | bool) -> int:
        """Of a known number."""
        return self.add("constant", value if isinstance(value, bool) else float(value), level=_CONSTANT)

    def value(self, place: int) -> Any:
        """A number that is known, or None."""
        operation, *arguments = self._entries[place]
        return arguments[0] if operation == "constant" else None

    def compute(self, operation: str, *places: int) -> int:
        """An operation, without what known zeros and ones make needless."""
        values = [self.value(each) for each in places]
        if operation == "where" and values[0] is not None:
            return places[1] if values[0] else places[2]
        if operation == "where" and places[1] == places[2]:
            return places[1]
        if all(value is not None for value in values) and operation != "where":
            known = (_ARITHMETIC | _COMPARED)[operation][1] if operation not in _CALLS else _CALLS[operation]
            return self.constant(known(*values))
        if 0.0 in values[: {"mul": 2, "div": 1}.get(operation, 0)]:
            return self.constant(0.0)
        neutral = {"mul": 1.0, "div": 1.0, "add": 0.0, "sub": 0.0}.get(operation)
        if neutral is not None and values[1] == neutral:
            return places[0]
        if operation in ("mul", "add") and values[0] == neutral:
            return places[1]
        return self.add(operation, *places)

    def source(self, name: str, sizes: Sequence[int], outputs: Sequence[int]) -> str:
        """Both functions."""
        needed, pending = set(), list(outputs)
        while pending:
            place = pending.pop()
            if place not in needed:
                needed.add(place)
                if self._entries[place][0] not in ("input", "constant"):
                    pending += self._entries[place][1:]
        shared = {each for each in outputs if self._levels[each] == _COMMON}
        for place in needed:
            if self._levels[place] == _ITEM and self._entries[place][0] != "input":
                shared |= {each for each in self._entries[place][1:] if self._levels[each] == _COMMON}
        numbers = {place: k for k, place in enumerate(sorted(shared))}
        ordered = sorted(needed)
        common = [line for each in ordered if self._levels[each] == _COMMON for line in self._lines(each)]
        common += [f"out[{k}] = {self._operand(place)};" for place, k in numbers.items()]
        item = [line for each in ordered if self._levels[each] == _ITEM for line in self._lines(each, numbers)]
        for k, place in enumerate(outputs):
            spread = "" if self._levels[place] == _ITEM else "Number{} + "
            item.append(f"out[{k}] = {spread}{self._operand(place, numbers)};")
        lengths = {"common_inputs": sizes[0], "inputs": sizes[1], "shared": len(shared), "outputs": len(outputs)}
        arguments = "const double* shared, const Number* in, Number* out"
        return "\n".join(
            [
                *(f"constexpr int {name}_{key} = {length};" for key, length in lengths.items()),
                f"void {name}_common(const double* in, double* out) {{",
                *(f"    {line}" for line in common),
                "}",
                f"template <typename Number> INLINE void {name}_item({arguments}) {{",
                *(f"    {line}" for line in item),
                "}",
                "",
            ]
        )

    def _lines(self, place: int, shared: Mapping[int, int] | None = None) -> list[str]:
        operation, *arguments = self._entries[place]
        if operation == "input":
            return [f"const auto v{place} = in[{arguments[0]}];"]
        named = [self._operand(each, shared) for each in arguments]
        infix = (_ARITHMETIC | _COMPARED).get(operation)
        text = f"{named[0]} {infix[0]} {named[1]}" if infix is not None else f"{operation}({', '.join(named)})"
        if operation == "where" and all(self._levels[each] < _ITEM for each in arguments[1:]) and shared is not None:
            text = f"where<Number>({', '.join(named)})"
        return [f"const auto v{place} = {text};"]

    def _operand(self, place: int, shared: Mapping[int, int] | None = None) -> str:
        value = self.value(place)
        if value is not None:
            return repr(value) if not isinstance(value, bool) else str(value).lower()
        if shared is not None and place in shared:
            return f"shared[{shared[place]}]"
        return f"v{place}"


class _Interpreter(fx.Interpreter):
    """Runs a traced function on places in a program instead of numbers."""

    def __init__(self, module: fx.GraphModule, program: _Program, inputs: Sequence[Tensor]) -> None:
        super().__init__(module)
        self._program, self._inputs = program, inputs

    def run_all(self) -> list[Tensor]:
        """The function's results."""
        results = self.run(*self._inputs, enable_io_processing=False)
        return list(results) if isinstance(results, tuple | list) else [results]

    def get_attr(self, target: Any, args: Any, kwargs: Any) -> Tensor:
        """A constant tensor."""
        return self._constants(super().get_attr(target, args, kwargs))

    def call_function(self, target: Any, args: Any, kwargs: Any) -> Any:
        """One operation."""
        if target is operator.getitem:
            return args[0][args[1]]
        name = target._opname
        name = _NAMES.get(name, name)
        if name == "view":
            return args[0].reshape(args[1])
        if name in _MOVES.split():
            if name == "index_select":
                args = (*args[:2], self._numbers(args[2]))
            kwargs = {} if name == "clone" else kwargs
            return target(*args, **kwargs)
        if name in ("full", "arange", "scalar_tensor"):
            return self._constants(target(*args, **kwargs))
        if name == "full_like":
            return torch.full_like(args[0], self._program.constant(float(args[1])))
        if name == "lift_fresh_copy":
            return args[0]
        if name == "constant_pad_nd":
            return aten.constant_pad_nd.default(args[0], args[1], self._program.constant(0.0))
        if name == "_to_copy":
            return self._converted(args[0], kwargs["dtype"])
        if name == "pow" and args[1] == 2:
            return self._each("mul", args[0], args[0])
        if name == "neg":
            return self._each("sub", 0.0, args[0])
        if name == "reciprocal":
            return self._each("div", 1.0, args[0])
        if name in ("mm", "bmm"):
            return self._product(*args)
        if name in ("sum", "amax"):
            return self._reduced("add" if name == "sum" else "maximum", *args)
        if name == "linalg_inv_ex":
            return self._inverse(args[0]), None
        if name in _ARITHMETIC or name in _COMPARED or name in _CALLS or name == "where":
            return self._each(name, *args)
        raise ValueError(f"there is no form of {target} in C++")

    def _constants(self, values: Tensor) -> Tensor:
        known = [self._program.constant(each.item()) for each in values.flatten()]
        return torch.tensor(known, dtype=torch.int64).reshape(values.shape)

    def _numbers(self, places: Tensor) -> Tensor:
        return torch.tensor([int(self._program.value(int(each))) for each in places])

    def _converted(self, places: Tensor, dtype: torch.dtype) -> Tensor:
        """Booleans as numbers; numbers as they are."""
        if not dtype.is_floating_point:
            return places
        results = []
        for place in places.flatten().tolist():
            operation, *_ = self._program._entries[place]
            if operation in _COMPARED or operation in ("isnan", "bitwise_not"):
                place = self._program.compute("where", place, self._program.constant(1.0), self._program.constant(0.0))
            elif isinstance(self._program.value(place), bool):
                place = self._program.constant(float(self._program.value(place)))
            results.append(place)
        return torch.tensor(results).reshape(places.shape)

    def _each(self, operation: str, *operands: Any) -> Tensor:
        tensors = [
            each if isinstance(each, Tensor) else torch.tensor(self._program.constant(each)) for each in operands
        ]
        shaped = torch.broadcast_tensors(*tensors)
        rows = zip(*(each.flatten().tolist() for each in shaped), strict=True)
        places = [self._program.compute(operation, *row) for row in rows]
        return torch.tensor(places, dtype=torch.int64).reshape(shaped[0].shape)

    def _product(self, left: Tensor, right: Tensor) -> Tensor:
        total = self._each("mul", left[..., :, :1], right[..., :1, :])
        for k in range(1, left.shape[-1]):
            total = self._each("add", total, self._each("mul", left[..., :, k : k + 1], right[..., k : k + 1, :]))
        return total

    def _reduced(self, operation: str, values: Tensor, dims: Sequence[int] | None = None, keep: bool = False) -> Tensor:
        dims = list(range(values.ndim)) if dims is None else [dim % values.ndim for dim in dims]
        others = [dim for dim in range(values.ndim) if dim not in dims]
        moved = values.permute(*others, *dims).reshape(*(values.shape[dim] for dim in others), -1)
        total = moved[..., 0]
        for k in range(1, moved.shape[-1]):
            total = self._each(operation, total, moved[..., k])
        return total.reshape([1 if dim in dims else values.shape[dim] for dim in range(values.ndim)]) if keep else total

    def _inverse(self, lower: Tensor) -> Tensor:
        """Of lower triangular matrices, by forward substitution."""
        size = lower.shape[-1]
        above = lower[..., *torch.triu_indices(size, size, 1)].flatten().tolist()
        if any(self._program.value(place) != 0.0 for place in above):
            raise ValueError("only lower triangular matrices are inverted here")
        identity = self._constants(torch.eye(size).double()).expand(lower.shape)
        rows: list[Tensor] = []
        for i in range(size):
            row = identity[..., i : i + 1, :]
            for k, known in enumerate(rows):
                row = self._each("sub", row, self._each("mul", lower[..., i : i + 1, k : k + 1], known))
            rows.append(self._each("div", row, lower[..., i : i + 1, i : i + 1]))
        return torch.cat(rows, dim=-2)
