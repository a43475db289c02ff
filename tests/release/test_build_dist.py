"""What is handed out is the same, byte for byte, wherever and whenever it is built."""

import io
import os
import runpy
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path
from types import SimpleNamespace

import pytest
import setuptools

from release.build_dist import normalise_tar

ROOT = Path(__file__).resolve().parents[2]


def pack(names: list[str], user: str, seconds: int, mode: int) -> bytes:
    """A .tar.gz of files that hold their own names."""
    written = io.BytesIO()
    with tarfile.open(fileobj=written, mode="w:gz") as archive:
        for name in names:
            member = tarfile.TarInfo(name)
            member.size, member.mtime, member.mode, member.uname, member.uid = len(name), seconds, mode, user, seconds
            archive.addfile(member, io.BytesIO(name.encode()))
    return written.getvalue()


def test_order_user_time_and_umask_leave_no_trace_in_an_archive():
    one = normalise_tar(pack(["p/a", "p/b"], "ann", 1, 0o600), 1000)
    other = normalise_tar(pack(["p/b", "p/a"], "bob", 2, 0o664), 1000)
    assert one == other
    with tarfile.open(fileobj=io.BytesIO(one)) as archive:
        assert {each.name: archive.extractfile(each).read().decode() for each in archive} == {
            "p/a": "p/a",
            "p/b": "p/b",
        }
        assert {(each.mtime, each.mode, each.uname) for each in archive.getmembers()} == {(1000, 0o644, "")}
    assert normalise_tar(pack(["p/a", "p/b"], "ann", 1, 0o700), 1000) != one


@pytest.mark.parametrize(
    ("compiler", "is_clang"),
    [("g++ -pthread", False), ("clang++", True), ("/tmp/python -m ziglang c++ -target aarch64-linux-gnu.2.28", True)],
)
def test_each_compiler_gets_the_flags_that_it_knows(compiler: str, is_clang: bool, monkeypatch: pytest.MonkeyPatch):
    """Kernels are optional: with a flag that it refuses a wheel would come out without them."""
    modules: list[setuptools.Extension] = []
    monkeypatch.setenv("CXX", compiler)
    monkeypatch.setitem(sys.modules, "pybind11", SimpleNamespace(get_include=str))
    monkeypatch.setattr(setuptools, "setup", lambda ext_modules: modules.extend(ext_modules))
    runpy.run_path(str(ROOT / "setup.py"))
    assert [module.name for module in modules] == ["sigmaslam.frontend._kernels", "sigmaslam.estimation._estimator"]
    flags = {flag for module in modules for flag in module.extra_compile_args}
    assert {"-ffp-contract=off", "-O2", "-O3"} <= flags
    assert bool({"-ftree-loop-vectorize", "-fvect-cost-model=dynamic"} & flags) != is_clang


@pytest.mark.slow
def test_two_folders_give_the_same_archives(tmp_path: Path):
    """Of what is committed; needs a package index for the tools."""
    sums = []
    for folder, zone, umask in (("one", "UTC", 0o022), ("another/folder", "Asia/Tokyo", 0o077)):
        clone, out = tmp_path / folder, tmp_path / f"dist{umask}"
        subprocess.run(["git", "clone", "--quiet", str(ROOT), str(clone)], check=True, umask=umask)
        command = [sys.executable, str(clone / "release" / "build_dist.py"), str(out)]
        subprocess.run(command, check=True, umask=umask, env={**os.environ, "TZ": zone})
        sums.append((out / "SHA256SUMS").read_text())
    assert sums[0] == sums[1]
    names = [line.split()[1] for line in sums[0].splitlines()]
    assert [name.endswith("none-any.whl") for name in names].count(True) == 1
    for name in names:
        if name.endswith(".whl"):
            with zipfile.ZipFile(out / name) as wheel:
                content = b"".join(map(wheel.read, wheel.namelist()))
                assert any(each.endswith("licenses/LICENSE") for each in wheel.namelist())
                assert any(each.endswith("docs/object.md") for each in wheel.namelist())
            assert str(tmp_path).encode() not in content


@pytest.mark.slow
def test_the_filters_are_a_wheel_of_their_own(tmp_path: Path):
    """It loads and filters without the rest of the project; torch comes from this environment."""
    sources = shutil.copytree(ROOT / "filters", tmp_path / "filters")  # a build leaves files there
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", str(tmp_path)]
    subprocess.run([*command, str(sources)], check=True)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as content:
        assert {name.split("/")[0].split("-")[0] for name in content.namelist()} == {"sigmaslam_filters"}
    code = (
        "import sys, torch\n"
        "sys.meta_path = [each for each in sys.meta_path if 'editable' not in type(each).__module__ + repr(each)]\n"
        f"sys.path.insert(0, {str(wheel)!r})\n"
        "from sigmaslam_filters import *\n"
        "polar = MeasurementModel(lambda x: x[..., :1] ** 2, Diagonal(torch.tensor([0.01])))\n"
        "belief = Gaussian(torch.ones(5, 2), torch.eye(2))\n"
        "result = UnscentedKalmanFilter().update(belief, polar, torch.tensor([1.5]))\n"
        "assert result.belief.mean.shape == (5, 2)\n"
        "assert not {name for name in sys.modules if name.split('.')[0] in ('sigmaslam', 'cv2', 'onnxruntime')}\n"
    )
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=True)
