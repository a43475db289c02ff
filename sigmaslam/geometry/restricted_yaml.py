"""YAML as calibrations and settings need it: no key twice, and limits on depth, aliases and digits."""

from __future__ import annotations

import re
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
        text: of the document.
        path: of its file, for messages.
        error: to raise.
    Raises:
        InputError: the text is no YAML, has a key twice, or goes beyond a limit; names file, line or key, and the mend.
    """
    try:
        return _RestrictedLoader(text).get_single_data()
    except _RefusedError as problem:
        raise error(f"{path}: {problem}") from None
    except yaml.YAMLError as problem:
        raise error(f"{path}: not valid YAML: {' '.join(str(problem).split())}") from None


# Numbers with an exponent as everybody else writes them: YAML 1.1 takes `1e-3` and `1.0e3` for text.
_EXPONENT = re.compile(r"^[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)[eE][-+]?[0-9]+$")


class _RefusedError(Exception):
    """What is wrong with a document, and the mend."""


class _RestrictedLoader(yaml.SafeLoader):
    # A number with dashes or colons is no date here.
    yaml_implicit_resolvers = {  # noqa: RUF012
        first: [(tag, pattern) for tag, pattern in resolvers if tag != "tag:yaml.org,2002:timestamp"]
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._path: list[str] = []
        self._characters = 0
        # Characters of each node that has been read, with all that it contains, by the identity of the node.
        self._sizes: dict[int, int] = {}

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """A node of the document, within the limits."""
        self._path.append(_step(parent, index))
        if len(self._path) > MAX_DEPTH:
            raise _RefusedError(f"{self._where()}: lists or mappings are deeper than {MAX_DEPTH}: write them flat")
        before = self._characters
        if self.check_event(yaml.AliasEvent):
            node = super().compose_node(parent, index)
            if id(node) not in self._sizes:
                raise _RefusedError(f"{self._where()}: an alias (*) is inside of what it names: write out the values")
            self._count(self._sizes[id(node)])
        else:
            self._count(_NODE_CHARACTERS)
            node = super().compose_node(parent, index)
        if isinstance(node, yaml.ScalarNode) and node.tag.endswith((":int", ":float")):
            self._check_digits(node)
        self._sizes[id(node)] = self._characters - before
        self._path.pop()
        return node

    def compose_scalar_node(self, anchor: Any) -> yaml.ScalarNode:
        """A value, which counts by its length."""
        node = super().compose_scalar_node(anchor)
        self._count(len(node.value))
        return node

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        """A mapping in which no key stands twice."""
        node = super().compose_mapping_node(anchor)
        seen: dict[str, int] = {}
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.tag != "tag:yaml.org,2002:merge":
                line = key.start_mark.line + 1
                if key.value in seen:
                    name = ".".join(step for step in [*self._path, shorten(key.value, 40)] if step)
                    raise _RefusedError(
                        f"key '{name}' stands twice, in lines {seen[key.value]} and {line}: remove the wrong one"
                    )
                seen[key.value] = line
        return node

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        """The value of a node; tags that do not fit their text become errors of YAML."""
        try:
            return super().construct_object(node, deep)
        except (ValueError, KeyError, AttributeError, TypeError, OverflowError, IndexError):
            raise _RefusedError(
                f"line {node.start_mark.line + 1}: {shorten(str(node.value), 40)!r} is no value of the type "
                f"{node.tag.rpartition(':')[2]}: correct it, or put it in quotes"
            ) from None

    def _count(self, characters: int) -> None:
        self._characters += characters
        if self._characters > MAX_CHARACTERS:
            raise _RefusedError(
                f"{self._where()}: with what aliases (*) repeat, the values have more than {MAX_CHARACTERS:,} "
                "characters: write out the values that are needed"
            )

    def _check_digits(self, node: yaml.ScalarNode) -> None:
        if len(node.value) > _MAX_DIGITS:
            raise _RefusedError(f"{self._where()}: a number of {len(node.value):,} characters: round it")

    def _where(self) -> str:
        return f"key '{shorten('.'.join(step for step in self._path if step))}'"


def _step(parent: yaml.Node | None, index: Any) -> str:
    """Name of a node in its parent: the key of a mapping, the number in a list."""
    if isinstance(index, yaml.ScalarNode):
        return shorten(index.value, 40)
    return str(index) if isinstance(index, int) else ""


_RestrictedLoader.add_implicit_resolver("tag:yaml.org,2002:float", _EXPONENT, list("-+.0123456789"))
