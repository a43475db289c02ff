"""The package list, the folders and the links agree; lower layers do not import upper ones."""

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
