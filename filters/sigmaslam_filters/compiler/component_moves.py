"""Moves of a traced graph that compute nothing: what they do to tensors that are known entry by entry.

Each takes the length of the batch, the node, what its first argument has become, and the node's other arguments; it
gives None where the entries do not tell, and the operation on the whole tensor has to stay.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import fx

aten = torch.ops.aten


@dataclass(frozen=True, slots=True)
class Entries:
    """A tensor by its entries.

    Attributes:
        parts: of the tensor's shape, but of length 1 along the batch; nodes (B,) or (), or numbers that are known.
        axis: the batch's dimension, None if there is none.
        dtype: of the tensor.
        source: the tensor itself, if it is there.
    """

    parts: np.ndarray
    axis: int | None
    dtype: torch.dtype
    source: fx.Node | None = None


@dataclass(frozen=True, slots=True)
class InRow:
    """Tensors end to end along the batch: half of what `torch.stack` is made of, the other half is a reshape.

    Attributes:
        pieces: of one shape.
    """

    pieces: list[Entries]

    def stacked(self) -> Entries:
        """With a dimension for the pieces, before that of the batch."""
        first = self.pieces[0]
        assert first.axis is not None
        parts = np.stack([piece.parts for piece in self.pieces], axis=first.axis)
        return Entries(parts, first.axis + 1, first.dtype)


def shape_of(node: fx.Node) -> tuple[int, ...] | None:
    """Shape of what an operation gives; None if that is no tensor."""
    value = node.meta.get("val")
    return tuple(value.shape) if isinstance(value, torch.Tensor) else None


def permute(batch: int, node: fx.Node, given: Entries, order: Sequence[int]) -> Entries:
    """aten.permute."""
    order = [dim % given.parts.ndim for dim in order]
    axis = None if given.axis is None else order.index(given.axis)
    return Entries(given.parts.transpose(order), axis, given.dtype)


def select(batch: int, node: fx.Node, given: Entries, dim: int, index: int) -> Entries | None:
    """aten.select."""
    dim %= given.parts.ndim
    if dim == given.axis:
        return None
    axis = given.axis - 1 if given.axis is not None and dim < given.axis else given.axis
    return Entries(np.moveaxis(given.parts, dim, 0)[index], axis, given.dtype) if given.parts.ndim > 1 else None


def slice_(
    batch: int, node: fx.Node, given: Entries, dim: int = 0, start: Any = None, end: Any = None, step: int = 1
) -> Entries | None:
    """aten.slice."""
    dim %= given.parts.ndim
    if dim == given.axis:
        return given if shape_of(node) == _shape_if_node(node.args[0]) else None
    wanted = [slice(None)] * given.parts.ndim
    wanted[dim] = slice(start, end, step)
    return Entries(given.parts[tuple(wanted)], given.axis, given.dtype)


def unsqueeze(batch: int, node: fx.Node, given: Entries, dim: int) -> Entries:
    """aten.unsqueeze."""
    dim %= given.parts.ndim + 1
    axis = given.axis + 1 if given.axis is not None and dim <= given.axis else given.axis
    return Entries(np.expand_dims(given.parts, dim), axis, given.dtype)


def reshape(batch: int, node: fx.Node, given: Entries, size: Any) -> Entries | None:
    """aten.reshape and squeeze, where the batch stays between the same entries."""
    shape = shape_of(node)
    assert shape is not None
    if given.axis is None or batch not in shape:
        return None
    axis = shape.index(batch)
    if np.prod(shape[:axis], dtype=int) != np.prod(given.parts.shape[: given.axis], dtype=int):
        return None
    shape = (*shape[:axis], 1, *shape[axis + 1 :])
    return Entries(given.parts.reshape(shape), axis, given.dtype)


def expand(batch: int, node: fx.Node, given: Entries, size: Any) -> Entries | None:
    """aten.expand."""
    shape = shape_of(node)
    assert shape is not None
    if batch not in shape:
        return None
    axis = shape.index(batch)
    return Entries(np.broadcast_to(given.parts, (*shape[:axis], 1, *shape[axis + 1 :])), axis, given.dtype)


def pad(batch: int, node: fx.Node, given: Entries, widths: Sequence[int], value: float = 0.0) -> Entries | None:
    """aten.constant_pad_nd, of entries before and behind those of the last dimensions, the last first."""
    pairs = [(0, 0)] * given.parts.ndim
    for k in range(len(widths) // 2):
        pairs[-1 - k] = widths[2 * k], widths[2 * k + 1]
    if min(widths) < 0 or (given.axis is not None and pairs[given.axis] != (0, 0)):
        return None
    shape = [length + sum(pair) for length, pair in zip(given.parts.shape, pairs, strict=True)]
    parts = np.full(shape, value, dtype=object)
    parts[tuple(slice(first, first + length) for (first, _), length in zip(pairs, given.parts.shape, strict=True))] = (
        given.parts
    )
    return Entries(parts, given.axis, given.dtype)


def diagonal(
    batch: int, node: fx.Node, given: Entries, offset: int = 0, dim1: int = 0, dim2: int = 1
) -> Entries | None:
    """aten.diagonal."""
    dims = dim1 % given.parts.ndim, dim2 % given.parts.ndim
    if given.axis in dims:
        return None
    axis = None if given.axis is None else given.axis - sum(dim < given.axis for dim in dims)
    return Entries(np.diagonal(given.parts, offset, *dims), axis, given.dtype)


def split(batch: int, node: fx.Node, given: Entries, sizes: Any, dim: int = 0) -> list[Entries] | None:
    """aten.split."""
    dim %= given.parts.ndim
    if dim == given.axis:
        return None
    length = given.parts.shape[dim]
    sizes = [sizes] * (length // sizes) if isinstance(sizes, int) else sizes
    pieces = np.split(given.parts, np.cumsum(sizes)[:-1], axis=dim)
    return [Entries(piece, given.axis, given.dtype) for piece in pieces]


def unbind(batch: int, node: fx.Node, given: Entries, dim: int = 0) -> list[Entries] | None:
    """aten.unbind."""
    dim %= given.parts.ndim
    if dim == given.axis:
        return None
    axis = given.axis - 1 if given.axis is not None and dim < given.axis else given.axis
    return [Entries(each, axis, given.dtype) for each in np.moveaxis(given.parts, dim, 0)]


def same(batch: int, node: fx.Node, given: Entries, *others: Any) -> Entries:
    """What does nothing to the entries."""
    return given


def _shape_if_node(node: Any) -> tuple[int, ...] | None:
    return shape_of(node) if isinstance(node, fx.Node) else None


RESHAPES = {aten.reshape.default, aten.view.default}
MOVES: dict[Any, Callable[..., Any]] = {
    aten.permute.default: permute,
    aten.select.int: select,
    aten.slice.Tensor: slice_,
    aten.unsqueeze.default: unsqueeze,
    aten.reshape.default: reshape,
    aten.view.default: reshape,
    aten.squeeze.dim: reshape,
    aten.squeeze.dims: reshape,
    aten.expand.default: expand,
    aten.constant_pad_nd.default: pad,
    aten.diagonal.default: diagonal,
    aten.split.Tensor: split,
    aten.split_with_sizes.default: split,
    aten.unbind.int: unbind,
    aten.alias.default: same,
}
