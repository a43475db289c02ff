"""Folders import only what stands below them, lazily or not; tests import what they may."""

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import sigmaslam
import sigmaslam.filters
import sigmaslam_filters

ROOT = Path(__file__).resolve().parents[1]
CONFIGURATION = tomllib.loads((ROOT / "pyproject.toml").read_text())
# What a package must never import at its first lines, nor anything that it imports so: parts of names of modules.
FORBIDDEN = {
    "sigmaslam_filters": ("sigmaslam", "cv2", "onnxruntime"),
    "sigmaslam_localisation": ("sigmaslam_training", "sigmaslam_synthetic", "tracker", "frontend"),
    "sigmaslam_synthetic": ("sigmaslam_models", "tracker", "sigmaslam_filters"),
    "sigmaslam_models": ("tracker", "frontend"),
    "sigmaslam": ("sigmaslam_training", "sigmaslam_synthetic", "torch"),
}

# Tables of names that the command line offers, and their packages: they import nothing.
NAMES = {"sigmaslam_training", "sigmaslam_training.mixes", "sigmaslam_synthetic", "sigmaslam_synthetic.render_choices"}
# All rooms from the ground up: a room imports only from floors below its own. A room is a folder of the run time, or
# a package beside it.
FLOORS = (
    ("sigmaslam", "compiled", "errors", "table", "sigmaslam_filters", "sigmaslam_weights"),
    ("bounded_files", "files", "progress", "plot_style", "filters"),
    ("geometry",),
    ("inference", "calibration_files"),
    ("estimation", "image_filtering", "readers"),
    ("frontend", "sigmaslam_synthetic"),
    ("two_view", "sigmaslam_models"),
    ("slam",),
    ("calibration", "fusion", "bodies"),
    ("checks",),
    ("run_record", "live"),
    ("report",),
    ("runs",),
    ("bundle_adjustment", "reconstruction", "sigmaslam_localisation"),
    ("sigmaslam_evaluation",),
    ("sigmaslam_training",),
    ("cli",),
    ("__main__", "sigmaslam_benchmarks"),
)
# The filters likewise, from the ground up; "" is the files that users read first.
FILTER_FLOORS = (("core", "consistency"), ("manifolds",), ("",), ("compiler",), ("graphs",))
# Rooms whose numbers decide what a pose is.
EXPLAINED = ("frontend", "two_view", "estimation", "slam")
# Of the tracker.
MAX_LINES, MAX_METHODS = 300, 12
# Lines of Python that are installed, and those of the run time; of the first 50,000 is the goal.
MAX_INSTALLED, MAX_RUN_TIME = 63_860, 36_571


def test_every_folder_with_modules_ships_but_the_benchmarks():
    found = CONFIGURATION["tool"]["setuptools"]["packages"]["find"]
    folders = {path.name for where in found["where"] for path in (ROOT / where).glob("sigmaslam*/")}
    # An editable install leaves its own beside them.
    folders = {name for name in folders if not name.endswith(".egg-info")}
    assert folders == {module for module in _files() if "." not in module}
    assert found["exclude"] == ["sigmaslam_benchmarks*"]
    assert all((path.parent / "__init__.py").is_file() for path in _files().values())


def test_what_a_user_installs_does_not_grow():
    lines = {module: path.read_text().count("\n") for module, path in _files().items()}
    shipped = {module: count for module, count in lines.items() if not module.startswith("sigmaslam_benchmarks")}
    assert sum(shipped.values()) <= MAX_INSTALLED
    assert sum(count for module, count in shipped.items() if module.split(".")[0] == "sigmaslam") <= MAX_RUN_TIME


def test_there_are_no_links():
    """A clone without links, as on Windows or from a zip file, is the same."""
    listed = subprocess.run(["git", "ls-files", "--stage"], cwd=ROOT, capture_output=True, text=True, check=True)
    assert not [line for line in listed.stdout.splitlines() if line.startswith("120000")]


@pytest.mark.long
def test_no_rooms_and_no_modules_import_each_other_in_a_circle():
    for name_of in (_room, str):
        graph: dict[str, set[str]] = {}
        for module in _files():
            graph.setdefault(name_of(module), set()).update(map(name_of, _named(module, _all_imports)))
        try:
            TopologicalSorter({name: names - {name} for name, names in graph.items()}).prepare()
        except CycleError as error:
            pytest.fail(" -> ".join(error.args[1]))


@pytest.mark.long
def test_rooms_import_only_what_stands_below_them():
    floor = {room: k for k, rooms in enumerate(FLOORS) for room in rooms}
    assert {_room(module) for module in _files()} == floor.keys()
    for module in _files():
        for imported in _named(module, _all_imports):
            if (other := _room(imported)) != (room := _room(module)):
                assert floor[other] < floor[room], f"{module} imports {imported}"


@pytest.mark.long
def test_the_run_time_names_no_package_beside_it():
    """Back ends and commands of other packages register themselves; the weights are no code."""
    for module in _modules_of("sigmaslam"):
        if _room(module) not in ("cli", "filters", "__main__"):
            beside = {name.split(".")[0] for name in _named(module, _all_imports)} - {"sigmaslam", "sigmaslam_weights"}
            assert not beside, f"{module} imports {beside}"


def test_the_filters_have_their_former_name_besides():
    for name in sigmaslam_filters.__all__:
        assert getattr(sigmaslam.filters, name) is getattr(sigmaslam_filters, name)


@pytest.mark.long
@pytest.mark.parametrize("layer", FORBIDDEN)
def test_lower_layers_do_not_import_upper_ones(layer: str):
    importer: dict[str, str] = {}
    # The former name of the filters stands in the run time and is loaded by nobody there.
    pending = [module for module in _modules_of(layer) if module != "sigmaslam.filters"]
    while pending:
        module = pending.pop()
        for imported in _imports(module) - importer.keys():
            importer[imported] = module
            pending.append(imported)
    for module in importer:
        if f"{module}.".startswith(f"{layer}.") or module in NAMES:
            continue
        parts = module.split(".")
        # Of others' modules only the package counts.
        if set(parts if module in _files() else parts[:1]) & set(FORBIDDEN[layer]):
            chain = [module]
            while chain[0] in importer and importer[chain[0]] not in chain:
                chain.insert(0, importer[chain[0]])
            pytest.fail(f"{layer} imports {module}: {' -> '.join(chain)}")


def test_folders_of_the_filters_import_only_what_stands_below_them():
    floor = {folder: k for k, folders in enumerate(FILTER_FLOORS) for folder in folders}
    assert floor.keys() == {_folder_of_filters(module) for module in _modules_of("sigmaslam_filters")}
    for module in set(_modules_of("sigmaslam_filters")) - {"sigmaslam_filters"}:
        folder = _folder_of_filters(module)
        for imported in _imports(module):
            if imported.startswith("sigmaslam_filters.") and (other := _folder_of_filters(imported)) != folder:
                assert floor[other] < floor[folder], f"{module} imports {imported}"


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


def test_every_number_between_images_and_poses_has_a_reason():
    """Each on its own: a comment above it or behind it, or a docstring below."""
    bare = [
        f"{module}: {name}"
        for module, path in _files().items()
        if module.startswith("sigmaslam.") and _room(module) in EXPLAINED
        for name in _numbers_without_a_word(path.read_text())
    ]
    assert not bare, "\n".join(bare)


def test_a_number_is_explained_by_a_comment_or_a_docstring_of_its_own():
    source = """
# Pixels.
EXPLAINED = 3.0
BARE = 4.0
BEHIND = 5.0  # pixels
BELOW, BESIDE = 6, 7
\"\"\"Metres.\"\"\"
NAMES = ("one", "two")
_COMPUTED: float = -2.0 * np.log(0.7)
lower = 8
"""
    assert list(_numbers_without_a_word(source)) == ["BARE", "_COMPUTED"]


def test_imports_for_type_checking_do_not_count_and_those_inside_functions_apart():
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
    first = {"a", "typing", "typing.TYPE_CHECKING", "c", "e", "e.f", "g", "g.h"}
    assert set(_top_level_imports(ast.parse(source))) == first
    assert set(_all_imports(ast.parse(source))) == {*first, "d"}


@pytest.mark.long
@pytest.mark.parametrize("module", ["sigmaslam_filters", "sigmaslam_filters.consistency.plots"])
def test_the_filters_load_neither_opencv_nor_onnxruntime(module: str):
    code = f"import sys, {module}; print(*sorted({{name.split('.')[0] for name in sys.modules}}))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert {"sigmaslam_filters", "torch"} <= loaded
    assert not loaded & {"cv2", "onnxruntime", "sigmaslam"}


@pytest.mark.long
def test_a_tracker_loads_neither_readers_nor_sensors():
    code = "import sys, sigmaslam.slam.tracker; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    late = {f"sigmaslam.{name}" for name in ("readers", "estimation.inertial_motion", "estimation.odometry_motion")}
    assert "sigmaslam.inference.session" in done.stdout.split()
    assert not late & set(done.stdout.split())


def test_every_public_name_of_the_package_is_there():
    for name in sigmaslam.__all__:
        assert getattr(sigmaslam, name).__name__ == name
        assert name in dir(sigmaslam)
    with pytest.raises(AttributeError, match="has no attribute 'Tracker'"):
        _ = sigmaslam.Tracker


def test_imports_are_absolute():
    for path in _files().values():
        assert not re.search(r"^from \.", path.read_text(), re.MULTILINE), path


@pytest.mark.long
def test_tests_share_through_the_support_package_alone():
    for path in (ROOT / "tests").rglob("*.py"):
        assert_shares_through_support(path)


def assert_shares_through_support(path: Path):
    """A test imports no other one, nor a file beside it by its bare name."""
    siblings = {each.stem for each in path.parent.iterdir() if each.suffix == ".py" or each.is_dir()} - {"sigmaslam"}
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: import from the root on, as tests.support"
            modules = [node.module or "", *(f"{node.module}.{name.name}" for name in node.names)]
        elif isinstance(node, ast.Import):
            modules = [name.name for name in node.names]
        else:
            continue
        line = f"{path}, line {node.lineno}"
        for module in modules:
            parts = module.split(".")
            assert parts[0] not in siblings, f"{line} imports {module}, a file beside it: use tests.support"
            parts = parts[1:] if parts[0] == "tests" else parts[:1]
            assert not any(part.startswith("test_") for part in parts), f"{line} imports the test {module}"


def _numbers_without_a_word(source: str) -> Iterator[str]:
    """Names of constants at the head of a module that hold a number and no reason for it."""
    lines, nodes = source.splitlines(), ast.parse(source).body
    for node, after in zip(nodes, [*nodes[1:], None], strict=True):
        if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None:
            continue
        names = ast.unparse(node.targets[0] if isinstance(node, ast.Assign) else node.target)
        values = [each.value for each in ast.walk(node.value) if isinstance(each, ast.Constant)]
        if names != names.upper() or not any(type(value) in (int, float) for value in values):
            continue
        documented = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
        commented = "#" in lines[node.lineno - 1] or lines[node.lineno - 2].startswith("#")
        if not documented and not commented:
            yield names


def _room(module: str) -> str:
    """The folder or file of a module in the runtime package; of others the package."""
    parts = module.split(".")
    return parts[1] if parts[0] == "sigmaslam" and len(parts) > 1 else parts[0]


def _folder_of_filters(module: str) -> str:
    """The folder of a module of the filters; "" for the files beside the folders."""
    package = module if _files()[module].name == "__init__.py" else module.rpartition(".")[0]
    return ".".join(package.split(".")[1:])


@cache
def _files() -> dict[str, Path]:
    """The file of each module of the project, by its dotted name."""
    files = {}
    for where in CONFIGURATION["tool"]["setuptools"]["packages"]["find"]["where"]:
        for path in (ROOT / where).glob("sigmaslam*/**/*.py"):
            parts = path.relative_to(ROOT / where).with_suffix("").parts
            files[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return files


def _modules_of(package: str) -> list[str]:
    return [module for module in _files() if module.split(".")[0] == package]


@cache
def _imports(module: str) -> frozenset[str]:
    """Modules that an import of this one runs: what it imports itself, and the packages it lies in.

    Modules of others have no imports here.
    """
    if module not in _files():
        return frozenset()
    imported = _named(module, _top_level_imports, others=True)
    for name in [module, *imported]:
        parts = name.split(".")
        imported |= {".".join(parts[:count]) for count in range(1, len(parts))}
    return frozenset(imported - {module})


def _named(module: str, imports: Callable[[ast.AST], Iterator[str]], others: bool = False) -> set[str]:
    """Modules that a module of the project names: those of the project, or of others as well."""
    named = set(imports(ast.parse(_files()[module].read_text())))
    # `from package import name` names a module only if there is one; a package that only passes names on is not meant.
    inner = {name for name in named if name in _files()}
    inner -= {name for name in inner if any(each.startswith(f"{name}.") for each in inner)} - {"sigmaslam"}
    return (inner | {name for name in named if not name.startswith("sigmaslam")} if others else inner) - {module}


def _all_imports(tree: ast.AST) -> Iterator[str]:
    """As `_top_level_imports`, those inside functions too."""
    yield from _top_level_imports(tree, lazy=True)


def _top_level_imports(tree: ast.AST, lazy: bool = False) -> Iterator[str]:
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
                yield from _top_level_imports(ast.Module([other], []), lazy)
        elif lazy or not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            yield from _top_level_imports(node, lazy)
