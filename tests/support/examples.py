"""Scripts and notebooks of examples/ as tests run them."""

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def load_example(name: str) -> ModuleType:
    """The module of a script, by its name without .py; its `__main__` part does not run."""
    (path,) = EXAMPLES.rglob(f"{name}.py")
    specification = importlib.util.spec_from_file_location(name, path)
    assert specification
    assert specification.loader
    example = importlib.util.module_from_spec(specification)
    sys.modules[name] = example  # where dataclasses look for its types
    specification.loader.exec_module(example)
    return example


def run_notebook(name: str) -> dict[str, Any]:
    """What a notebook's cells leave behind, run in order as plain Python."""
    path = EXAMPLES / f"{name}.ipynb"
    names: dict[str, Any] = {}
    for number, cell in enumerate(json.loads(path.read_text(encoding="utf-8"))["cells"]):
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), f"{path.name}, cell {number}", "exec"), names)
    return names
