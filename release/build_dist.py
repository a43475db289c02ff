"""Build what is handed out: the sdist, a wheel without kernels, and a wheel with kernels for each Python.

    python release/build_dist.py OUT [PYTHON ...] [--many-linux]

The same commit gives the same bytes in any folder: sources come from `git archive HEAD`, tools from requirements.lock,
times from the commit (or SOURCE_DATE_EPOCH), and archives are sorted and name no user. The compiler is that of the
machine: kernels are the same where it is. With --many-linux it is that of the package index's `ziglang`, for x86-64
and aarch64 and glibc 2.28 (manylinux_2_28), whatever the machine; `auditwheel` agrees that they need nothing newer.
"""

import argparse
import gzip
import hashlib
import io
import os
import re
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TOOLS = ("build", "setuptools", "pybind11")
CROSS_TOOLS = ("ziglang", "wheel", "auditwheel")
MANY_LINUX, GLIBC = ("x86_64", "aarch64"), "2.28"
COMPILED = (
    *("sigmaslam/frontend/_kernels.", "sigmaslam/estimation/_estimator."),
    "sigmaslam/reconstruction/_depths.",
)
WITHOUT_KERNELS = (
    "what the compiler said stands above; if there is none, apt install g++; if it lacks Python's headers, name an "
    "interpreter that has them, for --many-linux not Debian's, whose pyconfig.h is of one machine"
)


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("out", type=Path, help="folder for the archives and their SHA256SUMS")
    parser.add_argument("pythons", nargs="*", default=[sys.executable], help="interpreters to compile kernels for")
    parser.add_argument("--many-linux", action="store_true", help=f"wheels for {' and '.join(MANY_LINUX)}, glibc 2.28")
    arguments = parser.parse_args()
    try:
        for path in build_dist(arguments.out, arguments.pythons, arguments.many_linux):
            print(path)
    except (RuntimeError, subprocess.CalledProcessError) as error:
        sys.exit(f"error: {error}")


def build_dist(out: Path, pythons: list[str], many_linux: bool = False) -> list[Path]:
    """Build all archives; the first Python makes the sdist and the wheel without kernels.

    Args:
        out: folder for them.
        pythons: interpreters to compile for.
        many_linux: compile for the machines of `MANY_LINUX` in place of this one.

    Returns:
        The archives, and SHA256SUMS.
    Raises:
        RuntimeError: a wheel has no kernels, because there is no C++ compiler.
        subprocess.CalledProcessError: a tool failed, which has said why.
    """
    out.mkdir(parents=True, exist_ok=True)
    os.umask(0o022)  # modes of files go into the archives
    epoch = os.environ.get("SOURCE_DATE_EPOCH") or _git("log", "-1", "--format=%ct").decode().strip()
    environment = {**os.environ, "SOURCE_DATE_EPOCH": epoch, "PYTHONHASHSEED": "0"}
    environment.pop("PYTHONPATH", None)
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        # The first compiles for all: zig would make its C++ library anew for each place that it lies in.
        tools = [TOOLS + CROSS_TOOLS * many_linux, *[TOOLS] * (len(pythons) - 1)]
        builders = [_install_tools(each, work / f"tools{i}", tools[i]) for i, each in enumerate(pythons)]
        machines = MANY_LINUX if many_linux else ("",)
        _unpack(_git("archive", "--format=tar", "HEAD"), work / "commit")
        raw = _build(builders[0], "sdist", work / "commit", work / "raw", environment)
        sdist = out / raw.name
        sdist.write_bytes(normalise_tar(raw.read_bytes(), int(epoch)))
        archives = [sdist]
        wheels = [(builders[0], ""), *((builder, machine) for builder in builders for machine in machines)]
        for number, (builder, machine) in enumerate(wheels):
            _unpack(gzip.decompress(sdist.read_bytes()), work / f"sources{number}")
            sources = work / f"sources{number}" / sdist.name.removesuffix(".tar.gz")
            if number == 0:
                (sources / "setup.py").unlink()  # which holds the kernels alone
            settings = environment | (_cross_settings(builders[0], builder, machine, work / "zig") if machine else {})
            wheel = _build(builder, "wheel", sources, out, settings)
            if machine:
                wheel = as_many_linux(builders[0], wheel, machine, settings)
            with zipfile.ZipFile(wheel) as content:
                compiled = [each for each in content.namelist() if each.startswith(COMPILED)]
            if len(compiled) != (len(COMPILED) if number > 0 else 0):
                raise RuntimeError(f"{wheel} holds no compiled kernels: {WITHOUT_KERNELS}")
            archives.append(wheel)
    sums = out / "SHA256SUMS"
    lines = sorted(f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.name}\n" for path in archives)
    sums.write_text("".join(lines), encoding="utf-8")
    return [*archives, sums]


def normalise_tar(archive: bytes, seconds: int) -> bytes:
    """The same files as a .tar.gz that depends on their names, contents and rights to be run alone.

    Args:
        archive: a .tar.gz.
        seconds: since 1970, the time of every file.
    """
    written = io.BytesIO()
    with (
        tarfile.open(fileobj=io.BytesIO(archive), mode="r:gz") as source,
        tarfile.open(fileobj=written, mode="w", format=tarfile.PAX_FORMAT) as target,
    ):
        for member in sorted(source.getmembers(), key=lambda each: each.name):
            plain = tarfile.TarInfo(member.name)
            plain.type, plain.linkname = member.type, member.linkname
            plain.size, plain.mtime = member.size, seconds
            plain.mode = 0o755 if member.isdir() or member.mode & 0o100 else 0o644
            target.addfile(plain, source.extractfile(member) if member.isfile() else None)
    return gzip.compress(written.getvalue(), mtime=seconds)


def as_many_linux(builder: Path, wheel: Path, machine: str, environment: dict[str, str]) -> Path:
    """The wheel by the name of the systems that it runs on, which `auditwheel` confirms.

    Args:
        builder: an interpreter with `CROSS_TOOLS`.
        wheel: by the name of a machine alone, which it loses.
        machine: that machine.
        environment: for the tools.
    Returns:
        Its new path.
    Raises:
        RuntimeError: it needs a newer glibc, or a library that such systems may lack.
    """
    tag = f"manylinux_{GLIBC.replace('.', '_')}_{machine}"
    _run(builder, "-m", "wheel", "tags", "--remove", "--platform-tag", tag, wheel, environment=environment)
    named = wheel.with_name(wheel.name.replace(f"linux_{machine}", tag))
    shown = subprocess.run([builder, "-m", "auditwheel", "show", named], capture_output=True, text=True, check=True)
    # The oldest systems that it runs on.
    oldest = re.search(r'tag:\s+"manylinux_2_(\d+)_', shown.stdout)
    if oldest is None or int(oldest[1]) > int(GLIBC.removeprefix("2.")):
        raise RuntimeError(f"{named} does not run on all systems of {tag}: {shown.stdout}")
    return named


def _cross_settings(zig: Path, builder: Path, machine: str, cache: Path) -> dict[str, str]:
    """The environment in which `builder` compiles for another machine by the zig that interpreter `zig` has.

    Libraries that zig builds stay in `cache`.
    """
    compiler = f"{zig} -m ziglang {{}} -target {machine}-linux-gnu.{GLIBC}"
    show_abi = [builder, "-c", "import sys; print(sys.implementation.cache_tag)"]
    abi = subprocess.run(show_abi, capture_output=True, text=True, check=True)
    return {
        "CC": compiler.format("cc"),
        "CXX": compiler.format("c++"),
        "LDSHARED": f"{compiler.format('c++')} -shared -s",
        "LDCXXSHARED": f"{compiler.format('c++')} -shared -s",
        "SETUPTOOLS_EXT_SUFFIX": f".{abi.stdout.strip()}-{machine}-linux-gnu.so",
        "_PYTHON_HOST_PLATFORM": f"linux-{machine}",
        "ZIG_GLOBAL_CACHE_DIR": os.environ.get("ZIG_GLOBAL_CACHE_DIR", str(cache)),
    }


def _install_tools(python: str, folder: Path, tools: tuple[str, ...]) -> Path:
    """An environment of that Python with the tools of requirements.lock; its interpreter."""
    _run(python, "-m", "venv", folder)
    interpreter = folder / "bin" / "python"
    lock = ROOT / "requirements.lock"
    _run(interpreter, "-m", "pip", "install", "--quiet", "--constraint", lock, *tools)
    return interpreter


def _build(builder: Path, kind: str, sources: Path, out: Path, environment: dict[str, str]) -> Path:
    """One archive, built without isolation as the tools are pinned; its path in `out`."""
    with tempfile.TemporaryDirectory(dir=sources.parent) as fresh:
        _run(builder, "-m", "build", "--no-isolation", f"--{kind}", "--outdir", fresh, sources, environment=environment)
        (made,) = Path(fresh).iterdir()
        out.mkdir(exist_ok=True)
        target = out / made.name
        target.write_bytes(made.read_bytes())
    return target


def _unpack(archive: bytes, folder: Path) -> None:
    with tarfile.open(fileobj=io.BytesIO(archive), mode="r:") as source:
        # Python before 3.11.4 has no filters.
        source.extraction_filter = getattr(tarfile, "tar_filter", None)
        source.extractall(folder)


def _git(*arguments: str) -> bytes:
    """What git prints about this repository."""
    return subprocess.run(["git", "-C", str(ROOT), *arguments], stdout=subprocess.PIPE, check=True).stdout


def _run(*command: str | Path, environment: dict[str, str] | None = None) -> None:
    """Runs a tool; only its errors are shown."""
    subprocess.run([*map(str, command)], env=environment, stdout=subprocess.DEVNULL, check=True)


if __name__ == "__main__":
    main()
