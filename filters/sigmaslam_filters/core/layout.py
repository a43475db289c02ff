"""Vectors whose memory is batch-last: (..., n) in shape, but a slice `[..., i]` is contiguous.

Arithmetic on components of vectors in the usual memory order steps over n - 1 numbers for each one it uses; on these
it does not, which makes large batches several times faster.
"""

from collections.abc import Sequence

import torch
from torch import Tensor


def stack(components: Sequence[Tensor]) -> Tensor:
    """Components (...,), broadcast against each other, into vectors (..., n).

    A slice `[..., i]` of the result is contiguous along the last batch dimension.
    """
    first = components[0].shape
    if any(component.shape != first for component in components):
        components = torch.broadcast_tensors(*components)
    if components[0].ndim == 0:
        return torch.stack(list(components), dim=-1)
    return torch.stack(list(components), dim=-2).mT


def choose(chosen: Tensor, first: Tensor, second: Tensor, trailing: int) -> Tensor:
    """The first array (..., *trailing dimensions) where chosen (...,) bool is true, the second elsewhere."""
    # With the trailing dimensions in front, the result is batch-last in memory.
    last, front = tuple(range(-trailing, 0)), tuple(range(trailing))
    return torch.where(chosen, first.movedim(last, front), second.movedim(last, front)).movedim(front, last)


def concatenate(vectors: Sequence[Tensor]) -> Tensor:
    """Vectors (..., n_i) of the same leading dimensions end to end, (..., sum n_i), in the memory order of `stack`."""
    if vectors[0].ndim == 1:
        return torch.cat(list(vectors), dim=-1)
    return torch.cat([vector.mT for vector in vectors], dim=-2).mT
