"""YAML as calibrations and settings need it: no key twice, and limits on depth, aliases and digits."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from sigmaslam.bounded_files import shorten
from sigmaslam.errors import InputError

MAX_DEPTH = 30
MAX_CHARACTERS = 500_000
"""Of all values, with those that aliases repeat."""
_MAX_DIGITS = 300
# Every list, mapping and value counts at least so many.
_NODE_CHARACTERS = 20


def parse_yaml(text: str, path: Path, error: type[InputError] = InputError) -> Any:
    """Content of a YAML document: mappings, lists, text, numbers, truth values and None; dates stay text.

    Args:
        path: of its file, for messages.
    Raises:
        InputError: the text is no YAML, has a key twice, or goes beyond a limit; names file, line or key, and the mend.
    """
    try:
        loader = _Loader(text)
        node = loader.get_single_node()
        if node is None:
            return None
        _measure(node, [], {})
        return loader.construct_document(node)
    except RecursionError:
        raise error(f"{path}: {_TOO_DEEP}") from None
    except _RefusedError as problem:
        raise error(f"{path}: {problem}") from None
    except yaml.YAMLError as problem:
        raise error(f"{path}: not valid YAML: {' '.join(str(problem).split())}") from None


_TOO_DEEP = f"lists or mappings are deeper than {MAX_DEPTH}: write them flat"
# Numbers with an exponent as everybody else writes them: YAML 1.1 takes `1e-3` and `1.0e3` for text.
_EXPONENT = re.compile(r"^[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)[eE][-+]?[0-9]+$")


class _RefusedError(Exception):
    """What is wrong with a document, and the mend."""


class _Loader(yaml.SafeLoader):
    # A number with dashes or colons is no date here.
    yaml_implicit_resolvers = {  # noqa: RUF012
        first: [(tag, pattern) for tag, pattern in resolvers if tag != "tag:yaml.org,2002:timestamp"]
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        """The value of a node; tags that do not fit their text become errors of YAML."""
        try:
            return super().construct_object(node, deep)
        except (ValueError, KeyError, AttributeError, TypeError, OverflowError, IndexError):
            raise _RefusedError(
                f"line {node.start_mark.line + 1}: {shorten(str(node.value), 40)!r} is no value of the type "
                f"{node.tag.rpartition(':')[2]}: correct it, or put it in quotes"
            ) from None


_Loader.add_implicit_resolver("tag:yaml.org,2002:float", _EXPONENT, list("-+.0123456789"))


def _measure(node: yaml.Node, steps: list[str], sizes: dict[int, int]) -> int:
    """Characters of a node with all that it contains, what aliases repeat included, if it is within the limits.

    `sizes` are those of the nodes so far, by identity; zero while they are measured.
    """
    where = f"key '{shorten('.'.join(steps))}'"
    if len(steps) >= MAX_DEPTH:
        raise _RefusedError(f"{where}: {_TOO_DEEP}")
    if id(node) in sizes:
        if not sizes[id(node)]:
            raise _RefusedError(f"{where}: an alias (*) is inside of what it names: write out the values")
        return sizes[id(node)]
    sizes[id(node)] = 0
    size = _NODE_CHARACTERS
    if isinstance(node, yaml.ScalarNode):
        size += len(node.value)
        if node.tag.endswith((":int", ":float")) and len(node.value) > _MAX_DIGITS:
            raise _RefusedError(f"{where}: a number of {len(node.value):,} characters: round it")
    for name, child in _children(node, steps):
        size += _measure(child, [*steps, name], sizes)
        if size > MAX_CHARACTERS:
            raise _RefusedError(
                f"key '{shorten('.'.join([*steps, name]))}': with what aliases (*) repeat, the values have more than "
                f"{MAX_CHARACTERS:,} characters: write out the values that are needed"
            )
    sizes[id(node)] = size
    return size


def _children(node: yaml.Node, steps: list[str]) -> Iterator[tuple[str, yaml.Node]]:
    """Keys and values of a mapping in which no key stands twice; numbers and items of a list."""
    if isinstance(node, yaml.SequenceNode):
        yield from ((str(number), item) for number, item in enumerate(node.value))
    seen: dict[str, int] = {}
    for key, value in node.value if isinstance(node, yaml.MappingNode) else ():
        name = shorten(key.value, 40) if isinstance(key, yaml.ScalarNode) else "?"
        if isinstance(key, yaml.ScalarNode) and key.tag != "tag:yaml.org,2002:merge":
            line = key.start_mark.line + 1
            if key.value in seen:
                raise _RefusedError(
                    f"key '{'.'.join([*steps, name])}' stands twice, in lines {seen[key.value]} and {line}: remove the "
                    "wrong one"
                )
            seen[key.value] = line
        yield name, key
        yield name, value
