"""The package list, the folders and the links agree; lower layers and tests import what they may."""

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

import sigmaslam

ROOT = Path(__file__).resolve().parents[1]
MAPPED = ("evaluation", "filters", "localisation", "models", "synthetic", "training")
# What a layer must never import, nor anything that it imports: names of modules or of folders outside the layer.
FORBIDDEN = {
    "filters": ("models", "training", "synthetic", "evaluation", "tracker", "frontend", "camera"),
    "localisation": ("training", "synthetic", "evaluation", "tracker", "frontend"),
    "synthetic": ("models", "training", "evaluation", "tracker", "filters"),
    "models": ("training", "evaluation", "tracker", "frontend"),
    "sigmaslam": ("training", "synthetic", "torch"),
}

# Tables of names that the command line offers, and their packages: they import nothing.
NAMES = {f"sigmaslam.{name}" for name in ("training", "training.mixes", "synthetic", "synthetic.render_choices")}
# The runtime from the ground up: a folder imports only from floors below its own.
FLOORS = (
    ("errors", "table"),
    ("bounded_files", "files", "progress", "plot_style", "source_commit"),
    ("geometry",),
    ("inference",),
    ("estimation", "image_filtering", "readers"),
    ("frontend",),
    ("two_view",),
    ("slam",),
    ("calibration", "checks", "fusion"),
    ("runs",),
    ("bundle_adjustment", "reconstruction"),
    ("cli",),
    ("__main__", ""),
)
# The filters likewise, from the ground up; "" is the files that users read first.
FILTER_FLOORS = (("core", "consistency"), ("manifolds",), ("",), ("graphs",), ("tracking",))
# Of the tracker.
MAX_LINES, MAX_METHODS = 300, 12


def test_the_package_list_names_every_folder_with_modules():
    configuration = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    directories = {"sigmaslam": "sigmaslam", **configuration["package-dir"]}
    found = set()
    for name in ("sigmaslam", *MAPPED):
        for init in (ROOT / name).rglob("__init__.py"):
            package = init.parent.relative_to(ROOT)
            if any((ROOT / parent).is_symlink() for parent in [package, *package.parents]):
                continue
            dotted = ".".join(package.parts)
            found.add(dotted if name == "sigmaslam" else f"sigmaslam.{dotted}")
    assert found == set(configuration["packages"])
    assert all((ROOT / directory / "__init__.py").is_file() for directory in directories.values())


@pytest.mark.parametrize("name", MAPPED)
def test_the_link_inside_the_package_leads_to_the_folder(name: str):
    link = ROOT / "sigmaslam" / name
    assert link.is_symlink()
    assert link.resolve() == ROOT / name


@pytest.mark.parametrize("layer", FORBIDDEN)
def test_lower_layers_do_not_import_upper_ones(layer: str):
    importer: dict[str, str] = {}
    pending = _modules_of(layer)
    while pending:
        module = pending.pop()
        for imported in _imports(module) - importer.keys():
            importer[imported] = module
            pending.append(imported)
    for module in importer:
        if f"{module}.".startswith(f"sigmaslam.{layer}.") or module in NAMES:
            continue
        parts = module.split(".")
        # Of others' modules only the package counts.
        if set(parts if parts[0] == "sigmaslam" else parts[:1]) & set(FORBIDDEN[layer]):
            chain = [module]
            while chain[0] in importer and importer[chain[0]] not in chain:
                chain.insert(0, importer[chain[0]])
            pytest.fail(f"{layer} imports {module}: {' -> '.join(chain)}")


def test_folders_of_the_runtime_import_only_what_stands_below_them():
    floor = {room: k for k, rooms in enumerate(FLOORS) for room in rooms}
    for module in _modules_of("sigmaslam"):
        room = _room(module)
        for imported in _imports(module):
            other = _room(imported)
            if other and other in floor and other != room:
                assert floor[other] < floor[room], f"{module} imports {imported}"


def test_folders_of_the_filters_import_only_what_stands_below_them():
    floor = {folder: k for k, folders in enumerate(FILTER_FLOORS) for folder in folders}
    assert floor.keys() == {_folder_of_filters(module) for module in _modules_of("filters")}
    for module in set(_modules_of("filters")) - {"sigmaslam.filters"}:
        folder = _folder_of_filters(module)
        for imported in _imports(module):
            if imported.startswith("sigmaslam.filters.") and (other := _folder_of_filters(imported)) != folder:
                assert floor[other] < floor[folder], f"{module} imports {imported}"


def test_every_module_of_the_runtime_has_its_floor():
    rooms = {room for rooms in FLOORS for room in rooms}
    assert {_room(module) for module in _modules_of("sigmaslam")} == rooms


@pytest.mark.parametrize("room", ["estimation", "slam"])
def test_the_tracker_s_modules_and_classes_stay_small(room: str):
    for module, path in _files().items():
        if _room(module) == room:
            source = path.read_text()
            assert len(source.splitlines()) <= MAX_LINES, module
            for node in ast.walk(ast.parse(source)):
                if isinstance(node, ast.ClassDef):
                    methods = [each for each in node.body if isinstance(each, ast.FunctionDef)]
                    assert len(methods) <= MAX_METHODS, f"{module}.{node.name}"


def test_imports_for_type_checking_and_inside_functions_do_not_count():
    source = """
import a
from typing import TYPE_CHECKING
if TYPE_CHECKING:
    import b
else:
    import c
def function():
    import d
try:
    from e import f
except ImportError:
    f = None
class Class:
    from g import h
"""
    assert set(_top_level_imports(ast.parse(source))) == {
        "a",
        "typing",
        "typing.TYPE_CHECKING",
        "c",
        "e",
        "e.f",
        "g",
        "g.h",
    }


@pytest.mark.parametrize("module", ["sigmaslam.filters", "sigmaslam.filters.consistency.plots"])
def test_the_filters_load_neither_opencv_nor_onnxruntime(module: str):
    code = f"import sys, {module}; print(*sorted({{name.split('.')[0] for name in sys.modules}}))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert {"sigmaslam", "torch"} <= loaded
    assert not loaded & {"cv2", "onnxruntime"}


def test_every_public_name_of_the_package_is_there():
    for name in sigmaslam.__all__:
        assert getattr(sigmaslam, name).__name__ == name
        assert name in dir(sigmaslam)
    with pytest.raises(AttributeError, match="has no attribute 'Tracker'"):
        _ = sigmaslam.Tracker


def test_imports_are_absolute():
    for path in _files().values():
        assert not re.search(r"^from \.", path.read_text(), re.MULTILINE), path


@pytest.mark.parametrize("path", sorted((ROOT / "tests").rglob("*.py")), ids=lambda path: path.name)
def test_tests_share_through_the_support_package_alone(path: Path):
    """No test imports another one, nor a file beside it by its bare name."""
    siblings = {each.stem for each in path.parent.iterdir() if each.suffix == ".py" or each.is_dir()} - {"sigmaslam"}
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"line {node.lineno}: import from the root on, as tests.support"
            modules = [node.module or "", *(f"{node.module}.{name.name}" for name in node.names)]
        elif isinstance(node, ast.Import):
            modules = [name.name for name in node.names]
        else:
            continue
        for module in modules:
            parts = module.split(".")
            assert parts[0] not in siblings, f"line {node.lineno} imports {module}, a file beside it: use tests.support"
            parts = parts[1:] if parts[0] == "tests" else parts[:1]
            assert not any(part.startswith("test_") for part in parts), f"line {node.lineno} imports the test {module}"


def _room(module: str) -> str:
    """The folder or file of a module in the runtime package."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 else ""


def _folder_of_filters(module: str) -> str:
    """The folder of a module of the filters; "" for the files beside the folders."""
    package = module if _files()[module].name == "__init__.py" else module.rpartition(".")[0]
    return ".".join(package.split(".")[2:])


@cache
def _files() -> dict[str, Path]:
    """The file of each module of the project, by its dotted name."""
    files = {}
    for name in ("sigmaslam", *MAPPED):
        for path in (ROOT / name).rglob("*.py"):
            inner = path.relative_to(ROOT)
            if any((ROOT / parent).is_symlink() for parent in inner.parents):
                continue
            parts = inner.with_suffix("").parts
            if parts[-1] == "__init__":
                parts = parts[:-1]
            files[".".join(parts if name == "sigmaslam" else ("sigmaslam", *parts))] = path
    return files


def _modules_of(layer: str) -> list[str]:
    return [module for module, path in _files().items() if path.relative_to(ROOT).parts[0] == layer]


@cache
def _imports(module: str) -> frozenset[str]:
    """Modules that an import of this one runs: what it imports itself, and the packages it lies in.

    Modules of others have no imports here.
    """
    if module not in _files():
        return frozenset()
    named = set(_top_level_imports(ast.parse(_files()[module].read_text())))
    # `from package import name` names a module only if there is one.
    imported = {name for name in named if not name.startswith("sigmaslam") or name in _files()}
    for name in [module, *imported]:
        parts = name.split(".")
        imported |= {".".join(parts[:count]) for count in range(1, len(parts))}
    return frozenset(imported - {module})


def _top_level_imports(tree: ast.AST) -> Iterator[str]:
    """Names of modules, and of what is imported from them, outside functions and `if TYPE_CHECKING:`."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.module is not None
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
            for other in node.orelse:
                yield from _top_level_imports(ast.Module([other], []))
        elif not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            yield from _top_level_imports(node)
