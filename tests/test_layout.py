"""The package list, the folders and the links agree; lower layers and tests import what they may."""

import ast
import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
MAPPED = ("evaluation", "filters", "models", "synthetic", "training")
# What a layer must never import.
FORBIDDEN = {
    "filters": ("models", "training", "synthetic", "evaluation", "tracker", "frontend", "camera"),
    "synthetic": ("models", "training", "evaluation", "tracker", "filters"),
    "models": ("training", "evaluation", "tracker", "frontend"),
    "sigmaslam": ("training", "synthetic", "torch"),
}
# The command line reaches everything, each part where its command needs it.
EXCEPTIONS = (Path("sigmaslam/cli"),)


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
    for path in (ROOT / layer).rglob("*.py"):
        inner = path.relative_to(ROOT)
        if any((ROOT / parent).is_symlink() for parent in inner.parents) or inner.parent in EXCEPTIONS:
            continue
        # Imports at the start of a line: those inside functions are lazy, for extras.
        for module in re.findall(r"^(?:from|import) ([\w.]+)", path.read_text(), re.MULTILINE):
            parts = module.removeprefix("sigmaslam.").split(".")
            assert parts[0] not in FORBIDDEN[layer], f"{inner} imports {module}"


@pytest.mark.parametrize("path", sorted(p for n in ("sigmaslam", *MAPPED) for p in (ROOT / n).glob("*.py")), ids=str)
def test_imports_are_absolute(path: Path):
    assert not re.search(r"^from \.", path.read_text(), re.MULTILINE)


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
