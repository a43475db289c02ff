"""A step over small states, written out as C++ of scalars: one statement an operation, and its derivative.

A call of a compiled step takes tens of microseconds before anything is computed, which for a few small filters is
nearly all of it. Here the step is traced as `compile_step` traces it, rewritten in components (see
`sigmaslam_filters.compiler.components`), and written out number by number. `scalar_sequence` runs such steps over time,
`header_export` hands one out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from types import FunctionType
from typing import Any

import torch
from torch import Tensor, fx
from torch._dynamo.backends.common import aot_autograd
from torch._dynamo.exc import TorchDynamoException
from torch._inductor.decomposition import select_decomp_table

from sigmaslam_filters.compiler.component_moves import Entries, shape_of
from sigmaslam_filters.compiler.components import TooLongError, entries_of

aten, prims = torch.ops.aten, torch.ops.prims

# Elements that the step is traced with, unlike any size of a model, and enough for factorisations to be arithmetic.
TRACED = 137
# What a compiler of C++ reads in half a minute.
MOST_OPERATIONS = 40_000
TYPES = {torch.float32: "float", torch.float64: "double", torch.bool: "bool", torch.int64: "int64_t"}


class ScalarStepError(Exception):
    """The step is not made of arithmetic on numbers alone, or of too much of it."""


class ScalarStep:
    """A step of one element, of whose arguments and results each number has a place."""

    def __init__(self, step: Callable[..., Sequence[Tensor]], arguments: Sequence[Tensor]) -> None:
        """Traces.

        Args:
            step: tensors of one batch dimension -> tensors, without side effects.
            arguments: those of one element, without a batch.
        Raises:
            ScalarStepError: the step cannot be written this way.
        """
        batches = [each.expand(TRACED, *each.shape).clone() for each in arguments]
        with torch.no_grad():
            self._module, given = _trace(step, batches)
        self._arguments = list(arguments)
        places = {each.data_ptr(): k for k, each in enumerate(batches)}
        graph = self._module.graph
        self._constants: dict[fx.Node, Any] = {}
        self._places: dict[fx.Node, int] = {}
        placeholders = [node for node in graph.nodes if node.op == "placeholder"]
        for node, value in zip(placeholders, given, strict=True):
            place = places.get(value.data_ptr()) if isinstance(value, Tensor) else None
            if place is None:
                self._constants[node] = value
            else:
                self._places[node] = place
        try:
            results = entries_of(graph, TRACED, MOST_OPERATIONS)
        except TooLongError as error:
            raise ScalarStepError("the step has too many operations") from error
        self._results = [_checked(each) for each in results]
        self.outputs = [
            ([length for axis, length in enumerate(each.parts.shape) if axis != each.axis], each.dtype)
            for each in self._results
        ]
        self._names: dict[fx.Node, str] = {}
        # In the order in which they were made; what depends on the step's arguments.
        nodes, varying = list(graph.nodes), set()
        for node in nodes:
            if node in self._places or any(each in varying for each in node.all_input_nodes):
                varying.add(node)
        self._varying = varying
        needed = self._needed()
        self._ordered = [node for node in nodes if node in needed and node in varying]
        for node in self._ordered:
            self._names[node] = f"v{len(self._names)}"
        self._lines = [f"const {_type(node)} {self._names[node]} = {self._expression(node)};" for node in self._ordered]

    def body(self) -> list[str]:
        """Statements that compute the results o0, o1, ... of the arguments i0, i1, ..., all of them pointers."""
        write = [
            f"o{k}[{i}] = {self._operand(part, entries.dtype)};"
            for k, entries in enumerate(self._results)
            for i, part in enumerate(entries.parts.ravel())
        ]
        # Results may lie where arguments did: all is computed before anything is written.
        return [*self._lines, *write]

    def source(self) -> str:
        """`step(in, out)` of pointers to the arguments and to the results of one element."""
        return "\n".join([_HEAD, _signature("step", "const void* const* in, void* const* out"), *self._read(),
                          *self._write("out", "o"), *self.body(), "}", ""])  # fmt: skip

    def adjoint_source(self, wanted: Sequence[bool]) -> str:
        """`adjoint(in, out, grad)`: adds to each wanted argument's gradient what those of the results, `out`, make it.

        Raises:
            ScalarStepError: an operation has no derivative here.
        """
        active: set[fx.Node] = set()
        for node in self._ordered:
            place = self._entry(node)
            started = place is not None and wanted[place[0]]
            if node.meta["val"].dtype.is_floating_point and (
                started or (place is None and any(each in active for each in node.all_input_nodes))
            ):
                active.add(node)
        shares: dict[fx.Node, list[str]] = {node: [] for node in active}
        for k, entries in enumerate(self._results):
            for i, part in enumerate(entries.parts.ravel()):
                if part in active:
                    shares[part].append(f"o{k}[{i}]")
        lines = []
        for node in reversed(self._ordered):
            if node not in active or not shares[node]:
                continue
            name = "g" + self._names[node]
            lines.append(f"const {_type(node)} {name} = {' + '.join(shares[node])};")
            place = self._entry(node)
            if place is not None:
                lines.append(f"d{place[0]}[{place[1]}] += {name};")
                continue
            slopes = self._slopes(node)
            if any(each in active for each in node.all_input_nodes if each not in dict(slopes)):
                raise ScalarStepError(f"there is no derivative of {node.target} by all that it depends on")
            for argument, slope in slopes:
                if argument in active:
                    shares[argument].append(f"through({name}, {slope})" if slope != "1" else name)
        arguments = "const void* const* in, const void* const* out, void* const* grad"
        grads = [
            f"{TYPES[each.dtype]}* const d{k} = ({TYPES[each.dtype]}*)grad[{k}];"
            for k, each in enumerate(self._arguments)
            if wanted[k]
        ]
        return "\n".join([_HEAD, _signature("adjoint", arguments), *self._read(), *self._write("out", "o", "const "),
                          *grads, *self._lines, *lines, "}", ""])  # fmt: skip

    def _read(self) -> list[str]:
        kinds = [TYPES[each.dtype] for each in self._arguments]
        return [f"const {kind}* const i{k} = (const {kind}*)in[{k}];" for k, kind in enumerate(kinds)]

    def _write(self, pointers: str, name: str, const: str = "") -> list[str]:
        kinds = [TYPES[dtype] for _, dtype in self.outputs]
        return [f"{const}{kind}* const {name}{k} = ({const}{kind}*){pointers}[{k}];" for k, kind in enumerate(kinds)]

    def _needed(self) -> set[fx.Node]:
        pending = [part for entries in self._results for part in entries.parts.ravel() if isinstance(part, fx.Node)]
        needed: set[fx.Node] = set()
        while pending:
            node = pending.pop()
            if node not in needed:
                needed.add(node)
                if node in self._varying and self._entry(node) is None:
                    pending += node.all_input_nodes
        return needed

    def _entry(self, node: fx.Node) -> tuple[int, int] | None:
        """Argument and place in it, of a number that is an entry of an argument."""
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
        argument = self._places.get(node)
        if argument is None or len(index) != self._arguments[argument].ndim:
            return None
        flat = 0
        for length, each in zip(self._arguments[argument].shape, index, strict=True):
            flat = flat * length + each
        return argument, flat

    def _expression(self, node: fx.Node) -> str:
        place = self._entry(node)
        if place is not None:
            return f"i{place[0]}[{place[1]}]"
        if shape_of(node) != (TRACED,):
            raise ScalarStepError(f"{node.target} is not done number by number")
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
            return f"({TYPES[dtype]})({self._operand(node.args[0], tensors[0])})"
        if name == "mul" and dtype == torch.bool:
            name = "bitwise_and"
        if name.startswith("bitwise") and common != torch.bool:
            raise ScalarStepError(f"there is no form of {node.target} in C++")
        # Comparisons are made in the dtype of what is compared.
        given = [self._operand(each, dtype if dtype.is_floating_point else common) for each in node.args]
        named = {key: self._operand(value, dtype) for key, value in node.kwargs.items()}
        form = _FORMS.get((name, *sorted(named)))
        if form is None or form.count("{}") not in (0, len(given)):
            raise ScalarStepError(f"there is no form of {node.target} in C++")
        return form.format(*given, **named)

    def _slopes(self, node: fx.Node) -> list[tuple[Any, str]]:
        """Numbers that an operation depends on, and its derivative by each, in C++."""
        name, dtype = _name(node.target), node.meta["val"].dtype
        x, *others = node.args if name != "where" else (*node.args[1:], node.args[0])
        given = [self._operand(each, torch.bool if name == "where" and k == 2 else dtype)
                 for k, each in enumerate((x, *others))]  # fmt: skip
        if name in ("convert_element_type", "_to_copy"):
            return [(x, "1")]
        if name in _CONSTANT:
            return [(x, "0.0")]
        scale = {key: self._operand(value, dtype) for key, value in node.kwargs.items()}
        forms = _SLOPES.get((name, *sorted(scale)))
        if forms is None or len(forms) > len(given):
            raise ScalarStepError(f"there is no derivative of {node.target}")
        value = self._names[node]
        return [(each, form.format(*given, v=value, **scale)) for each, form in zip((x, *others), forms, strict=False)]

    def _operand(self, part: Any, dtype: torch.dtype) -> str:
        """A number, a constant of the models or what was computed, in a dtype."""
        if isinstance(part, fx.Node):
            if part in self._varying:
                return f"({TYPES[dtype]}){self._names[part]}"
            value = self._constant(part)
            first = value.flatten()[0]  # the same for all elements
            if value.numel() > 1 and not torch.equal(value, first.expand(value.shape)):
                raise ScalarStepError("a constant of the models has a batch")
            part = first.item()
        if not isinstance(part, int | float) or (isinstance(part, float) and not dtype.is_floating_point):
            raise ScalarStepError(f"an operand is a {type(part).__name__}")
        if math.isnan(part):
            return f"({TYPES[dtype]})NAN"
        if math.isinf(part):
            return f"({TYPES[dtype]}){'-' if part < 0 else ''}INFINITY"
        return f"({TYPES[dtype]}){float(part)!r}" if isinstance(part, float) else f"({TYPES[dtype]}){int(part)}"

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
        raise ScalarStepError(f"the step is not traced in a batch of {TRACED}: {error}") from error
    (module,) = modules
    shapes = [tuple(shape_of(node) or ()) for node in module.graph.nodes]
    if any(shape.count(TRACED) > 1 for shape in shapes):
        raise ScalarStepError("elements of the batch meet each other")
    # Of two results that share their memory the graph returns one.
    if len(results) != len(list(module.graph.nodes)[-1].args[0]):
        raise ScalarStepError("results of the step share their memory")
    return module, given


def _checked(result: Any) -> Entries:
    if not isinstance(result, Entries) or result.dtype not in TYPES:
        raise ScalarStepError("an output of the step has no batch")
    if result.axis != 0:
        raise ScalarStepError("an output's first dimension is not the batch")
    return result


def _signature(name: str, arguments: str) -> str:
    return f'extern "C" void {name}({arguments}) {{'


def _name(target: Any) -> str:
    """Of an operation, without the kinds of its arguments."""
    return getattr(target, "_opname", getattr(target, "__name__", str(target)))


def _type(node: fx.Node) -> str:
    dtype = node.meta["val"].dtype
    if dtype not in TYPES:
        raise ScalarStepError(f"numbers are {dtype}")
    return TYPES[dtype]


HELPERS = """template <typename T> static inline T at_most(T a, T b) { return (a != a || a < b) ? a : b; }
template <typename T> static inline T at_least(T a, T b) { return (a != a || a > b) ? a : b; }
template <typename T> static inline T sign(T a) { return (T)((T(0) < a) - (a < T(0))); }
template <typename T> static inline T modulo(T a, T b) { return a - b * std::floor(a / b); }
"""
# A gradient that is zero stays so where the derivative is not finite: of what is missing, or not chosen.
_HEAD = f"""#include <cmath>
#include <cstdint>
{HELPERS}template <typename T, typename D> static inline T through(T g, D d) {{ return g == 0 ? T(0) : (T)(g * d); }}
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

_CONSTANT = {"floor", "ceil", "trunc", "round", "sign"}
# Derivatives by the first, second, ... argument; v is the result.
_SLOPES: dict[tuple[str, ...], tuple[str, ...]] = {
    ("add",): ("1", "1"),
    ("add", "alpha"): ("1", "{alpha}"),
    ("sub",): ("1", "-1.0"),
    ("sub", "alpha"): ("1", "-{alpha}"),
    ("mul",): ("{1}", "{0}"),
    ("div",): ("1.0 / {1}", "-{v} / {1}"),
    ("addcmul",): ("1", "{2}", "{1}"),
    ("addcmul", "value"): ("1", "{value} * {2}", "{value} * {1}"),
    ("neg",): ("-1.0",),
    ("abs",): ("sign({0})",),
    ("reciprocal",): ("-{v} * {v}",),
    ("sqrt",): ("0.5 / {v}",),
    ("rsqrt",): ("-0.5 * {v} * {v} * {v}",),
    ("sin",): ("std::cos({0})",),
    ("cos",): ("-std::sin({0})",),
    ("tan",): ("1.0 + {v} * {v}",),
    ("asin",): ("1.0 / std::sqrt(1.0 - {0} * {0})",),
    ("acos",): ("-1.0 / std::sqrt(1.0 - {0} * {0})",),
    ("atan",): ("1.0 / (1.0 + {0} * {0})",),
    ("sinh",): ("std::cosh({0})",),
    ("cosh",): ("std::sinh({0})",),
    ("tanh",): ("1.0 - {v} * {v}",),
    ("exp",): ("{v}",),
    ("expm1",): ("{v} + 1.0",),
    ("log",): ("1.0 / {0}",),
    ("log1p",): ("1.0 / (1.0 + {0})",),
    ("erf",): ("1.1283791670955126 * std::exp(-{0} * {0})",),
    ("clamp_min",): ("{0} >= {1} ? 1.0 : 0.0",),
    ("clamp_max",): ("{0} <= {1} ? 1.0 : 0.0",),
    ("clamp",): ("{0} >= {1} && {0} <= {2} ? 1.0 : 0.0",),
    ("maximum",): ("{0} > {1} ? 1.0 : {0} == {1} ? 0.5 : 0.0", "{1} > {0} ? 1.0 : {0} == {1} ? 0.5 : 0.0"),
    ("minimum",): ("{0} < {1} ? 1.0 : {0} == {1} ? 0.5 : 0.0", "{1} < {0} ? 1.0 : {0} == {1} ? 0.5 : 0.0"),
    ("hypot",): ("{0} / {v}", "{1} / {v}"),
    ("atan2",): ("{1} / ({0} * {0} + {1} * {1})", "-{0} / ({0} * {0} + {1} * {1})"),
    ("pow",): ("{1} * std::pow({0}, {1} - 1.0)",),
    ("remainder",): ("1",),
    ("fmod",): ("1",),
    ("copysign",): ("std::signbit({0}) == std::signbit({1}) ? 1.0 : -1.0", "0.0"),
    ("where",): ("{2} ? 1.0 : 0.0", "{2} ? 0.0 : 1.0"),
    ("alias",): ("1",),
    ("clone",): ("1",),
}
