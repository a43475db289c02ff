"""A step over small states, written out as C++ of scalars: one statement an operation, and its derivative.

A call of a compiled step takes tens of microseconds before anything is computed, which for a few small filters is
nearly all of it. Here the step of one element is traced (`number_program`) and written out number by number.
`scalar_sequence` runs such steps over time, `header_export` hands one out.
"""

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from sigmaslam_filters.compiler.number_program import INFIX, KINDS, Program, write_program
from sigmaslam_filters.core.plain_factors import traced_for_export

# What a compiler of C++ reads in half a minute.
MOST_OPERATIONS = 40_000
# How many times as many are traced as are needed: halves of what is symmetric, and what nobody asked for.
_NEEDLESS = 10
TYPES = {torch.float32: "float", torch.float64: "double", torch.bool: "bool", torch.int64: "int64_t"}


class ScalarStepError(Exception):
    """The step is not made of arithmetic on numbers alone, or of too much of it."""


class ScalarStep:
    """A step of one element, of whose arguments and results each number has a place."""

    def __init__(
        self, step: Callable[..., Sequence[Tensor]], arguments: Sequence[Tensor], most: int = MOST_OPERATIONS
    ) -> None:
        """Traces.

        Args:
            step: tensors -> tensors, without side effects.
            arguments: those of one element, without a batch.
            most: operations that there may be.
        Raises:
            ScalarStepError: the step cannot be written this way.
        """
        self._arguments = list(arguments)
        self._program = Program(_NEEDLESS * most)
        inputs = []
        for k, each in enumerate(arguments):
            places = [self._program.add("input", i, k, kind=KINDS[each.dtype]) for i in range(each.numel())]
            inputs.append(torch.tensor(places, dtype=torch.int64).reshape(each.shape))
        try:
            with traced_for_export():
                results = write_program(self._program, step, arguments, inputs)
        except (ValueError, RuntimeError) as error:
            raise ScalarStepError(f"the step of one element is no arithmetic: {error}") from error
        dtypes = {each.dtype for each in arguments} | {dtype for _, dtype in results}
        floating = {each for each in dtypes if each.is_floating_point}
        if not dtypes <= TYPES.keys() or len(floating) != 1:
            raise ScalarStepError(f"numbers are {', '.join(sorted(map(str, dtypes)))}")
        self._number = TYPES[floating.pop()]
        self._results = [places.flatten().tolist() for places, _ in results]
        self.outputs = [(list(places.shape), dtype) for places, dtype in results]
        needed = self._program.needed([each for places in self._results for each in places])
        self._ordered = [each for each in needed if self._program.value(each) is None]
        if len(self._ordered) > most:
            raise ScalarStepError("the step has too many operations")
        kinds = self._program.kinds
        self._lines = [f"const {kinds[each]} v{each} = {self._expression(each)};" for each in self._ordered]

    def body(self) -> list[str]:
        """Statements that compute the results o0, o1, ... of the arguments i0, i1, ..., all of them pointers."""
        write = [
            f"o{k}[{i}] = {self._operand(place)};"
            for k, places in enumerate(self._results)
            for i, place in enumerate(places)
        ]
        # Results may lie where arguments did: all is computed before anything is written.
        return [*self._lines, *write]

    def source(self) -> str:
        """`step(in, out)` of pointers to the arguments and to the results of one element."""
        return self._function("step", "const void* const* in, void* const* out", [*self._write(), *self.body()])

    def adjoint_source(self, wanted: Sequence[bool]) -> str:
        """`adjoint(in, out, grad)`: adds to each wanted argument's gradient what those of the results, `out`, make it.

        Raises:
            ScalarStepError: an operation has no derivative here.
        """
        entries, active = self._program.entries, set()
        for place in self._ordered:
            operation, *of = entries[place]
            started = wanted[of[1]] if operation == "input" else any(each in active for each in of)
            if started and self._program.kinds[place] == "Number":
                active.add(place)
        shares: dict[int, list[str]] = {place: [] for place in active}
        for k, places in enumerate(self._results):
            for i, place in enumerate(places):
                if place in active:
                    shares[place].append(f"o{k}[{i}]")
        lines = []
        for place in reversed(self._ordered):
            if not shares.get(place):
                continue
            lines.append(f"const Number g{place} = {' + '.join(shares[place])};")
            operation, *of = entries[place]
            if operation == "input":
                lines.append(f"d{of[1]}[{of[0]}] += g{place};")
                continue
            forms = _SLOPES.get(operation, ())
            if any(each in active and (k >= len(forms) or not forms[k]) for k, each in enumerate(of)):
                raise ScalarStepError(f"there is no derivative of aten.{operation} by all that it depends on")
            given = [self._operand(each) for each in of]
            for argument, form in zip(of, forms, strict=False):
                if argument in active:
                    slope = form.format(*given, v=f"v{place}")
                    shares[argument].append(f"through(g{place}, {slope})" if slope != "1" else f"g{place}")
        grads = [
            f"{TYPES[each.dtype]}* const d{k} = ({TYPES[each.dtype]}*)grad[{k}];"
            for k, each in enumerate(self._arguments)
            if wanted[k]
        ]
        arguments = "const void* const* in, const void* const* out, void* const* grad"
        return self._function("adjoint", arguments, [*self._write("const "), *grads, *self._lines, *lines])

    def _function(self, name: str, arguments: str, lines: Sequence[str]) -> str:
        kinds = [TYPES[each.dtype] for each in self._arguments]
        read = [f"const {kind}* const i{k} = (const {kind}*)in[{k}];" for k, kind in enumerate(kinds)]
        head = [_HEAD, f"typedef {self._number} Number;", f'extern "C" void {name}({arguments}) {{']
        return "\n".join([*head, *read, *lines, "}", ""])

    def _write(self, const: str = "") -> list[str]:
        kinds = [TYPES[dtype] for _, dtype in self.outputs]
        return [f"{const}{kind}* const o{k} = ({const}{kind}*)out[{k}];" for k, kind in enumerate(kinds)]

    def _expression(self, place: int) -> str:
        operation, *of = self._program.entries[place]
        if operation == "input":
            return f"i{of[1]}[{of[0]}]"
        form = _FORMS.get(operation)
        if form is None or form.count("{}") != len(of):
            raise ScalarStepError(f"there is no form of aten.{operation} in C++")
        # Whole numbers are not divided as such.
        cast = "(Number)" if self._program.kinds[place] == "Number" and operation != "where" else ""
        return form.format(*(cast + self._operand(each) for each in of))

    def _operand(self, place: int) -> str:
        """A number, as it was computed or as it is known."""
        value = self._program.value(place)
        if value is None:
            return f"v{place}"
        if isinstance(value, bool):
            return str(value).lower()
        if math.isnan(value):
            return "(Number)NAN"
        return f"(Number){value!r}" if math.isfinite(value) else f"(Number){'-' if value < 0 else ''}INFINITY"


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

_SAME = "sqrt sin cos tan asin acos atan sinh cosh tanh asinh acosh atanh exp exp2 expm1 log log2 log10 log1p erf erfc \
floor ceil trunc signbit isnan isinf abs"
_FORMS: dict[str, str] = {
    **{name: f"std::{name}({{}})" for name in _SAME.split()},
    **{name: f"std::{name}({{}}, {{}})" for name in ("copysign", "hypot", "atan2", "pow", "fmod")},
    **{name: f"{{}} {sign} {{}}" for name, sign in INFIX.items()},
    "where": "{} ? {} : {}",
    "bitwise_not": "!{}",
    "rsqrt": "1 / std::sqrt({})",
    "round": "std::nearbyint({})",
    "sign": "sign({})",
    "maximum": "at_least({}, {})",
    "minimum": "at_most({}, {})",
    "remainder": "modulo({}, {})",
    "sigmoid": "1 / (1 + std::exp(-{}))",
}

# Derivatives by the first, second, ... argument; v is the result. None by a condition, nor by what is left out.
_SLOPES: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("floor", "ceil", "trunc", "round", "sign"), ("0.0",)),
    "add": ("1", "1"),
    "sub": ("1", "-1.0"),
    "mul": ("{1}", "{0}"),
    "div": ("1.0 / {1}", "-{v} / {1}"),
    "abs": ("sign({0})",),
    "sqrt": ("0.5 / {v}",),
    "rsqrt": ("-0.5 * {v} * {v} * {v}",),
    "sin": ("std::cos({0})",),
    "cos": ("-std::sin({0})",),
    "tan": ("1.0 + {v} * {v}",),
    "asin": ("1.0 / std::sqrt(1.0 - {0} * {0})",),
    "acos": ("-1.0 / std::sqrt(1.0 - {0} * {0})",),
    "atan": ("1.0 / (1.0 + {0} * {0})",),
    "sinh": ("std::cosh({0})",),
    "cosh": ("std::sinh({0})",),
    "tanh": ("1.0 - {v} * {v}",),
    "exp": ("{v}",),
    "expm1": ("{v} + 1.0",),
    "log": ("1.0 / {0}",),
    "log1p": ("1.0 / (1.0 + {0})",),
    "erf": ("1.1283791670955126 * std::exp(-{0} * {0})",),
    "maximum": ("{0} > {1} ? 1.0 : {0} == {1} ? 0.5 : 0.0", "{1} > {0} ? 1.0 : {0} == {1} ? 0.5 : 0.0"),
    "minimum": ("{0} < {1} ? 1.0 : {0} == {1} ? 0.5 : 0.0", "{1} < {0} ? 1.0 : {0} == {1} ? 0.5 : 0.0"),
    "hypot": ("{0} / {v}", "{1} / {v}"),
    "atan2": ("{1} / ({0} * {0} + {1} * {1})", "-{0} / ({0} * {0} + {1} * {1})"),
    "pow": ("{1} * std::pow({0}, {1} - 1.0)",),
    "remainder": ("1",),
    "fmod": ("1",),
    "copysign": ("std::signbit({0}) == std::signbit({1}) ? 1.0 : -1.0", "0.0"),
    "where": ("", "{0} ? 1.0 : 0.0", "{0} ? 0.0 : 1.0"),
    "sigmoid": ("{v} * (1.0 - {v})",),
}
