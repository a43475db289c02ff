"""A torch function of small tensors, written as C++ for one item at a time: a loop over items calls it.

What does not depend on the item itself but only on what many items have in common goes into a function of its own,
called once for all of them. The item's function is a template: a number may be a vector, one item a lane.
"""

from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from sigmaslam_filters.compiler.number_program import INFIX, Program, write_program

_CONSTANT, _COMMON, _ITEM = range(3)


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
    program, inputs = Program(), []
    for level, group in ((_COMMON, common), (_ITEM, item)):
        place = 0
        for value in group.values():
            ids = [program.add("input", place + k, level) for k in range(value.numel())]
            inputs.append(torch.tensor(ids).reshape(value.shape))
            place += value.numel()
    results = write_program(program, function, [*common.values(), *item.values()], inputs)
    outputs = [int(each) for result, _ in results for each in result.flatten()]
    sizes = [sum(value.numel() for value in group.values()) for group in (common, item)]
    return _Source(program).text(name, sizes, outputs)


class _Source:
    """A program, of whose numbers it is known which differ from item to item."""

    def __init__(self, program: Program) -> None:
        self._program = program
        self._levels: list[int] = []
        for operation, *arguments in program.entries:
            if operation == "input":
                self._levels.append(arguments[1])
            else:
                of = [] if operation == "constant" else [self._levels[each] for each in arguments]
                self._levels.append(max(of, default=_CONSTANT))

    def text(self, name: str, sizes: Sequence[int], outputs: Sequence[int]) -> str:
        """Both functions."""
        ordered, entries = self._program.needed(outputs), self._program.entries
        shared = {each for each in outputs if self._levels[each] == _COMMON}
        for place in ordered:
            if self._levels[place] == _ITEM and entries[place][0] != "input":
                shared |= {each for each in entries[place][1:] if self._levels[each] == _COMMON}
        numbers = {place: k for k, place in enumerate(sorted(shared))}
        common = [self._line(each) for each in ordered if self._levels[each] == _COMMON]
        common += [f"out[{k}] = {self._operand(place)};" for place, k in numbers.items()]
        item = [self._line(each, numbers) for each in ordered if self._levels[each] == _ITEM]
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

    def _line(self, place: int, shared: Mapping[int, int] | None = None) -> str:
        operation, *arguments = self._program.entries[place]
        if operation == "input":
            return f"const auto v{place} = in[{arguments[0]}];"
        named = [self._operand(each, shared) for each in arguments]
        infix = INFIX.get(operation)
        text = f"{named[0]} {infix} {named[1]}" if infix is not None else f"{operation}({', '.join(named)})"
        if operation == "where" and all(self._levels[each] < _ITEM for each in arguments[1:]) and shared is not None:
            text = f"where<Number>({', '.join(named)})"
        return f"const auto v{place} = {text};"

    def _operand(self, place: int, shared: Mapping[int, int] | None = None) -> str:
        value = self._program.value(place)
        if value is not None:
            return repr(value) if not isinstance(value, bool) else str(value).lower()
        if shared is not None and place in shared:
            return f"shared[{shared[place]}]"
        return f"v{place}"
