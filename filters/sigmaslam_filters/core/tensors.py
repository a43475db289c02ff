"""What counts as an array here: tensors in float32 or float64."""

from __future__ import annotations

import torch
from torch import Tensor

DTYPES = (torch.float32, torch.float64)


def require_tensor(name: str, given: object) -> None:
    """Refuses what is no tensor.

    Raises:
        TypeError: an array of numpy, a list or a number was given.
    """
    if not isinstance(given, Tensor):
        kind = type(given)
        shown = kind.__name__ if kind.__module__ == "builtins" else f"{kind.__module__}.{kind.__name__}"
        raise TypeError(f"{name} must be a torch tensor, got {shown}: convert it once with torch.as_tensor")


def require_floating(name: str, given: Tensor) -> None:
    """Refuses integers and half precision, for which there is no factorisation.

    Raises:
        ValueError: the dtype is neither float32 nor float64.
    """
    if given.dtype not in DTYPES:
        raise ValueError(f"{name} is {given.dtype}: convert it with .to(torch.float32) or .to(torch.float64)")


def require_dtype(name: str, given: Tensor, expected: torch.dtype) -> None:
    """Refuses a dtype other than the belief's: nothing is converted silently.

    Raises:
        ValueError: they differ.
    """
    if given.dtype != expected:
        raise ValueError(f"{name} is {given.dtype}, the belief {expected}: convert one of them with .to({expected})")
