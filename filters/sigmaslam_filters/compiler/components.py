"""A traced step, rewritten in components: each number of a filter is one array over the batch.

What a filter computes is written with small matrices (..., n, n), which a compiler assembles in memory and takes apart
again: some 25 passes over the batch where one would do. Here every operation of the traced graph is done entry by
entry: what assembles, slices and transposes is done by torch itself on the entries' numbers while the graph is
compiled, and all that is left is arithmetic on arrays (B,), which fuses into one loop. Zeros and ones that are known
take no part.

Nothing is asked of what was traced: the arithmetic is the same, operation by operation, whoever wrote it.
"""

import math
import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, fx
from torch._inductor.custom_graph_pass import CustomInferenceAwareGraphPass, get_hash_for_files
from torch._subclasses.fake_tensor import FakeTensorMode, unset_fake_temporarily

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
        with graph.inserting_before(nodes[-1]), unset_fake_temporarily():
            try:
                nodes[-1].args = (rewriter.run(nodes),)
            except TooLongError:
                rewriter.kept.update(nodes)
        for node in reversed(graph.nodes):
            if node.op == "call_function" and not node.users and node not in rewriter.kept:
                graph.erase_node(node)

    def uuid(self) -> Any:
        """What the compiler's cache knows the rewriting by."""
        return get_hash_for_files((__file__,))


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
    inputs = [_shape_of(node) for node in graph.nodes if node.op == "placeholder"]
    size = max((length for shape in inputs if shape is not None for length in shape), default=0)
    if not isinstance(size, int) or size < SMALLEST_BATCH:
        return None
    for node in graph.nodes:
        shape = _shape_of(node)
        if shape is not None and node.meta["val"].device.type != "cpu":
            return None
        if shape is not None and (any(type(length) is not int for length in shape) or shape.count(size) > 1):
            return None
        # Operations that change their arguments.
        if node.op == "call_function" and getattr(getattr(node.target, "_schema", None), "is_mutable", False):
            return None
    return size


def _shape_of(node: fx.Node) -> tuple[int, ...] | None:
    """Shape of what an operation gives; None if that is no tensor."""
    value = node.meta.get("val")
    return tuple(value.shape) if isinstance(value, Tensor) else None


@dataclass(frozen=True, slots=True)
class _Entries:
    """A tensor by its entries.

    Attributes:
        numbers: of its shape, but of length 1 along the batch: which of the rewriter's entries stands there.
        axis: the batch's dimension, None if there is none.
        source: the tensor itself, if it is there.
    """

    numbers: Tensor
    axis: int | None
    dtype: torch.dtype
    source: fx.Node | None = None


@dataclass(frozen=True, slots=True)
class _InRow:
    """Tensors end to end along the batch: half of what `torch.stack` is made of, the other half is a reshape.

    Attributes:
        pieces: of one shape.
    """

    pieces: list[_Entries]

    def stacked(self) -> _Entries:
        """With a dimension for the pieces, before that of the batch."""
        first = self.pieces[0]
        assert first.axis is not None
        return _Entries(torch.stack([each.numbers for each in self.pieces], first.axis), first.axis + 1, first.dtype)


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
        # Nodes (B,) or (), or numbers that are known.
        self._entries: list[Any] = []
        self._number_of: dict[Any, int] = {}
        likes = [node.meta["val"] for node in graph.nodes if _shape_of(node) is not None]
        self._device = likes[0].device
        self._fake: FakeTensorMode = likes[0].fake_mode

    def run(self, nodes: Sequence[fx.Node]) -> Any:
        """The arguments of the output node, which is the last, written anew."""
        for node in nodes[:-1]:
            self._made[node] = self._value(node)
        return fx.map_arg(nodes[-1].args[0], lambda each: self._whole(self._made[each]))

    def _value(self, node: fx.Node) -> Any:
        if node.op != "call_function":
            return self._taken(node)
        given = [self._made[each] for each in node.all_input_nodes]
        target: Any = node.target
        if target is operator.getitem:
            index: Any = node.args[1]
            return given[0][index] if isinstance(given[0], list) else self._kept(node)
        result: Any = None
        if target is aten.full.default:
            result = self._filled(node)
        elif target is aten.expand.default and isinstance(given[0], fx.Node) and self._batch in (_shape_of(node) or ()):
            result = self._moved(node, self._split(given[0]))
        elif target in _RESHAPES and isinstance(given[0], _InRow):
            result = self._moved(node, given[0].stacked())
        elif not any(isinstance(each, _Entries) for each in given) or any(isinstance(each, _InRow) for each in given):
            pass
        elif torch.Tag.pointwise in getattr(target, "tags", ()) or target in _COPIES:
            result = self._pointwise(node)
        elif target in _REDUCTIONS:
            result = self._reduced(node)
        elif target is aten.cat.default:
            result = self._concatenated(node)
        elif (target in _MOVES or target in _RESHAPES) and isinstance(self._given(node.args[0]), _Entries):
            result = self._moved(node, self._given(node.args[0]))
        return self._kept(node) if result is None else result

    def _given(self, argument: Any) -> Any:
        """What an argument has become; numbers are themselves."""
        return self._made[argument] if isinstance(argument, fx.Node) else argument

    def _number(self, entry: Any) -> int:
        """Of an entry, which may be there already."""
        key = entry if isinstance(entry, fx.Node) else (type(entry), repr(entry))
        if key not in self._number_of:
            self._number_of[key] = len(self._entries)
            self._entries.append(entry)
        return self._number_of[key]

    def _without_batch(self, shape: Sequence[int]) -> list[int]:
        return [1 if length == self._batch else length for length in shape]

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
        return self._taken(whole)

    def _taken(self, node: fx.Node) -> Any:
        """A whole tensor by its entries if it has a batch."""
        shape = _shape_of(node)
        return node if shape is None or self._batch not in shape else self._split(node)

    def _split(self, node: fx.Node) -> _Entries:
        shape = _shape_of(node)
        assert shape is not None
        axis = shape.index(self._batch) if self._batch in shape else None
        sizes = self._without_batch(shape)
        if math.prod(sizes) > self._most:
            raise TooLongError
        numbers = torch.zeros(sizes, dtype=torch.int64)
        for index in torch.cartesian_prod(*map(torch.arange, [*sizes, 1, 1])).tolist():
            part = node
            for k in reversed(range(len(shape))):
                if k != axis:
                    part = self._call(aten.select.int, part, k, index[k])
            numbers[tuple(index[: len(shape)])] = self._number(part)
        return _Entries(numbers, axis, node.meta["val"].dtype, node)

    def _filled(self, node: fx.Node) -> _Entries | None:
        shape, value = _shape_of(node), node.args[1]
        assert shape is not None
        if self._batch not in shape or not isinstance(value, int | float):
            return None
        numbers = torch.full(self._without_batch(shape), self._number(value))
        return _Entries(numbers, shape.index(self._batch), node.meta["val"].dtype)

    def _whole(self, value: Any) -> Any:
        """The tensor of some entries, with the batch last in memory."""
        if isinstance(value, list):
            return [self._whole(each) for each in value]
        if isinstance(value, _InRow):
            return self._call(aten.cat.default, [self._whole(each) for each in value.pieces], value.pieces[0].axis)
        if not isinstance(value, _Entries):
            return value
        if value.source is not None:
            return value.source
        assert value.axis is not None
        rows = []
        for number in value.numbers.flatten().tolist():
            row = self._node(number, value.dtype)
            row = row if _shape_of(row) else self._call(aten.expand.default, row, [self._batch])
            rows.append(self._call(aten.unsqueeze.default, row, 0))
        joined = self._call(aten.cat.default, rows) if len(rows) > 1 else rows[0]
        others = [length for k, length in enumerate(value.numbers.shape) if k != value.axis]
        joined = self._call(aten.reshape.default, joined, [*others, self._batch])
        order = [*range(len(others))]
        order.insert(value.axis, len(others))
        return self._call(aten.permute.default, joined, order)

    def _node(self, number: int, dtype: torch.dtype) -> fx.Node:
        """An entry as an operation, also if it is known."""
        entry = self._entries[number]
        if isinstance(entry, fx.Node):
            return entry
        return self._call(aten.full.default, [], entry, dtype=dtype, layout=torch.strided, device=self._device)

    def _call(self, target: Any, *arguments: Any, **named: Any) -> fx.Node:
        """One more operation, or the one that is there if it is the same."""
        key = (target, repr(arguments), repr(named))
        if key in self._known:
            return self._known[key]
        if len(self._known) >= self._most:
            raise TooLongError
        node = self._graph.call_function(target, arguments, named)
        values = fx.map_arg((arguments, named), lambda each: each.meta["val"])
        with self._fake:
            node.meta["val"] = target(*values[0], **values[1])
        self._known[key] = node
        return node

    # Arithmetic

    def _each(self, compute: Callable[..., Any], *operands: Tensor) -> Tensor:
        """Numbers of what `compute` makes of the numbers of the operands' entries."""
        shaped = torch.broadcast_tensors(*operands)
        rows = zip(*(each.flatten().tolist() for each in shaped), strict=True)
        return torch.tensor([self._number(compute(*row)) for row in rows]).reshape(shaped[0].shape)

    def _pointwise(self, node: fx.Node) -> _Entries | None:
        target: Any = node.target
        named = {key: value for key, value in node.kwargs.items() if key != "memory_format"}
        places = [k for k, each in enumerate(node.args) if isinstance(each, fx.Node)]
        if any(isinstance(each, fx.Node | list | tuple) for each in named.values()):
            return None
        given = [self._given(node.args[k]) for k in places]
        given = [each if isinstance(each, _Entries) else self._split(each) for each in given]
        dtype = node.meta["val"].dtype
        dtypes = dict(zip(places, (each.dtype for each in given), strict=True))
        same = dtype.is_floating_point and set(dtypes.values()) == {dtype}

        def compute(*numbers: int) -> Any:
            arguments: list[Any] = list(node.args)
            for k, number in zip(places, numbers, strict=True):
                arguments[k] = self._entries[number]
            return self._entry(target, arguments, named, dict(dtypes), same)

        numbers = self._each(compute, *(each.numbers for each in given))
        axis = next(each.axis - each.numbers.ndim + numbers.ndim for each in given if each.axis is not None)
        return _Entries(numbers, axis, dtype)

    def _entry(
        self, target: Any, arguments: list[Any], named: dict[str, Any], given: dict[int, torch.dtype], same: bool
    ) -> Any:
        """One entry of a pointwise operation on entries of these dtypes; where these are the `same` as that of the
        result, what is known takes no part."""
        if same and not named:
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
            arguments[k] = self._node(self._number(arguments[k]), each)
        return self._call(target, *arguments, **named)

    def _reduced(self, node: fx.Node) -> _Entries | None:
        """Sums and their like over dimensions other than the batch's."""
        given = self._given(node.args[0])
        if not isinstance(given, _Entries) or node.kwargs or len(node.args) < 2:
            return None
        wanted: Any = node.args[1]
        dims = [wanted] if isinstance(wanted, int) else list(wanted or [])
        dims = sorted({dim % given.numbers.ndim for dim in dims})
        dtype = node.meta["val"].dtype
        if not dims or given.axis in dims:
            return None
        numbers, before = given.numbers, given.dtype
        if dtype != before:  # a count
            convert = torch.ops.prims.convert_element_type.default
            numbers = self._each(lambda number: self._call(convert, self._node(number, before), dtype), numbers)

        def combine(first: int, second: int) -> Any:
            target, entries = _REDUCTIONS[node.target], [self._entries[first], self._entries[second]]
            simple = _simplified(target, entries) if dtype.is_floating_point else None
            return self._call(target, self._node(first, dtype), self._node(second, dtype)) if simple is None else simple

        for dim in reversed(dims):
            total, *rows = numbers.split(1, dim)
            for row in rows:
                total = self._each(combine, total, row)
            numbers = total
        shape = _shape_of(node)
        assert shape is not None
        return _Entries(numbers.reshape(self._without_batch(shape)), shape.index(self._batch), dtype)

    # Moves

    def _moved(self, node: fx.Node, given: _Entries) -> Any:
        """What a move makes of the entries' numbers; None where these do not tell."""
        target: Any = node.target
        values: Any = node.meta["val"]
        shapes = [tuple(each.shape) for each in (values if isinstance(values, list | tuple) else [values])]
        if given.axis is not None and any(self._batch not in shape for shape in shapes):
            return None
        sizes = [self._without_batch(shape) for shape in shapes]
        if target is aten.expand.default:
            found: Any = given.numbers.expand(sizes[0])
        elif target in _RESHAPES:
            axis = shapes[0].index(self._batch)
            if given.axis is None or math.prod(shapes[0][:axis]) != math.prod(given.numbers.shape[: given.axis]):
                return None
            found = given.numbers.reshape(sizes[0])
        elif target is aten.constant_pad_nd.default:
            found = target(given.numbers, node.args[1], self._number(float((*node.args, 0.0)[2])))  # type: ignore[arg-type]
        else:
            found = target(given.numbers, *node.args[1:], **node.kwargs)
        pieces = list(found) if isinstance(found, list | tuple) else [found]
        if [list(each.shape) for each in pieces] != sizes:
            return None
        pairs = zip(pieces, shapes, strict=True)
        results = [_Entries(each, shape.index(self._batch), given.dtype) for each, shape in pairs]
        return results if isinstance(found, list | tuple) else results[0]

    def _concatenated(self, node: fx.Node) -> _Entries | _InRow | None:
        pieces: Any = node.args[0]
        dim: Any = node.args[1] if len(node.args) > 1 else node.kwargs.get("dim", 0)
        given = [self._given(each) for each in pieces]
        given = [each if isinstance(each, _Entries) else self._split(each) for each in given]
        axes = {each.axis for each in given}
        if len(axes) != 1:
            return None
        if dim % given[0].numbers.ndim in axes:
            return _InRow(given)
        return _Entries(torch.cat([each.numbers for each in given], dim), given[0].axis, given[0].dtype)


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
_RESHAPES = {aten.reshape.default, aten.view.default, aten.squeeze.dim, aten.squeeze.dims}
# What only moves entries, and is done by torch itself on their numbers.
_MOVES = {
    *(aten.permute.default, aten.select.int, aten.slice.Tensor, aten.unsqueeze.default, aten.expand.default),
    *(aten.constant_pad_nd.default, aten.diagonal.default, aten.split.Tensor, aten.split_with_sizes.default),
    *(aten.unbind.int, aten.alias.default),
}
