"""Hashes of the code that figures and renders depend on: what a module imports, found by reading it."""

import ast
import hashlib
from collections.abc import Iterator
from functools import cache
from importlib.util import find_spec
from pathlib import Path

from sigmaslam.inference.onnx_graph import shipped_weights


def hash_code(*modules: Path) -> str:
    """Hash of everything between a recipe and a result: all code that these modules import, and the graphs that ship.

    Args:
        modules: Python files.
    """
    return _hash([*code_files(*modules), *shipped_weights("features.onnx").parent.glob("*.onnx")])


@cache
def hash_once(*modules: Path) -> str:
    """As `hash_code`; of the process, which keeps its code."""
    return hash_code(*modules)


@cache
def hash_renderer() -> str:
    """Hash of all code that the images and the truth of a recipe depend on; of the process, which keeps its code."""
    return _hash(code_files(*_files_of(("sigmaslam_synthetic", "render_sequence"))))


def code_files(*modules: Path) -> list[Path]:
    """Files that a result of these modules depends on, sorted.

    They are the modules, those of our packages that they import, at their head or inside of a function, and so on; and
    of each folder with one of these what is not Python, as sources and builds of compiled kernels. What forms pages
    makes no figures: `page.py` and `..._page.py` are left out.
    """
    found: set[Path] = set()
    waiting = [path.resolve() for path in modules]
    while waiting:
        path = waiting.pop()
        if path not in found:
            found.add(path)
            waiting += [each for each in _imported(path) if not each.stem.endswith("page")]
    packages = {path.parent for path in found if (path.parent / "__init__.py").is_file()}
    others = (path for folder in packages for path in folder.iterdir() if path.is_file() and path.suffix != ".py")
    return sorted({*found, *others})


def _hash(files: list[Path]) -> str:
    digest = hashlib.sha256()
    for path in sorted(files):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _imported(path: Path) -> Iterator[Path]:
    """Files of our modules and packages that a file imports."""
    for node in ast.walk(ast.parse(path.read_bytes())):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            # A name may be a module of the package.
            names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        for name in names:
            parts = name.split(".")
            if parts[0].startswith("sigmaslam"):
                for count in range(1, len(parts) + 1):
                    yield from _files_of(tuple(parts[:count]))


@cache
def _files_of(parts: tuple[str, ...]) -> list[Path]:
    """The file of a module or package; none where the name is that of something in a module."""
    spec = find_spec(parts[0])
    if spec is None or spec.origin is None:
        return []
    base = Path(spec.origin).resolve().parent.joinpath(*parts[1:])
    return [path for path in (base.with_suffix(".py"), base / "__init__.py") if path.is_file()]
