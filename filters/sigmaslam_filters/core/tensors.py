"""What counts as an array here: tensors in float32 or float64; how they are given and shown."""

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import torch
from torch import Tensor

# Inputs of a model's function, in its order: one tensor, several, or several by names.
Inputs = Tensor | Sequence[Tensor] | Mapping[str, Tensor]

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


def require_dtype(name: str, given: Tensor, expected: torch.dtype) -> None:
    """Refuses a dtype other than the belief's: nothing is converted silently.

    Raises:
        ValueError: they differ.
    """
    if given.dtype != expected:
        raise ValueError(f"{name} is {given.dtype}, the belief {expected}: convert one of them with .to({expected})")


def as_inputs(given: Inputs) -> tuple[Tensor, ...]:
    """Inputs in order, however they are given."""
    if isinstance(given, tuple):
        return given
    if isinstance(given, Tensor):
        return (given,)
    # Asking for a dict is quick, for a Mapping it is not.
    return tuple(given.values() if isinstance(given, dict) or isinstance(given, Mapping) else given)  # noqa: SIM101


def require_symmetric(name: str, matrix: Tensor) -> None:
    """Refuses a covariance (..., n, n) of which the lower triangle is not the upper one, beyond round-off.

    Raises:
        ValueError: it is not symmetric.
    """
    given = matrix.detach()
    if torch.equal(given, given.mT):
        return
    size = torch.diagonal(given, dim1=-2, dim2=-1).abs().sqrt()
    # What products of matrices lose to round-off is relative to their factors, which are not known here.
    eps = torch.finfo(given.dtype).eps
    allowed = eps**0.5 * size.unsqueeze(-1) * size.unsqueeze(-2) + 8.0 * eps * given.abs().amax()
    wrong = ((given - given.mT).abs() > allowed).nonzero()
    if len(wrong):
        *batch, i, j = wrong[0].tolist()
        there, opposite = float(given[(*batch, i, j)]), float(given[(*batch, j, i)])
        where = f" of batch element {tuple(batch)}" if batch else ""
        raise ValueError(
            f"{name} is not symmetric: entry ({i}, {j}){where} is {there:.6g}, entry ({j}, {i}) is {opposite:.6g}"
        )


def shapes_of(given: Any) -> str:
    """One line for a dataclass, whatever the batch: tensors by their shapes."""
    shown = []
    for field in fields(given):
        if field.repr and (value := getattr(given, field.name)) is not None:
            shown.append(f"{field.name}={tuple(value.shape) if isinstance(value, Tensor) else value}")
    return f"{type(given).__name__}({', '.join(shown)})"
