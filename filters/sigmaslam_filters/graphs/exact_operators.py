"""What a traced function calls, in operators that ONNX has, and with constants that keep all digits in float64.

The exporter takes Python's numbers through float32, ONNX Runtime has no arc tangent of float64, and some of torch's
functions have no counterpart at all. All of it is mended while a graph is traced, whoever wrote the function.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

# A power of two by which numbers in float32 are scaled without loss.
_BITS = 100


class ExactOperators(TorchFunctionMode):
    """While this is entered, torch's functions are replaced by what `torch.onnx` exports without loss."""

    def __torch_function__(
        self, func: Callable[..., Any], types: Iterable[type], args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        """The function, or what stands in for it."""
        options: dict[str, Any] = dict(kwargs or {})
        name = getattr(func, "__name__", "")
        if name in _REPLACED and len(args) == _REPLACED[name].__code__.co_argcount and not options:
            return _REPLACED[name](*args)
        if name == "where" and len(args) == 3 and not options:
            condition, first, second = _as_tensors(*args)
            # ONNX Runtime chooses numbers only.
            if isinstance(first, Tensor) and first.dtype == second.dtype == torch.bool:
                return (condition & first) | (~condition & second)
            return func(condition, first, second)
        tensors = [each for each in [*args, *options.values()] if isinstance(each, Tensor)]
        if all(each.dtype != torch.float64 for each in tensors):
            return func(*args, **options)
        if name in ("add", "sub", "subtract") and "alpha" in options:
            return func(args[0], args[1] * _exact(options["alpha"], args[0]))
        if name == "addcmul" and "value" in options:
            return args[0] + _exact(options["value"], args[0]) * (args[1] * args[2])
        if name == "full_like" and _is_rounded(args[1]):
            return _exact(args[1], args[0])
        if name in _ELEMENTWISE:
            lifted = {key: _exact(value, tensors[0]) for key, value in options.items()}
            return func(*(_exact(each, tensors[0]) for each in args), **lifted)
        return func(*args, **options)


def _as_tensors(condition: Any, first: Any, second: Any) -> tuple[Any, Any, Any]:
    """Arguments of `torch.where`, which loses forward derivatives in a traced graph where one of them is a number."""
    if isinstance(first, Tensor) == isinstance(second, Tensor):
        return condition, first, second
    like = first if isinstance(first, Tensor) else second
    first, second = (
        each if isinstance(each, Tensor) else torch.zeros_like(like) + _exact(each, like) for each in (first, second)
    )
    return condition, first, second


def _is_rounded(value: Any) -> bool:
    """Whether this is a number of Python that float32 would change."""
    if not isinstance(value, float):
        return False
    with np.errstate(over="ignore"):
        return float(np.float32(value)) != value


def _exact(value: Any, like: Tensor) -> Any:
    """The number in float64, as a sum of pieces that float32 holds.

    A constant of its own would do but for forward derivatives, within which none can be made.
    """
    if not _is_rounded(value) or not math.isfinite(value):
        return value
    mantissa, exponent = math.frexp(value)
    total = torch.zeros_like(like, dtype=torch.float64)
    while mantissa:
        piece = float(np.float32(mantissa))
        total, mantissa = total + piece, mantissa - piece
    while exponent:
        step = max(-_BITS, min(_BITS, exponent))
        total, exponent = total * 2.0**step, exponent - step
    return total


def _hypot(x: Tensor, y: Tensor) -> Tensor:
    return torch.sqrt(x * x + y * y)


def _atan2(y: Tensor, x: Tensor) -> Tensor:
    """In float64 from the float32 function: one step turns its error e into about e^3 / 6."""
    if y.dtype != torch.float64:
        return torch.atan2(y, x)
    radius = _hypot(x, y)
    radius = torch.where(radius == 0, torch.ones_like(radius), radius)
    sine, cosine = y / radius, x / radius
    rough = torch.atan2(sine.to(torch.float32), cosine.to(torch.float32)).to(torch.float64)
    return rough + (sine * torch.cos(rough) - cosine * torch.sin(rough))


def _atan(x: Tensor) -> Tensor:
    return _atan2(x, torch.ones_like(x))


def _asin(x: Tensor) -> Tensor:
    return _atan2(x, torch.sqrt((1.0 - x) * (1.0 + x)))


def _acos(x: Tensor) -> Tensor:
    return _atan2(torch.sqrt((1.0 - x) * (1.0 + x)), x)


def _sinc(x: Tensor) -> Tensor:
    angle = x * _exact(math.pi, x)
    zero = angle == 0
    safe = torch.where(zero, torch.ones_like(angle), angle)
    return torch.where(zero, torch.ones_like(angle), torch.sin(safe) / safe)


_REPLACED: Mapping[str, Callable[..., Tensor]] = {
    "hypot": _hypot,
    "atan2": _atan2,
    "arctan2": _atan2,
    "atan": _atan,
    "arctan": _atan,
    "asin": _asin,
    "arcsin": _asin,
    "acos": _acos,
    "arccos": _acos,
    "tan": lambda x: torch.sin(x) / torch.cos(x),
    # Of a negative zero the sign is lost.
    "copysign": lambda size, sign: torch.where(sign < 0, -size.abs(), size.abs()),
    "signbit": lambda x: x < 0,
    "sinc": _sinc,
    "special_sinc": _sinc,
    "log2": lambda x: torch.log(x) * _exact(1.0 / math.log(2.0), x),
    "log10": lambda x: torch.log(x) * _exact(1.0 / math.log(10.0), x),
}

# By the name under which torch calls a function; a number among their arguments may be a tensor as well.
_NAMES = "add sub subtract rsub mul multiply div divide true_divide floor_divide remainder fmod pow"
_COMPARISONS = "eq ne lt le gt ge equal less less_equal greater greater_equal not_equal"
_BOUNDS = "clamp clamp_min clamp_max clip maximum minimum masked_fill"
_ELEMENTWISE = {
    *_NAMES.split(),
    *_COMPARISONS.split(),
    *_BOUNDS.split(),
    *(
        f"__{side}{name}__"
        for name in ["add", "sub", "mul", "div", "truediv", "floordiv", "mod", "pow"]
        for side in ("", "r")
    ),
    *(f"__{name}__" for name in ["eq", "ne", "lt", "le", "gt", "ge"]),
}
