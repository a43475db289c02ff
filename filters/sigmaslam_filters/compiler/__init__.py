"""Steps and sequences of filters as machine code, by torch's compiler; `docs/filters.md` has the contract for users.

Which torch: 2.9 up to, not including, 2.14, the range of `pyproject.toml`; tested with the pinned build. A new torch
passes `tests/filters/test_compiler_contract.py` before the range is widened.

Private parts of torch that are used, each listed with its signature in that test, and none besides:

- `components`: `torch._inductor.custom_graph_pass` (`CustomInferenceAwareGraphPass`, `get_hash_for_files`),
  `torch._subclasses.fake_tensor` (`FakeTensorMode`, `unset_fake_temporarily`), `aten._efficientzerotensor`,
  `aten._to_copy`.
- `scalar_sequence`, `header_export`: `torch._inductor.codecache.CppCodeCache`.
- `number_program`: `torch._decomp.core_aten_decompositions`.
- `compiled_step`: settings of `torch._inductor.config`, given as options of `torch.compile`.

What is rewritten: `components` writes the traced aten graph of a step anew, one array (B,) for each number, where the
batch is on a CPU, has 64 elements or more and no derivative is asked for. `number_program` makes a program of numbers
of a function of small tensors; `scalar_step` writes it and its derivative backward as C++ functions of one element,
`release/item_source.py` as a loop's body. `event_kinds` says which events share one, `scalar_sequence` calls them over
time, `header_export` hands them out.

What is guaranteed: the arithmetic is the library's, operation by operation, so results agree to 3e-14 of the largest
value in float64. A model is taken as it is when the step is compiled. What fails is said as the library says it.

What happens where it cannot be done: a graph that is too long, has another batch or leaves the CPU is compiled as torch
does it. A step that is no arithmetic on numbers becomes a loop around compiled steps (`ScalarStepError` is caught, the
log says why). A step that raises `FAILED` is run once more uncompiled, which names the element. Errors of torch's
compiler itself come out as they are: nothing goes on uncompiled in silence.
"""

from sigmaslam_filters.compiler.compiled_filter import CompiledFilter, compile_filter
from sigmaslam_filters.compiler.compiled_step import compile_step

__all__ = ["CompiledFilter", "compile_filter", "compile_step"]
