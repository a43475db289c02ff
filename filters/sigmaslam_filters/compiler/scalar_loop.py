"""A step over small states as machine code that runs a whole sequence: time is its inner loop, numbers its variables.

A call of a compiled step takes tens of microseconds before anything is computed, which for a few small filters is
nearly all of it. Here the step is traced as `compile_step` traces it, rewritten in components (see
`sigmaslam_filters.compiler.components`), and written out as a C++ function of scalars, one statement an operation.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Sequence
from types import FunctionType
from typing import Any

import torch
from torch import Tensor, fx
from torch._dynamo.backends.common import aot_autograd
from torch._dynamo.exc import TorchDynamoException
from torch._inductor.codecache import CppCodeCache
from torch._inductor.decomposition import select_decomp_table

from sigmaslam_filters.compiler.component_moves import Entries, shape_of
from sigmaslam_filters.compiler.components import TooLongError, entries_of

aten, prims = torch.ops.aten, torch.ops.prims

# Elements that the step is traced with, unlike any size of a model, and enough for factorisations to be arithmetic.
TRACED = 137
# What a compiler of C++ reads in half a minute.
MOST_OPERATIONS = 40_000
_TYPES = {torch.float32: "float", torch.float64: "double", torch.bool: "bool", torch.int64: "int64_t"}


class ScalarLoopError(Exception):
    """The step is not made of arithmetic on numbers alone, or of too much of it."""


class ScalarLoop:
    """Runs a step over time, for any number of elements and of steps."""

    def __init__(
        self, step: Callable[..., Sequence[Tensor]], state: Sequence[Tensor], inputs: Sequence[Tensor]
    ) -> None:
        """Traces and compiles.

        Args:
            step: (*state, *inputs) of one batch dimension -> (*next state, *others), without side effects.
            state: of one element, without a batch.
            inputs: those of a step, of one element.
        Raises:
            ScalarLoopError: the step cannot be written this way.
        """
        self._state = len(state)
        self._inputs = list(inputs)
        arguments = [each.expand(TRACED, *each.shape).clone() for each in (*state, *inputs)]
        with torch.no_grad():
            module, given = _trace(step, arguments)
            source, self._outputs = _Writer(module, given, arguments, self._state).source()
        self._run = CppCodeCache.load(source).run

    def __call__(self, state: Sequence[Tensor], inputs: Sequence[Tensor]) -> list[Tensor]:
        """All that the step returned, (T, B, ...).

        Args:
            state: (B, ...) before the first step.
            inputs: (T, B, ...).
        """
        steps, batch = inputs[0].shape[:2]
        given = [each.contiguous() for each in (*state, *inputs)]
        outputs = [torch.empty(steps, batch, *shape, dtype=dtype) for shape, dtype in self._outputs]
        pointers = [(ctypes.c_void_p * len(some))(*(each.data_ptr() for each in some)) for some in (given, outputs)]
        self._run(*pointers, ctypes.c_int64(steps), ctypes.c_int64(batch))
        return outputs


def _trace(step: Callable[..., Any], arguments: Sequence[Tensor]) -> tuple[fx.GraphModule, list[Tensor]]:
    """The graph of a step in aten's operations, and its inputs: the arguments, and tensors of the models."""
    modules: list[fx.GraphModule] = []
    given: list[Tensor] = []

    def keep(module: fx.GraphModule, example: Sequence[Any]) -> Callable[[list[Any]], Any]:
        def run(values: list[Any]) -> Any:
            given.extend(values)
            # Nothing is computed: numbers do not matter here.
            returned = [node.meta["val"] for node in list(module.graph.nodes)[-1].args[0]]
            return [torch.zeros(each.shape, dtype=each.dtype) for each in returned]

        run._boxed_call = True  # type: ignore[attr-defined]
        modules.append(module)
        return run

    backend = aot_autograd(fw_compiler=keep, inference_compiler=keep, decompositions=select_decomp_table())
    # torch keeps what it traced by the function's code.
    assert isinstance(step, FunctionType)
    copy = FunctionType(step.__code__.replace(), step.__globals__, step.__name__, step.__defaults__, step.__closure__)
    try:
        results = torch.compile(copy, backend=backend, fullgraph=True, dynamic=False)(*arguments)
    except (TorchDynamoException, RuntimeError, ValueError) as error:
        raise ScalarLoopError(f"the step is not traced in a batch of {TRACED}: {error}") from error
    (module,) = modules
    shapes = [tuple(shape_of(node) or ()) for node in module.graph.nodes]
    if any(shape.count(TRACED) > 1 for shape in shapes):
        raise ScalarLoopError("elements of the batch meet each other")
    # Of two results that share their memory the graph returns one.
    if len(results) != len(list(module.graph.nodes)[-1].args[0]):
        raise ScalarLoopError("results of the step share their memory")
    return module, given


class _Writer:
    """Writes a graph as C++."""

    def __init__(
        self, module: fx.GraphModule, given: Sequence[Tensor], arguments: Sequence[Tensor], state: int
    ) -> None:
        self._module, self._state = module, state
        graph = module.graph
        places = {each.data_ptr(): k for k, each in enumerate(arguments)}
        placeholders = [node for node in graph.nodes if node.op == "placeholder"]
        self._constants: dict[fx.Node, Any] = {}
        self._places: dict[fx.Node, int] = {}
        for node, value in zip(placeholders, given, strict=True):
            place = places.get(value.data_ptr()) if isinstance(value, Tensor) else None
            if place is None:
                self._constants[node] = value
            else:
                self._places[node] = place
        self._arguments = arguments
        self._names: dict[fx.Node, str] = {}
        self._lines: list[str] = []
        try:
            self._results = entries_of(graph, TRACED, MOST_OPERATIONS)
        except TooLongError as error:
            raise ScalarLoopError("the step has too many operations") from error
        # In the order in which they were made; what depends on the step's arguments.
        self._nodes = list(graph.nodes)
        self._varying: set[fx.Node] = set()
        for node in self._nodes:
            if node in self._places or any(each in self._varying for each in node.all_input_nodes):
                self._varying.add(node)

    def source(self) -> tuple[str, list[tuple[list[int], torch.dtype]]]:
        """The function, and shape and dtype of each output of one element."""
        results = [self._entries(each) for each in self._results]
        needed = self._needed(results)
        for node in self._nodes:
            if node in needed and node in self._varying:
                self._names[node] = f"v{len(self._names)}"
                self._lines.append(f"const {_type(node)} {self._names[node]} = {self._expression(node)};")
        start, write, move = [], [], []
        for k, entries in enumerate(results[: self._state]):
            kind, count = _TYPES[entries.dtype], entries.parts.size
            if count != self._arguments[k][0].numel():
                raise ScalarLoopError("the state has another size after a step")
            start.append(f"{kind} s{k}[{count}];")
            start.append(f"std::copy_n((const {kind}*)in[{k}] + b * {count}, {count}, s{k});")
            names = [self._operand(part, entries.dtype) for part in entries.parts.ravel()]
            move.append(f"const {kind} n{k}[{count}] = {{{', '.join(names)}}};")
            move.append(f"std::copy_n(n{k}, {count}, s{k});")
        shapes = []
        for k, entries in enumerate(results):
            kind, count = _TYPES[entries.dtype], entries.parts.size
            write.append(f"{kind}* const o{k} = ({kind}*)out[{k}] + (t * batch + b) * {count};")
            names = [self._operand(part, entries.dtype) for part in entries.parts.ravel()]
            write += [f"o{k}[{i}] = {name};" for i, name in enumerate(names)]
            shape = [length for axis, length in enumerate(entries.parts.shape) if axis != entries.axis]
            shapes.append((shape, entries.dtype))
        read = []
        for place in range(self._state, len(self._arguments)):
            kind, count = _TYPES[self._arguments[place].dtype], self._arguments[place][0].numel()
            read.append(f"const {kind}* const i{place} = (const {kind}*)in[{place}] + (t * batch + b) * {count};")
        loop = ["for (int64_t t = 0; t < steps; ++t) {", *read, *self._lines, *write, *move, "}"]
        body = ["for (int64_t b = 0; b < batch; ++b) {", *start, *loop, "}"]
        head = 'extern "C" void run(void** in, void** out, int64_t steps, int64_t batch) {'
        return "\n".join([_HEAD, head, *body, "}", ""]), shapes

    def _entries(self, result: Any) -> Entries:
        if not isinstance(result, Entries) or result.dtype not in _TYPES:
            raise ScalarLoopError("an output of the step has no batch")
        if result.axis != 0:
            raise ScalarLoopError("an output's first dimension is not the batch")
        return result

    def _needed(self, results: Sequence[Entries]) -> set[fx.Node]:
        pending = [part for entries in results for part in entries.parts.ravel() if isinstance(part, fx.Node)]
        needed: set[fx.Node] = set()
        while pending:
            node = pending.pop()
            if node not in needed:
                needed.add(node)
                if node in self._varying and self._entry(node) is None:
                    pending += node.all_input_nodes
        return needed

    def _entry(self, node: fx.Node) -> str | None:
        """Where the number lies, of one that is an entry of an argument."""
        index: list[int] = []
        while node.op == "call_function" and node.target is aten.select.int:
            source, dim, place = node.args
            assert isinstance(source, fx.Node)
            assert isinstance(place, int)
            # Entries are taken out from the last dimension to the first, so what is left are the leading ones.
            if dim != len(shape_of(source) or ()) - 1:
                return None
            index.append(place)
            node = source
        place = self._places.get(node)
        if place is None or len(index) != self._arguments[place].ndim - 1:
            return None
        flat = 0
        for length, each in zip(self._arguments[place].shape[1:], index, strict=True):
            flat = flat * length + each
        return f"{'s' if place < self._state else 'i'}{place}[{flat}]"

    def _expression(self, node: fx.Node) -> str:
        found = self._entry(node)
        if found is not None:
            return found
        if shape_of(node) != (TRACED,):
            raise ScalarLoopError(f"{node.target} is not done number by number")
        name = _name(node.target)
        dtype = node.meta["val"].dtype
        tensors = [each.meta["val"].dtype for each in node.all_input_nodes]
        common = tensors[0]
        for each in tensors[1:]:
            common = torch.promote_types(common, each)
        if name == "where":
            condition, first, second = node.args
            chosen = [self._operand(each, dtype) for each in (first, second)]
            return f"{self._operand(condition, torch.bool)} ? {chosen[0]} : {chosen[1]}"
        if name in ("convert_element_type", "_to_copy"):
            return f"({_TYPES[dtype]})({self._operand(node.args[0], tensors[0])})"
        if name.startswith("bitwise") and common != torch.bool:
            raise ScalarLoopError(f"there is no form of {node.target} in C++")
        # Comparisons are made in the dtype of what is compared.
        given = [self._operand(each, dtype if dtype.is_floating_point else common) for each in node.args]
        named = {key: self._operand(value, dtype) for key, value in node.kwargs.items()}
        form = _FORMS.get((name, *sorted(named)))
        if form is None or form.count("{}") not in (0, len(given)):
            raise ScalarLoopError(f"there is no form of {node.target} in C++")
        return form.format(*given, **named)

    def _operand(self, part: Any, dtype: torch.dtype) -> str:
        """A number, a constant of the models or what was computed, in a dtype."""
        if isinstance(part, fx.Node):
            if part in self._varying:
                return f"({_TYPES[dtype]}){self._names[part]}"
            value = self._constant(part)
            first = value.flatten()[0]  # the same for all elements
            if value.numel() > 1 and not torch.equal(value, first.expand(value.shape)):
                raise ScalarLoopError("a constant of the models has a batch")
            part = first.item()
        if not isinstance(part, int | float) or (isinstance(part, float) and not dtype.is_floating_point):
            raise ScalarLoopError(f"an operand is a {type(part).__name__}")
        if math.isnan(part):
            return f"({_TYPES[dtype]})NAN"
        if math.isinf(part):
            return f"({_TYPES[dtype]}){'-' if part < 0 else ''}INFINITY"
        return f"({_TYPES[dtype]}){float(part)!r}" if isinstance(part, float) else f"({_TYPES[dtype]}){int(part)}"

    def _constant(self, node: fx.Node) -> Any:
        """What does not depend on the arguments, computed."""
        if node not in self._constants:
            if node.op == "get_attr":
                value = getattr(self._module, str(node.target))
            else:
                arguments, named = fx.map_arg((node.args, node.kwargs), self._constant)
                value = node.target(*arguments, **named)  # type: ignore[operator]
            self._constants[node] = value
        return self._constants[node]


def _name(target: Any) -> str:
    """Of an operation, without the kinds of its arguments."""
    return getattr(target, "_opname", getattr(target, "__name__", str(target)))


def _type(node: fx.Node) -> str:
    dtype = node.meta["val"].dtype
    if dtype not in _TYPES:
        raise ScalarLoopError(f"numbers are {dtype}")
    return _TYPES[dtype]


_HEAD = """#include <algorithm>
#include <cmath>
#include <cstdint>
template <typename T> static inline T at_most(T a, T b) { return (a != a || a < b) ? a : b; }
template <typename T> static inline T at_least(T a, T b) { return (a != a || a > b) ? a : b; }
template <typename T> static inline T sign(T a) { return (T)((T(0) < a) - (a < T(0))); }
template <typename T> static inline T modulo(T a, T b) { return a - b * std::floor(a / b); }
"""

_SAME = "sqrt sin cos tan asin acos atan sinh cosh tanh asinh acosh atanh exp exp2 expm1 log log2 log10 log1p"
_INFIX = {"add": "+", "sub": "-", "mul": "*", "div": "/", "eq": "==", "ne": "!=", "lt": "<", "le": "<=", "gt": ">"}
_LOGIC = {"ge": ">=", "bitwise_and": "&", "bitwise_or": "|", "bitwise_xor": "^", "logical_and": "&&"}
# By an operation's name and its named arguments.
_FORMS: dict[tuple[str, ...], str] = {
    **{(name,): f"std::{name}({{}})" for name in f"{_SAME} erf erfc floor ceil trunc".split()},
    **{(name,): f"{{}} {sign} {{}}" for name, sign in (_INFIX | _LOGIC).items()},
    ("logical_or",): "{} || {}",
    ("logical_xor",): "(bool){} != (bool){}",
    ("bitwise_not",): "!{}",
    ("logical_not",): "!{}",
    ("add", "alpha"): "{} + {alpha} * {}",
    ("sub", "alpha"): "{} - {alpha} * {}",
    ("addcmul",): "{} + {} * {}",
    ("addcmul", "value"): "{} + {value} * {} * {}",
    ("neg",): "-{}",
    ("abs",): "std::abs({})",
    ("reciprocal",): "1 / {}",
    ("rsqrt",): "1 / std::sqrt({})",
    ("round",): "std::nearbyint({})",
    ("sign",): "sign({})",
    ("signbit",): "std::signbit({})",
    ("copysign",): "std::copysign({}, {})",
    ("clamp_min",): "at_least({}, {})",
    ("clamp_max",): "at_most({}, {})",
    ("clamp",): "at_most(at_least({}, {}), {})",
    ("maximum",): "at_least({}, {})",
    ("minimum",): "at_most({}, {})",
    ("hypot",): "std::hypot({}, {})",
    ("atan2",): "std::atan2({}, {})",
    ("pow",): "std::pow({}, {})",
    ("remainder",): "modulo({}, {})",
    ("fmod",): "std::fmod({}, {})",
    ("isnan",): "std::isnan({})",
    ("isinf",): "std::isinf({})",
    ("alias",): "{}",
    ("clone",): "{}",
}
