"""A traced step, rewritten in components: each number of a filter is one array over the batch.

What a filter computes is written with small matrices (..., n, n), which a compiler assembles in memory and takes apart
again: some 25 passes over the batch where one would do. Here every operation of the traced graph is done entry by
entry, so that assembling, slicing and transposing are bookkeeping that is over when the graph is compiled, and all that
is left is arithmetic on arrays (B,), which fuses into one loop. Zeros and ones that are known take no part.

Nothing is asked of what was traced: the arithmetic is the same, operation by operation, whoever wrote it.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import fx
from torch._inductor.custom_graph_pass import CustomInferenceAwareGraphPass, get_hash_for_files
from torch._subclasses.fake_tensor import FakeTensorMode

from sigmaslam_filters.compiler import component_moves
from sigmaslam_filters.compiler.component_moves import MOVES, RESHAPES, Entries, InRow, reshape, shape_of

aten = torch.ops.aten

# Smaller batches do not fill the registers of a processor for long enough to matter.
SMALLEST_BATCH = 64
# A longer program takes minutes to compile. Three states that see three components take 900, four that see two 1,500.
MOST_OPERATIONS = 8000


class InComponents(CustomInferenceAwareGraphPass):
    """What `compile_step` gives the compiler."""

    def __call__(self, graph: fx.Graph, is_inference: bool) -> None:  # type: ignore[override]
        """Rewrites the graph in place if it is that of a batch of small filters; leaves it as it is otherwise.

        Where derivatives are asked for, it is left as well.
        """
        _fill_symbolic_zeros(graph)
        batch = _batch_size(graph) if is_inference else None
        if batch is None:
            return
        nodes = list(graph.nodes)
        rewriter = _Rewriter(graph, batch, MOST_OPERATIONS)
        with graph.inserting_before(nodes[-1]):
            try:
                nodes[-1].args = (rewriter.run(nodes),)
            except TooLongError:
                rewriter.kept.update(nodes)
        for node in reversed(graph.nodes):
            if node.op == "call_function" and not node.users and node not in rewriter.kept:
                graph.erase_node(node)

    def uuid(self) -> Any:
        """What the compiler's cache knows the rewriting by."""
        return get_hash_for_files((__file__, component_moves.__file__))


class TooLongError(Exception):
    """The program would take too long to compile."""


def _fill_symbolic_zeros(graph: fx.Graph) -> None:
    """Makes tensors of what forward derivatives know to be zero, which have no memory and crash in compiled code."""
    for node in graph.nodes:
        if node.target is aten._efficientzerotensor.default:
            node.target, node.args = aten.full.default, (node.args[0], 0.0)
            value = node.meta["val"]
            with value.fake_mode:
                node.meta["val"] = aten.full.default(*node.args, **node.kwargs)


def _batch_size(graph: fx.Graph) -> int | None:
    """The length of the longest dimension of what goes in, if it is a batch: of no tensor is it the length twice."""
    inputs = [shape_of(node) for node in graph.nodes if node.op == "placeholder"]
    size = max((length for shape in inputs if shape is not None for length in shape), default=0)
    if not isinstance(size, int) or size < SMALLEST_BATCH:
        return None
    for node in graph.nodes:
        shape = shape_of(node)
        if shape is not None and node.meta["val"].device.type != "cpu":
            return None
        if shape is not None and (any(type(length) is not int for length in shape) or shape.count(size) > 1):
            return None
        if node.op == "call_function" and _changes_arguments(node):
            return None
    return size


def _changes_arguments(node: fx.Node) -> bool:
    schema = getattr(node.target, "_schema", None)
    return schema is not None and schema.is_mutable


class _Rewriter:
    """Goes through a graph and writes it anew, entry by entry.

    Attributes:
        kept: operations of the graph that stay, though nothing may use them: a check raises.
    """

    def __init__(self, graph: fx.Graph, batch: int, most: int) -> None:
        self._graph = graph
        self._batch = batch
        self._most = most
        self.kept: set[fx.Node] = set()
        self._made: dict[fx.Node, Any] = {}
        self._known: dict[Any, fx.Node] = {}
        self._count = 0
        likes = [node.meta["val"] for node in graph.nodes if shape_of(node) is not None]
        self._device = likes[0].device
        self._fake: FakeTensorMode = likes[0].fake_mode

    def run(self, nodes: Sequence[fx.Node]) -> Any:
        """The arguments of the output node, which is the last, written anew."""
        for node in nodes[:-1]:
            self._made[node] = self._value(node)
        return fx.map_arg(nodes[-1].args[0], lambda each: self._whole(self._made[each]))

    def _value(self, node: fx.Node) -> Any:
        if node.op != "call_function":
            return self._entries(node)
        given = [self._made[each] for each in node.all_input_nodes]
        target: Any = node.target
        if target is operator.getitem:
            index: Any = node.args[1]
            return given[0][index] if isinstance(given[0], list) else self._kept(node)
        if target is aten.full.default:
            return self._filled(node)
        if target is aten.expand.default and isinstance(given[0], fx.Node) and self._batch in (shape_of(node) or ()):
            return MOVES[target](self._batch, node, self._split(given[0]), *node.args[1:])
        if target in RESHAPES and isinstance(given[0], InRow):
            result = reshape(self._batch, node, given[0].stacked(), None)
            return self._kept(node) if result is None else result
        if not any(isinstance(each, Entries) for each in given) or any(isinstance(each, InRow) for each in given):
            return self._kept(node)
        if torch.Tag.pointwise in getattr(target, "tags", ()) or target in _COPIES:
            return self._pointwise(node)
        if target in _REDUCTIONS:
            return self._reduced(node)
        moved = MOVES.get(target)
        if moved is not None and node.args and isinstance(self._given(node.args[0]), Entries):
            result = moved(self._batch, node, self._given(node.args[0]), *node.args[1:])
            if result is not None:
                return result
        joined = self._concatenated(node) if target is aten.cat.default else None
        return self._kept(node) if joined is None else joined

    def _given(self, argument: Any) -> Any:
        """What an argument has become; numbers are themselves."""
        return self._made[argument] if isinstance(argument, fx.Node) else argument

    # What is as it was

    def _kept(self, node: fx.Node) -> Any:
        """The operation on whole tensors."""
        arguments = fx.map_arg(node.args, lambda each: self._whole(self._made[each]))
        named = fx.map_arg(node.kwargs, lambda each: self._whole(self._made[each]))
        whole = node
        if arguments != node.args or named != node.kwargs:
            # The memory of a new argument may be in another order.
            target = aten.reshape.default if node.target is aten.view.default else node.target
            whole = self._call(target, *arguments, **named)
        if whole.is_impure():
            self.kept.add(whole)
        return self._entries(whole)

    def _entries(self, node: fx.Node) -> Any:
        """A whole tensor by its entries if it has a batch."""
        shape = shape_of(node)
        if shape is None or self._batch not in shape:
            return node
        return self._split(node)

    def _split(self, node: fx.Node) -> Entries:
        shape = shape_of(node)
        assert shape is not None
        axis = shape.index(self._batch) if self._batch in shape else None
        parts = np.empty([1 if k == axis else length for k, length in enumerate(shape)], dtype=object)
        if parts.size > self._most:
            raise TooLongError
        for index in np.ndindex(*parts.shape):
            part = node
            for k in reversed(range(len(shape))):
                if k != axis:
                    part = self._call(aten.select.int, part, k, index[k])
            parts[index] = part
        return Entries(parts, axis, node.meta["val"].dtype, node)

    def _filled(self, node: fx.Node) -> Any:
        shape, value = shape_of(node), node.args[1]
        assert shape is not None
        if self._batch not in shape or not isinstance(value, int | float):
            return self._kept(node)
        axis = shape.index(self._batch)
        parts = np.full([1 if k == axis else length for k, length in enumerate(shape)], value, dtype=object)
        return Entries(parts, axis, node.meta["val"].dtype)

    def _whole(self, value: Any) -> Any:
        """The tensor of some entries, with the batch last in memory."""
        if isinstance(value, list):
            return [self._whole(each) for each in value]
        if isinstance(value, InRow):
            return self._call(aten.cat.default, [self._whole(each) for each in value.pieces], value.pieces[0].axis)
        if not isinstance(value, Entries):
            return value
        if value.source is not None:
            return value.source
        parts = [self._node(part, value.dtype) for part in value.parts.ravel()]
        shape = list(value.parts.shape)
        if value.axis is None:
            pieces = [self._call(aten.reshape.default, part, [1]) for part in parts]
            joined = self._call(aten.cat.default, pieces) if len(pieces) > 1 else pieces[0]
            return self._call(aten.reshape.default, joined, shape)
        rows = []
        for part in parts:
            row = part if shape_of(part) else self._call(aten.expand.default, part, [self._batch])
            rows.append(self._call(aten.unsqueeze.default, row, 0))
        joined = self._call(aten.cat.default, rows) if len(rows) > 1 else rows[0]
        others = [length for k, length in enumerate(shape) if k != value.axis]
        joined = self._call(aten.reshape.default, joined, [*others, self._batch])
        order = [*range(len(others))]
        order.insert(value.axis, len(others))
        return self._call(aten.permute.default, joined, order)

    def _node(self, part: Any, dtype: torch.dtype) -> fx.Node:
        if isinstance(part, fx.Node):
            return part
        return self._call(aten.full.default, [], part, dtype=dtype, layout=torch.strided, device=self._device)

    def _call(self, target: Any, *arguments: Any, **named: Any) -> fx.Node:
        """One more operation, or the one that is there if it is the same."""
        key = (target, repr(arguments), repr(named))
        if key in self._known:
            return self._known[key]
        self._count += 1
        if self._count > self._most:
            raise TooLongError
        node = self._graph.call_function(target, arguments, named)
        values = fx.map_arg((arguments, named), lambda each: each.meta["val"])
        with self._fake:
            node.meta["val"] = target(*values[0], **values[1])
        self._known[key] = node
        return node

    # Arithmetic

    def _pointwise(self, node: fx.Node) -> Any:
        target: Any = node.target
        named = {key: value for key, value in node.kwargs.items() if key != "memory_format"}
        places = [k for k, each in enumerate(node.args) if isinstance(each, fx.Node)]
        if any(isinstance(each, fx.Node | list | tuple) for each in named.values()):
            return self._kept(node)
        given = [self._given(node.args[k]) for k in places]
        given = [each if isinstance(each, Entries) else self._split(each) for each in given]
        dtype = node.meta["val"].dtype
        grids = np.broadcast_arrays(*(each.parts for each in given))
        parts = np.empty(grids[0].shape, dtype=object)
        for index in np.ndindex(*parts.shape):
            arguments: list[Any] = list(node.args)
            for k, grid in zip(places, grids, strict=True):
                arguments[k] = grid[index]
            parts[index] = self._entry(target, arguments, named, dict(zip(places, given, strict=True)), dtype)
        axis = next(each.axis - each.parts.ndim + parts.ndim for each in given if each.axis is not None)
        return Entries(parts, axis, dtype)

    def _entry(
        self, target: Any, arguments: list[Any], named: dict[str, Any], given: dict[int, Entries], dtype: torch.dtype
    ) -> Any:
        """One entry of a pointwise operation; what is known takes no part."""
        if not named and all(each.dtype == dtype for each in given.values()) and dtype.is_floating_point:
            simple = _simplified(target, arguments)
            if simple is not None:
                return simple
        if target is aten.add.Tensor and len(arguments) == 2 and not named and _negated(arguments[1]) is not None:
            target, arguments[1] = aten.sub.Tensor, _negated(arguments[1])
        if target is aten.where.self and isinstance(arguments[1], fx.Node) and arguments[1] is arguments[2]:
            return arguments[1]
        if target is aten.isnan.default:
            # The compiler has no vector instruction for it, but for this.
            target, arguments, given = aten.ne.Tensor, [arguments[0]] * 2, {0: given[0], 1: given[0]}
        for k, each in given.items():
            arguments[k] = self._node(arguments[k], each.dtype)
        return self._call(target, *arguments, **named)

    def _combine(self, target: Any, first: Any, second: Any, dtype: torch.dtype) -> Any:
        """Two entries of one dtype."""
        simple = _simplified(target, [first, second]) if dtype.is_floating_point else None
        if simple is not None:
            return simple
        return self._call(target, self._node(first, dtype), self._node(second, dtype))

    def _reduced(self, node: fx.Node) -> Any:
        """Sums and their like over dimensions other than the batch's."""
        given = self._given(node.args[0])
        if not isinstance(given, Entries) or node.kwargs or len(node.args) < 2:
            return self._kept(node)
        wanted: Any = node.args[1]
        dims = [wanted] if isinstance(wanted, int) else list(wanted or [])
        dims = sorted({dim % given.parts.ndim for dim in dims})
        dtype = node.meta["val"].dtype
        if not dims or given.axis in dims:
            return self._kept(node)
        if dtype != given.dtype:  # a count
            given = self._converted(given, dtype)
        keep = len(node.args) > 2 and bool(node.args[2])
        parts, axis = given.parts, given.axis
        for dim in reversed(dims):
            rows = np.moveaxis(parts, dim, 0)
            total = rows[0:1]
            for row in rows[1:]:
                pairs = np.empty(total.shape, dtype=object)
                for index in np.ndindex(*pairs.shape):
                    pairs[index] = self._combine(_REDUCTIONS[node.target], total[index], row[index[1:]], dtype)
                total = pairs
            parts = np.moveaxis(total, 0, dim)
            if not keep:
                parts = np.squeeze(parts, dim)
                axis = axis - 1 if axis is not None and dim < axis else axis
        return Entries(parts, axis, dtype)

    def _converted(self, given: Entries, dtype: torch.dtype) -> Entries:
        parts = np.empty(given.parts.shape, dtype=object)
        for index in np.ndindex(*parts.shape):
            part = self._node(given.parts[index], given.dtype)
            parts[index] = self._call(torch.ops.prims.convert_element_type.default, part, dtype)
        return Entries(parts, given.axis, dtype)

    # Moves

    def _concatenated(self, node: fx.Node) -> Entries | InRow | None:
        pieces: Any = node.args[0]
        dim: Any = node.args[1] if len(node.args) > 1 else node.kwargs.get("dim", 0)
        given = [self._given(each) for each in pieces]
        given = [each if isinstance(each, Entries) else self._split(each) for each in given]
        axes = {each.axis for each in given}
        if len(axes) != 1:
            return None
        if dim % given[0].parts.ndim in axes:
            return InRow(given)
        return Entries(np.concatenate([each.parts for each in given], axis=dim), given[0].axis, given[0].dtype)


def _simplified(target: Any, arguments: Sequence[Any]) -> Any:
    """The entry itself where a known 0 or 1 makes it so, None where there is something to compute."""
    if len(arguments) != 2:
        return 0.0 if target is aten.neg.default and _is(arguments[0], 0) else None
    first, second = arguments
    if target is aten.mul.Tensor:
        if _is(first, 0) or _is(second, 0):
            return 0.0
        return second if _is(first, 1) else first if _is(second, 1) else None
    if target is aten.add.Tensor:
        return second if _is(first, 0) else first if _is(second, 0) else None
    if target is aten.sub.Tensor:
        return first if _is(second, 0) else None
    if target is aten.div.Tensor:
        return 0.0 if _is(first, 0) and not _is(second, 0) else first if _is(second, 1) else None
    return None


def _negated(entry: Any) -> fx.Node | None:
    """What an entry is the negative of."""
    if isinstance(entry, fx.Node) and entry.target is aten.neg.default and isinstance(entry.args[0], fx.Node):
        return entry.args[0]
    return None


def _is(entry: Any, number: int) -> bool:
    return isinstance(entry, int | float) and entry == number


_REDUCTIONS: dict[Any, Any] = {
    aten.sum.dim_IntList: aten.add.Tensor,
    aten.any.dim: aten.logical_or.default,
    aten.all.dim: aten.logical_and.default,
    aten.amax.default: aten.maximum.default,
    aten.amin.default: aten.minimum.default,
}
_COPIES = {aten._to_copy.default, aten.clone.default, torch.ops.prims.convert_element_type.default}
