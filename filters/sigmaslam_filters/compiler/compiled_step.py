"""torch.compile with the settings that suit a filter's step."""

from collections.abc import Callable
from functools import wraps
from types import FunctionType
from typing import Any, TypeVar

import torch

from sigmaslam_filters.core.failure import FAILED

# Operations that are fused into one loop; by default 64, which cuts a filter's step into a dozen.
_LARGEST_LOOP = 8192

F = TypeVar("F", bound=Callable)


def compile_step(step: F) -> F:
    """The step made into machine code for the shapes and dtypes that it is called with.

    A step is a function of tensors that calls `predict` and `update` and returns tensors. Batches of small filters
    become one loop over the batch, see `sigmaslam_filters.compiler.components`; others are fused into a few; of one
    filter most of the overhead goes. The first call for each set of shapes takes from ten seconds to a minute. Filters
    and models that the step refers to are taken as they are then: compile anew after changing one. A filter with
    iterations="auto" always linearises twice in compiled code. One with on_failure="raise" raises as it does elsewhere;
    the step is run once more, uncompiled, to find what to name.

    Args:
        step: a plain function of tensors, without side effects.
    Raises:
        TypeError: the step is not a plain function.
        FilterError: by the compiled step, where the step raises it.
    """
    if not isinstance(step, FunctionType):
        raise TypeError(f"compile_step takes a plain function (def or lambda), got {type(step).__name__}")
    # torch keeps compiled code by the function's code, which two functions made by one factory share; as what they
    # refer to is not checked, each needs code of its own.
    copy = FunctionType(step.__code__.replace(), step.__globals__, step.__name__, step.__defaults__, step.__closure__)
    # The compiler takes a second to load, which only this function has a use for.
    from sigmaslam_filters.compiler.components import InComponents

    options: dict[str, object] = {
        "post_grad_custom_pre_pass": InComponents(),
        "max_fusion_size": _LARGEST_LOOP,
        # Tensors' shapes are checked at each call; the models, which are constants, are not.
        "guard_filter_fn": torch.compiler.keep_tensor_guards_unsafe,
        "size_asserts": False,
    }
    if not torch.cuda.is_available():
        options["cpp_wrapper"] = True  # Python's share of a call is most of it for a single filter
    compiled = torch.compile(copy, dynamic=False, fullgraph=True, options=options)  # type: ignore[arg-type]

    @wraps(step)
    def run(*arguments: Any, **named: Any) -> Any:
        try:
            return compiled(*arguments, **named)
        except RuntimeError as error:
            if FAILED not in str(error):
                raise
        return step(*arguments, **named)

    return run  # type: ignore[return-value]
