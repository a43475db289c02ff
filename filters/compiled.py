"""torch.compile with the settings that suit a filter's step."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import torch

F = TypeVar("F", bound=Callable)


def compile_step(step: F) -> F:
    """The step made into machine code for the shapes and dtypes that it is called with.

    A step is a function of tensors that calls `predict` and `update` and returns tensors. Batches of small filters are
    fused into a few loops; of a single filter most of the overhead goes. The first call for each set of shapes takes
    from ten seconds to a minute. Filters and models that the step refers to are taken as they are then: compile anew
    after changing one. Give the filter on_failure="hold" and a fixed number of iterations, or the step is either cut
    in two or always linearises twice.

    Args:
        step: function of tensors, without side effects.
    """
    options: dict[str, object] = {
        # Tensors' shapes are checked at each call; the models, which are constants, are not.
        "guard_filter_fn": torch.compiler.keep_tensor_guards_unsafe,
        "size_asserts": False,
    }
    if not torch.cuda.is_available():
        options["cpp_wrapper"] = True  # Python's share of a call is most of it for a single filter
    return torch.compile(step, dynamic=False, fullgraph=True, options=options)  # type: ignore[arg-type,return-value]
