"""The compiled modules; everything else is in pyproject.toml."""

import os
import sysconfig

import pybind11
from setuptools import Extension, setup

# No -ffast-math and no contraction: the same bits on every run. AVX2 is chosen when the module is loaded.
FLAGS = ["-std=c++17", "-ffp-contract=off", "-fno-math-errno", "-fvisibility=hidden", "-g0"]
FLAGS += ["-Wno-psabi", "-Wno-unknown-pragmas"]
# Clang, which zig is too, vectorises with -O2 and does not know the flags for it.
CXX = os.environ.get("CXX") or sysconfig.get_config_var("CXX") or ""
VECTORISED = [] if "zig" in CXX or "clang" in CXX else ["-ftree-loop-vectorize", "-fvect-cost-model=dynamic"]


def compiled(name: str, folder: str, source: str, included: list[str], optimised: list[str]) -> Extension:
    """A module of one source; without a compiler its twin in Python serves."""
    return Extension(
        name,
        [f"{folder}/{source}"],
        depends=["sigmaslam/both_ways.inc", "sigmaslam/compiled.hpp", *(f"{folder}/{each}" for each in included)],
        include_dirs=[pybind11.get_include()],
        # Nothing is shared between modules: zig links a C++ library to each, which knows its own exceptions alone.
        define_macros=[("PYBIND11_STDLIB", f'"_sigmaslam{name.rpartition(".")[2]}"')],
        extra_compile_args=[*optimised, *FLAGS],
        language="c++",
        optional=True,
    )


KERNELS = compiled("sigmaslam.frontend._kernels", "sigmaslam/frontend", "kernels.cpp", ["kernels.inc"], ["-O3"])
# Loops are vectorised; what -O3 does besides takes minutes on the straight code of views.inc, and gains nothing.
ESTIMATOR = compiled(
    "sigmaslam.estimation._estimator",
    "sigmaslam/estimation",
    "estimator.cpp",
    ["estimator.inc", "views.inc"],
    ["-O2", *VECTORISED],
)
DEPTHS = compiled("sigmaslam.reconstruction._depths", "sigmaslam/reconstruction", "depths.cpp", ["depths.inc"], ["-O3"])

setup(ext_modules=[KERNELS, ESTIMATOR, DEPTHS])
