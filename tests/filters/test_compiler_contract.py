"""The compiler of filter steps uses what it says of torch, and the installed torch has it."""

import ast
import importlib
import inspect
import itertools
import tomllib
from pathlib import Path

import pytest
import torch
from packaging.requirements import Requirement
from packaging.version import Version

import sigmaslam_filters.compiler

ROOT = Path(__file__).parents[2]
FOLDER = Path(sigmaslam_filters.compiler.__file__).parent

# Private names by their modules, and arguments that they are called with, of those that are called.
PRIVATE = {
    "torch._inductor.custom_graph_pass.CustomInferenceAwareGraphPass.__call__": ("self", "graph", "is_inference"),
    "torch._inductor.custom_graph_pass.CustomInferenceAwareGraphPass.uuid": ("self",),
    "torch._inductor.custom_graph_pass.get_hash_for_files": ("paths",),
    "torch._subclasses.fake_tensor.FakeTensorMode.__enter__": ("self",),
    "torch._subclasses.fake_tensor.unset_fake_temporarily": (),
    "torch._inductor.codecache.CppCodeCache.load": ("source",),
    "torch._decomp.core_aten_decompositions": (),
}
PRIVATE_OPERATORS = {"_efficientzerotensor", "_to_copy"}
OPTIONS = {"post_grad_custom_pre_pass", "max_fusion_size", "guard_filter_fn", "size_asserts", "cpp_wrapper"}


def trees():
    return {path.name: ast.parse(path.read_text()) for path in sorted(FOLDER.glob("*.py"))}


def found(name):
    """What a dotted name stands for."""
    parts = name.split(".")
    for length in range(len(parts), 0, -1):
        try:
            thing = importlib.import_module(".".join(parts[:length]))
        except ModuleNotFoundError:
            continue
        for part in parts[length:]:
            thing = getattr(thing, part)
        return thing
    raise AssertionError(name)


@pytest.mark.parametrize("name", PRIVATE)
def test_torch_has_each_private_name_with_the_signature_that_is_called(name):
    thing, arguments = found(name), PRIVATE[name]
    if arguments is None:
        assert issubclass(thing, Exception)
        return
    signature = inspect.signature(thing)
    if "decompositions" in arguments:
        signature.bind(**dict.fromkeys(arguments))
    else:
        signature.bind(*arguments)


def test_no_private_part_of_torch_is_used_that_is_not_listed():
    imported, operators = set(), set()
    for tree in trees().values():
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("torch._"):
                imported |= {f"{node.module}.{name.name}" for name in node.names}
            elif isinstance(node, ast.Attribute) and node.attr.startswith("_") and not node.attr.startswith("__"):
                owner = ast.unparse(node.value)
                assert not owner.startswith("torch"), ast.unparse(node)
                if owner == "aten":
                    operators.add(node.attr)
    listed = {name.removesuffix(".__call__").removesuffix(".uuid").removesuffix(".__enter__").removesuffix(".load")
              for name in PRIVATE}  # fmt: skip
    assert imported == listed
    assert operators == PRIVATE_OPERATORS
    assert all(hasattr(torch.ops.aten, name) for name in operators)


def test_torch_knows_each_option_that_its_compiler_is_given():
    (options,) = [
        node.value
        for node in ast.walk(trees()["compiled_step.py"])
        if isinstance(node, ast.AnnAssign) and ast.unparse(node.target) == "options"
    ]
    names = {key.value for key in options.keys} | {"cpp_wrapper"}
    assert names == OPTIONS
    known = importlib.import_module("torch._inductor.config")
    assert all(hasattr(known, name) for name in OPTIONS - {"guard_filter_fn"})
    assert callable(torch.compiler.keep_tensor_guards_unsafe)
    with pytest.raises(RuntimeError, match="no_such_option"):
        torch.compile(lambda x: x, options={"no_such_option": True})


def test_the_range_of_torch_is_one_everywhere_and_holds_the_installed_one():
    ranges = set()
    for path in (ROOT / "pyproject.toml", ROOT / "filters" / "pyproject.toml"):
        project = tomllib.loads(path.read_text())["project"]
        listed = itertools.chain(project["dependencies"], *project.get("optional-dependencies", {}).values())
        ranges |= {each.specifier for each in map(Requirement, listed) if each.name == "torch"}
    (required,) = ranges
    assert required.contains(Version(torch.__version__), prereleases=True)
    bound = {each.operator: each.version for each in required}
    for text in (sigmaslam_filters.compiler.__doc__, (ROOT / "docs" / "filters.md").read_text()):
        assert f"{bound['>=']} up to, not including, {bound['<']}" in " ".join(text.split())
