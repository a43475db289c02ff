"""Derivatives of a user's function along directions, without what makes torch's forward mode slow in small steps.

Where an operand has no derivative, torch (2.13) makes one of symbolic zeros and infers its shape in Python: 200 to 500
microseconds for `state + constant` or `2.0 * state`, as much as a hundred other operations. Operands are given zeros
that are numbers instead, and Python's numbers go to the operators that take a scalar.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.overrides import TorchFunctionMode

from sigmaslam_filters.core.factors import is_mapped

_aten = torch.ops.aten
# `forward_ad.make_dual` and `unpack_dual` of the only level, without their checks, which take longer than they do.
_torch = torch._C._VariableFunctions
# By the name under which torch calls a function of a tensor and a number.
_WITH_NUMBER: dict[str, Callable[..., Tensor]] = {
    name: operator
    for operator, names in (
        (_aten.add.Scalar, ("add", "__add__", "__radd__")),
        (_aten.sub.Scalar, ("sub", "subtract", "__sub__")),
        (_aten.rsub.Scalar, ("rsub", "__rsub__")),
        (_aten.mul.Scalar, ("mul", "multiply", "__mul__", "__rmul__")),
        (_aten.div.Scalar, ("div", "divide", "true_divide", "__truediv__")),
    )
    for name in names
}
_RECIPROCAL = "__rtruediv__"
_OF_TENSORS = {*_WITH_NUMBER, _RECIPROCAL, "addcmul", "addcdiv", "hypot", "atan2", "arctan2"}


def push_along(
    function: Callable[..., Tensor], points: Sequence[Tensor], directions: Sequence[Tensor]
) -> tuple[Tensor, Tensor]:
    """Values of a function of tensors, and its derivative along directions of the points' shapes.

    Both can be differentiated again, where gradients are enabled.
    """
    # Outside `torch.func` torch has one level of forward derivatives.
    if is_mapped() or torch.compiler.is_compiling() or forward_ad._current_level >= 0:
        pushed = torch.func.jvp(function, tuple(points), tuple(directions))
        return pushed[0], pushed[1]
    graded = torch.is_grad_enabled() and not torch.is_inference_mode_enabled()
    # Within inference mode torch drops derivatives.
    with torch.inference_mode(False), torch.set_grad_enabled(graded), forward_ad.dual_level():
        pairs = zip(points, directions, strict=True)
        duals = [forward_ad.make_dual(_ordinary(point), _ordinary(direction)) for point, direction in pairs]
        with _ZerosAsNumbers():
            result = function(*duals)
        value, slope = forward_ad.unpack_dual(result)
    return value, torch.zeros_like(value) if slope is None else slope


class _ZerosAsNumbers(TorchFunctionMode):
    """While this is entered, no operator that mixes operands with and without derivatives is left to symbolic zeros."""

    def __torch_function__(
        self, func: Callable[..., Any], types: Iterable[type], args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        """The function, of operands with derivatives."""
        name = getattr(func, "__name__", "")
        if name not in _OF_TENSORS:
            return func(*args, **(kwargs or {}))
        if not kwargs and len(args) == 2 and isinstance(args[0], Tensor) and type(args[1]) in (float, int):
            if name == _RECIPROCAL:
                return _aten.mul.Scalar(args[0].reciprocal(), args[1])
            if name in _WITH_NUMBER and args[0].is_floating_point():
                return _WITH_NUMBER[name](*args)
        if sum(isinstance(each, Tensor) for each in args) > 1:
            has_one = [_has_derivative(each) for each in args]
            # Where none has one there is nothing to differentiate.
            if any(has_one):
                pairs = zip(args, has_one, strict=True)
                args = tuple(each if has else _with_zeros(each) for each, has in pairs)
        return func(*args, **(kwargs or {}))


def _has_derivative(operand: Any) -> bool:
    return isinstance(operand, Tensor) and _torch._unpack_dual(operand, 0)[1] is not None


def _with_zeros(operand: Any) -> Any:
    """An operand that does not depend on the points gets a derivative of zeros."""
    if not isinstance(operand, Tensor) or not operand.is_floating_point():
        return operand
    return _torch._make_dual(_ordinary(operand), torch.zeros_like(operand), 0)


def _ordinary(tensor: Tensor) -> Tensor:
    """A tensor that may have derivatives: not made in inference mode, nor with elements that share memory."""
    if tensor.is_inference() or 0 in tensor.stride():
        return tensor.clone()
    return tensor
