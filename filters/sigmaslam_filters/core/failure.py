"""What happens when an element of a batch cannot be filtered: one policy, one flag, one message (R8, R14)."""

from collections.abc import Callable, Mapping
from typing import Literal

import torch
from torch import Tensor

from sigmaslam_filters.core.factors import cholesky

# raise: FilterError. hold: the element keeps the belief it came with. jitter: a covariance that is not positive
# semidefinite is given the smallest relative jitter that makes it so, and held when none does. hold and jitter flag the
# element as not healthy; under torch.compile and on a GPU they cost no synchronisation, raise does.
OnFailure = Literal["raise", "hold", "jitter"]
POLICIES: tuple[OnFailure, ...] = ("raise", "hold", "jitter")

Suspects = Mapping[str, Callable[[], Tensor]]

# What compiled code says, which can name neither stage nor element.
FAILED = "a filter failed for an element of the batch: run the step uncompiled to see which"

_JITTERS = tuple(10.0 ** (half / 2) for half in range(-24, -5))
_SHOWN = 5


class FilterError(Exception):
    """A filter cannot go on: the message names step, elements and the matrix."""


def raise_unless_healthy(healthy: Tensor, stage: str, suspects: Suspects) -> None:
    """Raises for the first elements that are not healthy.

    Args:
        healthy: (...,) bool.
        stage: what was being done.
        suspects: makers of symmetric matrices (..., n, n), by name, the first to be suspected first.
    Raises:
        FilterError: an element is not healthy. In compiled code, where nothing can be named, RuntimeError.
    """
    if torch.compiler.is_compiling():
        torch._assert_async(healthy.all(), FAILED)
        return
    if bool(healthy.all()):
        return
    first = tuple((~healthy).nonzero()[0].tolist())
    where = name_elements(healthy) if healthy.ndim else "the filter"
    raise FilterError(
        f"{stage} failed for {where}: {_diagnosis(first, healthy.shape, suspects)} "
        "Check units and scales of prior and noise; on_failure='hold' or 'jitter' goes on without these elements."
    )


def name_elements(healthy: Tensor) -> str:
    """The first elements of a batch (...,) that are not healthy, and how many there are."""
    bad = (~healthy).nonzero().tolist()
    shown = ", ".join(str(tuple(index)) for index in bad[:_SHOWN]) + (", ..." if len(bad) > _SHOWN else "")
    return f"batch elements {shown} ({len(bad)} of {healthy.numel()})"


def jittered(covariance: Tensor, factor: Tensor, healthy: Tensor) -> tuple[Tensor, Tensor]:
    """Factors (..., n, n) in which those that are not healthy are made with the smallest jitter that helps.

    Returns also whether one did, or none was needed, (...,) bool.

    Args:
        covariance: (..., n, n).
        factor: (..., n, n) its lower factor where healthy (...,) bool.
    """
    largest = torch.diagonal(covariance, dim1=-2, dim2=-1).abs().amax(dim=-1, keepdim=True)
    scale = torch.diag_embed(largest.expand(covariance.shape[:-1]))
    usable = healthy
    for jitter in _JITTERS:
        tried, mended = cholesky(covariance + jitter * scale)
        chosen = ~usable if mended is None else mended & ~usable
        factor = torch.where(chosen[..., None, None], tried, factor)
        usable = usable | chosen
    return factor, usable


def _diagnosis(index: tuple[int, ...], batch: torch.Size, suspects: Suspects) -> str:
    smallest = {}
    for name, make in suspects.items():
        matrix = make()
        element = matrix.detach().expand(*batch, *matrix.shape[-2:])[index]
        if not bool(torch.isfinite(element).all()):
            return f"the {name} of the first has entries that are not finite."
        smallest[name] = float(torch.linalg.eigvalsh(element)[0])
        if smallest[name] < 0:
            return f"the {name} of the first has the smallest eigenvalue {smallest[name]:.3g}."
    # Only where nothing is worse: a covariance may be singular.
    for name, value in smallest.items():
        if value == 0:
            return f"the {name} of the first has the smallest eigenvalue 0."
    return "the result is not finite, unlike prior and noise: look at inputs and at what the model's function returns."
