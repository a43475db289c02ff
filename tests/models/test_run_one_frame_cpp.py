"""The example in C++ finds what the one in Python finds, with the same library."""

import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import onnxruntime
import pytest

ROOT = Path(__file__).resolve().parents[2]
HEADER = "onnxruntime_c_api.h"
# Where packages of the system or of conda put it; ONNXRUNTIME_INCLUDE names that of an unpacked release.
FOLDERS = [
    Path(os.environ.get("ONNXRUNTIME_INCLUDE", "/usr/include")),
    *(
        root / "include" / inner
        for root in (Path("/usr"), Path("/usr/local"), Path(sys.prefix))
        for inner in ("", "onnxruntime", "onnxruntime/core/session")
    ),
]

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    include = next((folder for folder in FOLDERS if (folder / HEADER).is_file()), None)
    if include is None:
        pytest.skip(f"{HEADER} is not installed: set ONNXRUNTIME_INCLUDE to its folder")
    compiler = shutil.which(os.environ.get("CXX", "g++"))
    if compiler is None:
        pytest.skip("there is no C++ compiler")
    libraries = sorted((Path(onnxruntime.__file__).parent / "capi").glob("libonnxruntime.so.*"))
    if not libraries:
        pytest.skip("the installed onnxruntime has no libonnxruntime.so")
    folder = tmp_path_factory.mktemp("program")
    library = folder / "libonnxruntime.so.1"  # by this name the program looks for it
    library.symlink_to(libraries[-1])
    options = ["-std=c++17", "-O2", "-Wall", "-Wextra", "-Werror", f"-isystem{include}", f"-Wl,-rpath,{folder}"]
    source = ROOT / "examples" / "run_one_frame.cpp"
    subprocess.run([compiler, *options, source, "-o", folder / "run_one_frame", library], check=True)
    return folder / "run_one_frame"


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo's files that the example reads, images as PGM."""
    source, folder = ROOT / "synthetic" / "sigmaslam_synthetic" / "demo", tmp_path_factory.mktemp("demo")
    for name in ("calib.txt", "times.txt"):
        shutil.copy(source / name, folder)
    for eye in (0, 1):
        (folder / f"image_{eye}").mkdir()
        for index in (0, 3, 6):
            image = cv2.imread(str(source / f"image_{eye}" / f"{index:06d}.png"), cv2.IMREAD_GRAYSCALE)
            cv2.imwrite(str(folder / f"image_{eye}" / f"{index:06d}.pgm"), image)
    return folder


@pytest.mark.parametrize("index", [3, 6])
def test_it_finds_the_pose_and_covariance_of_the_example_in_python(program: Path, demo: Path, index: int):
    specification = importlib.util.spec_from_file_location("run_one_frame", ROOT / "examples" / "run_one_frame.py")
    example = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(example)
    pose, covariance = example.run(
        ROOT / "models" / "sigmaslam_weights", ROOT / "synthetic" / "sigmaslam_synthetic" / "demo", index
    )
    done = subprocess.run(
        [program, ROOT / "models" / "sigmaslam_weights", demo, str(index)], capture_output=True, text=True, check=True
    )
    numbers = np.array(done.stdout.split(), float)
    np.testing.assert_allclose(numbers[:16].reshape(4, 4), pose, rtol=0, atol=1e-9)
    np.testing.assert_allclose(numbers[16:].reshape(6, 6), covariance, rtol=1e-9, atol=1e-9 * np.abs(covariance).max())


@pytest.mark.parametrize(("weights", "index", "message"), [("nowhere", "3", "nowhere"), ("weights", "4", "is no PGM")])
def test_what_cannot_be_read_is_named(program: Path, demo: Path, weights: str, index: str, message: str):
    done = subprocess.run([program, ROOT / "models" / weights, demo, index], capture_output=True, text=True)
    assert done.returncode == 1
    assert message in done.stderr
    assert not done.stdout
