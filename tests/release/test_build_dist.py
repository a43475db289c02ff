"""What is handed out is the same, byte for byte, wherever and whenever it is built."""

import hashlib
import io
import os
import platform
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

from release.build_dist import as_many_linux, normalise_tar

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
    names = ["sigmaslam.frontend._kernels", "sigmaslam.estimation._estimator", "sigmaslam.reconstruction._depths"]
    assert [module.name for module in modules] == names
    assert len({value for module in modules for _, value in module.define_macros}) == len(modules)
    flags = {flag for module in modules for flag in module.extra_compile_args}
    assert {"-ffp-contract=off", "-O2", "-O3"} <= flags
    assert bool({"-ftree-loop-vectorize", "-fvect-cost-model=dynamic"} & flags) != is_clang


@pytest.mark.long
@pytest.mark.parametrize(
    ("library", "version", "refused"),
    [("libc.so.6", "2.28", False), ("libc.so.6", "2.29", True), ("libhere.so.1", "2.28", True)],
)
def test_a_wheel_that_needs_more_than_its_systems_have_is_refused(
    library: str, version: str, refused: bool, tmp_path: Path
):
    """A newer glibc, or a library of one's own; both stand-ins here."""
    pytest.importorskip("auditwheel")
    wheelfile = pytest.importorskip("wheel.wheelfile")
    machine = platform.machine()
    (tmp_path / "versions").write_text(f"GLIBC_{version} {{ global: newest; }};")
    (tmp_path / "library.c").write_text("void newest(void) {}")
    (tmp_path / "module.c").write_text("void newest(void); void PyInit_module(void) { newest(); }")
    # Not where gcc runs: with an empty entry in LD_LIBRARY_PATH it would load the stand-in.
    (tmp_path / "lib").mkdir()
    for code in (
        ["library.c", f"-Wl,-soname,{library},--version-script=versions", "-o", f"lib/{library}"],
        ["module.c", f"lib/{library}", "-o", "module.so"],
    ):
        subprocess.run(["gcc", "-shared", "-fPIC", "-nostdlib", *code], cwd=tmp_path, check=True)
    wheel = tmp_path / f"p-1-py3-none-linux_{machine}.whl"
    with wheelfile.WheelFile(wheel, "w") as content:
        content.write(tmp_path / "module.so", "p/module.so")
        content.writestr("p-1.dist-info/METADATA", "Metadata-Version: 2.1\nName: p\nVersion: 1\n")
        content.writestr("p-1.dist-info/WHEEL", f"Wheel-Version: 1.0\nTag: py3-none-linux_{machine}\n")
    if refused:
        with pytest.raises(RuntimeError, match="does not run on all systems of manylinux_2_28"):
            as_many_linux(Path(sys.executable), wheel, machine, dict(os.environ))
    else:
        named = as_many_linux(Path(sys.executable), wheel, machine, dict(os.environ))
        assert [named] == list(tmp_path.glob("*.whl"))
        assert named.name == f"p-1-py3-none-manylinux_2_28_{machine}.whl"


def test_what_is_published_was_built_once_for_many_linux_and_tried_before():
    command = ["make", "--dry-run", "publish", "PYTHONS=one another"]
    plan = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    steps = [
        plan.index(each) for each in ("build_dist.py --many-linux dist one another", "sigmaslam demo", "twine upload")
    ]
    assert steps == sorted(steps)
    assert plan.count("build_dist.py") == plan.count("rm -rf dist") == 1


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
                licences = {each.rpartition("licenses/")[2] for each in wheel.namelist() if "/licenses/" in each}
                assert licences == {"LICENSE", "LICENSE.pybind11"}
                assert any(each.endswith("docs/object.md") for each in wheel.namelist())
            assert str(tmp_path).encode() not in content


@pytest.mark.slow
@pytest.mark.timeout(3000)  # zig compiles its C++ library for each machine first
def test_wheels_for_many_linux_are_of_their_machines(tmp_path: Path):
    """Which their names say, those of their modules and those modules themselves."""
    command = [sys.executable, str(ROOT / "release" / "build_dist.py"), "--many-linux", str(tmp_path)]
    subprocess.run(command, check=True)
    sums = dict(reversed(line.split()) for line in (tmp_path / "SHA256SUMS").read_text().splitlines())
    assert sums == {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in tmp_path.glob("sigmaslam*")}
    for machine, number in {"x86_64": 62, "aarch64": 183}.items():  # of ELF
        (path,) = tmp_path.glob(f"*manylinux_2_28_{machine}.whl")
        with zipfile.ZipFile(path) as wheel:
            modules = [name for name in wheel.namelist() if name.endswith(".so")]
            assert sorted(Path(name).name for name in modules) == [
                f"_{name}.{sys.implementation.cache_tag}-{machine}-linux-gnu.so"
                for name in ("depths", "estimator", "kernels")
            ]
            assert {int.from_bytes(wheel.read(name)[18:20], "little") for name in modules} == {number}
            wheel.extractall(tmp_path / machine)
    code = (
        "import numpy, sigmaslam.estimation._estimator as estimator, sigmaslam.frontend._kernels as kernels\n"
        "print(kernels.__file__, estimator.__file__, estimator.FAST)\n"
        "kernels.fit_slopes(numpy.zeros(3), numpy.zeros(3), [0], 1, 1.0, 1.0, [1.0])"
    )
    command = [sys.executable, "-c", code]
    environment = {**os.environ, "PYTHONPATH": str(tmp_path / platform.machine())}
    ran = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    # An exception has its kind, whichever module was loaded first.
    assert ran.stderr.splitlines()[-1] == "ValueError: all arrays must have a row for each point"
    assert ran.stdout.count(str(tmp_path)) == 2
    assert ran.stdout.endswith("True\n")


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
