"""A filter's predict and update as one C++17 header, which needs neither torch nor a heap."""

import ctypes
import keyword
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch._inductor.codecache import CppCodeCache

from sigmaslam_filters.bayes import BayesFilter
from sigmaslam_filters.compiler.event_kinds import Kind
from sigmaslam_filters.compiler.scalar_step import HELPERS, TYPES, ScalarStep
from sigmaslam_filters.gaussian_belief import Gaussian
from sigmaslam_filters.models import AnyMeasurement, AnyMotion
from sigmaslam_filters.robust import Robust

Run = Callable[[Mapping[str, Tensor]], dict[str, Tensor]]
# Names of the header, and the words of C++ and names of <cmath> that are no words of Python.
_TAKEN = """mean covariance root update predict result healthy Number Update sign modulo std int double float char short
long bool auto const this new switch case default static struct union register signed unsigned operator delete volatile
extern goto template typename virtual friend inline mutable namespace private protected public explicit enum do typedef
using void throw catch sizeof NAN INFINITY HUGE_VAL M_PI M_E"""


def write_header(
    path: Path,
    bayes: BayesFilter,
    belief: Gaussian,
    motion: tuple[AnyMotion, Mapping[str, Tensor]] | None,
    measurement: tuple[AnyMeasurement, Tensor, Mapping[str, Tensor]] | None,
    gate: float | None,
    robust: Robust | None,
) -> Run:
    """Writes the header of a step of one element; gives what runs it, for elements one by one.

    Args:
        path: its stem names the namespace.
        bayes, gate, robust: as `compile_filter`.
        belief: an example without a batch.
        motion: and its inputs by names.
        measurement: its value and its inputs by names.
    Raises:
        ScalarStepError: the step is no arithmetic on numbers.
        ValueError: a name is none in C++.
    """
    by_root = bayes.goes_on_with_roots(belief)
    number, held_name = TYPES[belief.mean.dtype], "root" if by_root else "covariance"
    held = belief.factor if by_root else belief.covariance
    space = _name(path.stem)
    parts = []
    if motion is not None:
        kind = Kind(bayes, motion[0], None, None, None, (), len(motion[1]), by_root)
        scalar = ScalarStep(kind.step(), [belief.mean, held, *motion[1].values()])
        comment = "// The belief after a motion, in place. False: it failed, and the belief is as it was."
        parts += [comment, f"inline bool predict({_arguments(held_name, motion[1])}) {{", "bool healthy;"]
        parts += [*_pointers(scalar, held_name, list(motion[1]), ["&healthy"]), *scalar.body()]
        parts += ["return healthy;", "}"]
    if measurement is not None:
        given = {"value": measurement[1], **measurement[2]}
        kind = Kind(bayes, None, measurement[0], gate, robust, (), 0, by_root)
        scalar = ScalarStep(kind.step(), [belief.mean, held, *given.values()])
        size = measurement[1].numel()
        parts += ["struct Update {", "bool healthy;", f"Number innovation[{size}];", "Number nis;", "int64_t count;",
                  "Number log_likelihood;", "};",
                  "// The belief after a measurement, in place; NaN is a component that is missing.",
                  f"inline Update update({_arguments(held_name, given)}) {{", "Update result;"]  # fmt: skip
        results = [
            "&result.healthy",
            "result.innovation",
            *(f"&result.{name}" for name in ("nis", "count", "log_likelihood")),
        ]
        parts += [*_pointers(scalar, held_name, list(given), results), *scalar.body(), "return result;", "}"]
    head = [
        f"// {path.name}: a filter's step, written by sigmaslam_filters.export_step. C++17, no heap, nothing to link.",
        f"// mean: Number[{belief.mean.shape[-1]}]; {held_name}: Number[{held.numel()}], row by row.",
        *(f"// {name}: Number{[*each.shape]}." for name, each in (motion[1] if motion else {}).items()),
        *(f"// {name}: Number{[*each.shape]}." for name, each in (given if measurement else {}).items()),
        "#pragma once",
        "#if defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__",
        '#error "NaN is a missing value: compile without -ffast-math, or with -fno-finite-math-only after it"',
        "#endif", "#include <cmath>", "#include <cstdint>", f"namespace {space} {{", f"using Number = {number};",
    ]  # fmt: skip
    text = "\n".join([*head, HELPERS.replace("static inline", "inline"), *parts, f"}}  // namespace {space}", ""])
    path.write_text(text)
    return _runner(text, space, held_name, None if motion is None else list(motion[1]),
                   None if measurement is None else ["value", *measurement[2]], number)  # fmt: skip


def _name(given: str) -> str:
    """A name in C++."""
    generated = re.fullmatch(r"[vio]\d+", given)
    if generated or not re.fullmatch(r"[A-Za-z]\w*", given) or given in _TAKEN.split() or keyword.iskeyword(given):
        raise ValueError(f"{given!r} cannot name anything in C++: give it another name")
    return given


def _arguments(held: str, inputs: Mapping[str, Tensor]) -> str:
    return ", ".join(["Number* mean", f"Number* {held}", *(f"const Number* {_name(name)}" for name in inputs)])


def _pointers(scalar: ScalarStep, held: str, inputs: Sequence[str], results: Sequence[str]) -> list[str]:
    """What a step's statements call its arguments and results."""
    lines = [f"const Number* const i{k} = {name};" for k, name in enumerate(["mean", held, *inputs])]
    for k, (name, (_, dtype)) in enumerate(zip(["mean", held, *results], scalar.outputs, strict=True)):
        lines.append(f"{TYPES[dtype]}* const o{k} = {name};")
    return lines


def _runner(
    text: str, space: str, held: str, motion: Sequence[str] | None, measurement: Sequence[str] | None, number: str
) -> Run:
    """The header, compiled."""
    source = [text, f"typedef {number} N;"]
    if motion is not None:
        given = "".join(f", in[{k}]" for k in range(len(motion)))
        source.append(
            f'extern "C" bool predict(N* m, N* h, const N* const* in) {{ return {space}::predict(m, h{given}); }}'
        )
    if measurement is not None:
        given = "".join(f", in[{k}]" for k in range(len(measurement)))
        source.append(f'extern "C" bool update(N* m, N* h, const N* const* in, N* out, int64_t* count) {{ '
                      f"const {space}::Update found = {space}::update(m, h{given}); *count = found.count; "
                      "out[0] = found.log_likelihood; out[1] = found.nis; return found.healthy; }")  # fmt: skip
    library = CppCodeCache.load("\n".join(source))

    def pointers(tensors: Sequence[Tensor]) -> Any:
        return (ctypes.c_void_p * max(1, len(tensors)))(*(each.data_ptr() for each in tensors))

    def run(arguments: Mapping[str, Tensor]) -> dict[str, Tensor]:
        rows = []
        for k in range(len(arguments["mean"])):
            one = {name: each[k].clone().contiguous() for name, each in arguments.items()}
            healthy, count, more = True, ctypes.c_int64(0), torch.zeros(2, dtype=one["mean"].dtype)
            belief = [ctypes.c_void_p(one[name].data_ptr()) for name in ("mean", held)]
            if motion is not None:
                library.predict.restype = ctypes.c_bool
                healthy &= library.predict(*belief, pointers([one[name] for name in motion]))
            if measurement is not None:
                library.update.restype = ctypes.c_bool
                into = ctypes.c_void_p(more.data_ptr()), ctypes.byref(count)
                healthy &= library.update(*belief, pointers([one[name] for name in measurement]), *into)
            rows.append((one["mean"], one[held], torch.tensor(healthy), more[0], more[1], torch.tensor(count.value)))
        names = "posterior_mean", f"posterior_{held}", "healthy", "log_likelihood", "nis", "count"
        return dict(zip(names, map(torch.stack, zip(*rows, strict=True)), strict=True))

    return run
