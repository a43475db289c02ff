"""Writes the view functions of the estimator as C++, for `sigmaslam/estimation/views.cpp`.

`python -m sigmaslam_models.estimator.view_source` writes the file anew after a change of `view_functions`.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.resources import files
from pathlib import Path

import torch
from torch import Tensor

from sigmaslam_filters.compiler.scalar_loop import HEAD, write_function
from sigmaslam_models.estimator.view_functions import PAIR, see, weigh

# Of one view's arguments.
_SHAPES: dict[Callable[..., tuple[Tensor, ...]], tuple[tuple[int, ...], ...]] = {
    see: ((PAIR,), (12,), (5,), (6,), (6, 6), (3, 2)),
    weigh: ((3,), (3,), (3, 3), (3, 18), (3, 6)),
}


def view_source() -> str:
    """The file."""
    # Values do not matter, but no factorisation may fail.
    functions = [
        write_function(step.__name__, step, [torch.ones(shape, dtype=torch.float64) for shape in shapes])
        for step, shapes in _SHAPES.items()
    ]
    note = "// Written by `python -m sigmaslam_models.estimator.view_source`; not to be changed by hand.\n"
    return note + HEAD + "\n" + "\n".join(functions)


def main() -> None:
    """Writes it where the package lies."""
    Path(str(files("sigmaslam.estimation") / "views.inc")).write_text(view_source())


if __name__ == "__main__":
    main()
