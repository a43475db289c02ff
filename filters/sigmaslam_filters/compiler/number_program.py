"""A function of small tensors as a program of numbers, one statement an operation: what C++ is written from.

The function is traced, and the trace is run on places in a program instead of numbers: what only moves numbers is done
by torch itself, on places. Zeros and ones that are known take no part, and what is computed twice is computed once.
"""

import operator
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, fx
from torch._decomp import core_aten_decompositions
from torch.fx.experimental.proxy_tensor import make_fx

aten = torch.ops.aten

KINDS = {torch.float64: "Number", torch.float32: "Number", torch.bool: "bool", torch.int64: "int64_t"}
"""Types of C++ of a program's numbers."""
INFIX = {
    "add": "+", "sub": "-", "mul": "*", "div": "/", "lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "==",
    "ne": "!=", "bitwise_and": "&", "bitwise_or": "|", "bitwise_xor": "^",
}  # fmt: skip
# Operations that only move numbers are done by torch itself, on the numbers' places in the program.
_MOVES = "expand slice select unsqueeze squeeze squeeze_ permute split_with_sizes diagonal clone cat index_select \
alias copy_ unbind stack flip gather index repeat t transpose as_strided copy slice_scatter select_scatter"
_LOGIC = {"logical_not": "bitwise_not", "logical_and": "bitwise_and", "logical_or": "bitwise_or",
          "logical_xor": "bitwise_xor"}  # fmt: skip
_REDUCED = {"sum": "add", "mean": "add", "amax": "maximum", "amin": "minimum", "any": "bitwise_or",
            "all": "bitwise_and"}  # fmt: skip


class Program:
    """Numbers by their place: each an operation on earlier ones, a constant or an input."""

    def __init__(self, most: float = float("inf")) -> None:
        """Takes the largest number of operations."""
        self._known: dict[tuple[Any, ...], int] = {}
        self._most = most
        self.entries: list[tuple[Any, ...]] = []
        self.kinds: list[str] = []

    def add(self, operation: str, *arguments: Any, kind: str = "Number") -> int:
        """The place of a number, which may be there already."""
        key = (operation, *(map(repr, arguments) if operation == "constant" else arguments))
        if key not in self._known:
            if len(self.entries) >= self._most:
                raise ValueError("the step has too many operations")
            self._known[key] = len(self.entries)
            self.entries.append((operation, *arguments))
            self.kinds.append(kind)
        return self._known[key]

    def constant(self, value: float | bool) -> int:
        """Of a known number."""
        is_flag = isinstance(value, bool)
        return self.add("constant", value if is_flag else float(value), kind="bool" if is_flag else "Number")

    def value(self, place: int) -> Any:
        """A number that is known, or None."""
        operation, *arguments = self.entries[place]
        return arguments[0] if operation == "constant" else None

    def compute(self, operation: str, *places: int, kind: str = "Number") -> int:
        """An operation, without what known zeros and ones make needless."""
        values = [self.value(each) for each in places]
        if operation == "where" and values[0] is not None:
            return places[1] if values[0] else places[2]
        if operation == "where" and places[1] == places[2]:
            return places[1]
        if all(value is not None for value in values) and operation != "where":
            known = [torch.tensor(value, dtype=None if type(value) is bool else torch.float64) for value in values]
            return self.constant(getattr(torch, operation)(*known).item())
        if 0.0 in values[: {"mul": 2, "div": 1}.get(operation, 0)]:
            return self.constant(0.0)
        neutral = {"mul": 1.0, "div": 1.0, "add": 0.0, "sub": 0.0}.get(operation)
        if neutral is not None and values[1] == neutral:
            return places[0]
        if operation in ("mul", "add") and values[0] == neutral:
            return places[1]
        return self.add(operation, *places, kind=kind)

    def needed(self, outputs: Sequence[int]) -> list[int]:
        """Places that outputs are made of, in order."""
        needed, pending = set(), list(outputs)
        while pending:
            place = pending.pop()
            if place not in needed:
                needed.add(place)
                if self.entries[place][0] not in ("input", "constant"):
                    pending += self.entries[place][1:]
        return sorted(needed)


def write_program(
    program: Program, function: Callable[..., Sequence[Tensor]], arguments: Sequence[Tensor], inputs: Sequence[Tensor]
) -> list[tuple[Tensor, torch.dtype]]:
    """Writes a function into a program; returns its results' places and dtypes.

    Args:
        program: to which it is added.
        function: tensors -> tensors; no branches on values, indices are constants.
        arguments: examples.
        inputs: places of the arguments' numbers, of their shapes.
    Raises:
        ValueError: an operation has no form here.
        RuntimeError: the function cannot be traced.
    """
    with torch.no_grad():
        table = dict(core_aten_decompositions().items())
        # With real tensors torch records a stack trace for each operation, which is most of the time.
        module = make_fx(function, table, tracing_mode="fake", _allow_non_fake_inputs=True)(*arguments)
    returned: Any = list(module.graph.nodes)[-1].args[0]
    nodes = list(returned) if isinstance(returned, tuple | list) else [returned]
    results = _Interpreter(module, program).run(*inputs, enable_io_processing=False)
    results = list(results) if isinstance(results, tuple | list) else [results]
    return [(each, node.meta["val"].dtype) for each, node in zip(results, nodes, strict=True)]


class _Interpreter(fx.Interpreter):
    """Runs a traced function on places in a program instead of numbers."""

    def __init__(self, module: fx.GraphModule, program: Program) -> None:
        super().__init__(module)
        self._program = program
        self._kind = "Number"

    def run_node(self, n: fx.Node) -> Any:
        """One node, of which the kind of its numbers is known."""
        value = n.meta.get("val")
        if isinstance(value, Tensor) and n.op == "call_function":
            if value.dtype not in KINDS and value.dtype.is_floating_point:
                raise ValueError(f"numbers are {value.dtype}")
            self._kind = KINDS.get(value.dtype, "int64_t")
        return super().run_node(n)

    def get_attr(self, target: Any, args: Any, kwargs: Any) -> Tensor:
        """A constant tensor."""
        return self._constants(super().get_attr(target, args, kwargs))

    def call_function(self, target: Any, args: Any, kwargs: Any) -> Any:
        """One operation."""
        if target is operator.getitem:
            return args[0][args[1]]
        name = target._opname
        if name == "view":
            return args[0].reshape(args[1])
        if name in _MOVES.split():
            if name in ("index_select", "gather"):
                args = (*args[:2], self._numbers(args[2], target))
            elif name == "index":
                args = (args[0], [None if each is None else self._numbers(each, target) for each in args[1]])
            kwargs = {} if name == "clone" else kwargs
            return target(*args, **kwargs)
        if name in ("full", "arange", "scalar_tensor", "zeros", "ones", "eye"):
            return self._constants(target(*args, **kwargs))
        if name in ("full_like", "fill", "fill_", "zero_"):
            known = args[1] if len(args) > 1 else 0.0
            known = self._program.constant(bool(known) if self._kind == "bool" else float(known))
            filled = torch.full_like(args[0], known)
            return args[0].copy_(filled) if name.endswith("_") else filled
        if name in ("lift_fresh_copy", "detach", "lift_fresh"):
            return args[0]
        if name == "constant_pad_nd":
            return aten.constant_pad_nd.default(args[0], args[1], self._program.constant(0.0))
        if name == "_to_copy":
            return self._converted(args[0]) if "dtype" in kwargs else args[0].clone()
        if name in ("mm", "bmm"):
            return self._product(*args)
        if name in _REDUCED:
            return self._reduced(name, *args)
        if name == "linalg_vector_norm" and args[1:2] in ((), (2,)):
            total = self._reduced("sum", self._each("mul", args[0], args[0]), *args[2:])
            return self._each("sqrt", total)
        if name == "linalg_inv_ex":
            return self._inverse(args[0]), None
        result = self._arithmetic(name, args, kwargs) if torch.Tag.pointwise in target.tags else None
        if result is None:
            raise ValueError(f"there is no form of {target} in C++")
        return result

    def _arithmetic(self, name: str, args: Any, kwargs: Any) -> Tensor | None:
        """An operation on each number; None: there is no form of it."""
        if name == "pow" and args[1] == 2:
            return self._each("mul", args[0], args[0])
        if name == "neg":
            return self._each("sub", 0.0, args[0])
        if name == "reciprocal":
            return self._each("div", 1.0, args[0])
        if name in ("clamp", "clamp_min", "clamp_max"):
            low, high = (None, args[1]) if name == "clamp_max" else (*args[1:], None, None)[:2]
            result = args[0] if low is None else self._each("maximum", args[0], low)
            return result if high is None else self._each("minimum", result, high)
        if name in ("add", "sub") and "alpha" in kwargs:
            return self._each(name, args[0], self._each("mul", kwargs["alpha"], args[1]))
        if name == "addcmul":
            product = self._each("mul", self._each("mul", kwargs.get("value", 1.0), args[1]), args[2])
            return self._each("add", args[0], product)
        if name in _LOGIC:
            return self._each(_LOGIC[name], *(self._flags(each) for each in args))
        if name == "mul" and self._kind == "bool":
            name = "bitwise_and"
        whole = name.startswith("bitwise") and self._kind != "bool"
        return None if whole or kwargs else self._each(name, *args)

    def _constants(self, values: Tensor) -> Tensor:
        known = [self._program.constant(each.item()) for each in values.flatten()]
        return torch.tensor(known, dtype=torch.int64).reshape(values.shape)

    def _numbers(self, places: Tensor, target: Any) -> Tensor:
        known = [self._program.value(int(each)) for each in places.flatten()]
        if any(each is None for each in known):
            raise ValueError(f"there is no form of {target} in C++ with places that are computed")
        as_flags = any(type(each) is bool for each in known)
        return torch.tensor([bool(each) if as_flags else int(each) for each in known]).reshape(places.shape)

    def _flags(self, places: Tensor) -> Tensor:
        """Numbers as booleans."""
        found = [
            place if self._program.kinds[place] == "bool"
            else self._program.compute("ne", place, self._program.constant(0.0), kind="bool")
            for place in places.flatten().tolist()
        ]  # fmt: skip
        return torch.tensor(found, dtype=torch.int64).reshape(places.shape)

    def _converted(self, places: Tensor) -> Tensor:
        """Booleans as numbers and numbers as booleans; numbers as they are."""
        if self._kind == "bool":
            return self._flags(places)
        results = []
        for place in places.flatten().tolist():
            value = self._program.value(place)
            if isinstance(value, bool):
                place = self._program.constant(float(value))
            elif self._program.kinds[place] == "bool":
                one, zero = self._program.constant(1.0), self._program.constant(0.0)
                place = self._program.compute("where", place, one, zero, kind=self._kind)
            results.append(place)
        return torch.tensor(results, dtype=torch.int64).reshape(places.shape)

    def _each(self, operation: str, *operands: Any) -> Tensor:
        tensors = [
            each if isinstance(each, Tensor) else torch.tensor(self._program.constant(each)) for each in operands
        ]
        shaped = torch.broadcast_tensors(*tensors)
        rows = zip(*(each.flatten().tolist() for each in shaped), strict=True)
        places = [self._program.compute(operation, *row, kind=self._kind) for row in rows]
        return torch.tensor(places, dtype=torch.int64).reshape(shaped[0].shape)

    def _product(self, left: Tensor, right: Tensor) -> Tensor:
        total = self._each("mul", left[..., :, :1], right[..., :1, :])
        for k in range(1, left.shape[-1]):
            total = self._each("add", total, self._each("mul", left[..., :, k : k + 1], right[..., k : k + 1, :]))
        return total

    def _reduced(self, name: str, values: Tensor, dims: Any = None, keep: bool = False) -> Tensor:
        dims = [dims] if isinstance(dims, int) else dims
        dims = [dim % values.ndim for dim in dims] if dims else list(range(values.ndim))
        others = [dim for dim in range(values.ndim) if dim not in dims]
        moved = values.permute(*others, *dims).reshape(*(values.shape[dim] for dim in others), -1)
        moved = self._converted(moved)
        total = moved[..., 0]
        for k in range(1, moved.shape[-1]):
            total = self._each(_REDUCED[name], total, moved[..., k])
        if name == "mean":
            total = self._each("div", total, float(moved.shape[-1]))
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
