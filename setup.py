"""The compiled kernels; everything else is in pyproject.toml."""

import pybind11
from setuptools import Extension, setup

# No -ffast-math and no contraction: the same bits on every run. AVX2 is chosen when the module is loaded.
KERNELS = Extension(
    "sigmaslam.frontend._kernels",
    ["sigmaslam/frontend/kernels.cpp"],
    depends=["sigmaslam/frontend/kernels.inc"],
    include_dirs=[pybind11.get_include()],
    extra_compile_args=["-O3", "-std=c++17", "-ffp-contract=off", "-fvisibility=hidden", "-Wno-psabi", "-g0"],
    language="c++",
    optional=True,  # without a compiler the NumPy twin serves
)

setup(ext_modules=[KERNELS])
