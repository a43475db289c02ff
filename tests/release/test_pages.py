"""The commands on the pages run as they stand there, from an installed wheel, outside the checkout.

Renders are of a few frames. Each block of a page is a test, a long one several.
"""

import os
import re
import shutil
import site
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.stand_ins import write_stand_ins

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
# Its commands build on each other: tests/training/test_own_scene_page.py runs them in their order.
PAGES.remove(ROOT / "docs" / "matching.md")
# What some commands write and others read.
CALIBRATION = "stereo.yaml"
# What is not run, by how it begins, and why.
NOT_RUN = {
    "sigmaslam track --camera": "needs cameras",
    "sigmaslam benchmark": "an hour and more",
    "sigmaslam track FOLDER --out run --resume": "the stand-in is complete",
    "sigmaslam track FOLDER --out run --start 100": "the stand-in has eight pairs",
    "sigmaslam train render street --seeds": "ten drives",
    "sigmaslam calibrate IMAGES --board charuco": "the stand-in is a chessboard",
    "sigmaslam calibrate IMAGES --board aprilgrid": "the stand-in is a chessboard",
    "sigmaslam calibrate mav0": "the stand-in has no inertial sensor",
    "sigmaslam calibrate run --imu": "the stand-in has no inertial sensor",
    "sigmaslam localize MRCLAM_Dataset6": "a recording of others",
    "sigmaslam localize dataset": "a recording of others",
    "sigmaslam map reconstruct run --out cloud.ply --mesh": "needs the extra `mesh`",
    "sigmaslam map reconstruct run --out cloud.ply --network": "needs a network of the user's",
}
# What is added to commands, by how they begin; of options that are given twice the last one counts.
SMALL = {
    "sigmaslam train render tool": "--frames 12",
    "sigmaslam train render": "--frames 4",
    # The stand-in is a room, of which points are known to 8 cm at best.
    "sigmaslam map reconstruct run --out cloud.ply --max-sigma 0.002": "--max-sigma 0.2",
}
# Commands of one block that are one test.
TOGETHER = 4


def blocks(page: Path) -> list[list[str]]:
    """The commands of each block without a language, in their order."""
    found = re.findall(r"^```(\w*)\n(.*?)^```$", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    contents = [content for language, content in found if not language]
    lines = [[line.partition("  #")[0].strip() for line in content.splitlines()] for content in contents]
    return [[line for line in block if line.startswith("sigmaslam ")] for block in lines]


def parts() -> dict[str, list[str]]:
    """What is run in one folder, by page, number of the block and of its first command."""
    found = {}
    for page in PAGES:
        for number, block in enumerate(blocks(page), start=1):
            run = [command for command in block if not command.startswith(tuple(NOT_RUN))]
            for start in range(0, len(run), TOGETHER):
                found[f"{page.stem}-{number}-{start + 1}"] = run[start : start + TOGETHER]
    return found


def test_each_command_is_run_or_it_is_said_why_not():
    lines = [line for page in PAGES for block in blocks(page) for line in block]
    assert len(lines) > 30
    assert all(any(line.startswith(start) for line in lines) for start in [*NOT_RUN, *SMALL])
    run = [command for commands in parts().values() for command in commands]
    assert run == [line for line in lines if not line.startswith(tuple(NOT_RUN))]


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Environment in which `sigmaslam` is a wheel of the last commit, beside what is installed here.

    With the modules that were compiled for the checkout: a minute less; test_build_dist.py compiles them in wheels.
    """
    folder = tmp_path_factory.mktemp("installed")
    sources = folder / "sources"
    subprocess.run(["git", "clone", "--quiet", "--depth", "1", ROOT.as_uri(), str(sources)], check=True)
    (sources / "setup.py").unlink()
    make = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", str(folder), str(sources)]
    subprocess.run(make, check=True)
    (wheel,) = folder.glob("*.whl")
    venv = folder / "venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(venv)], check=True)
    pip = [sys.executable, "-m", "pip", "--python", str(venv), "install", "--quiet", "--no-deps", "--no-index"]
    subprocess.run([*pip, str(wheel)], check=True)
    packages = next(venv.glob("lib/python*/site-packages"))
    for module in (ROOT / "sigmaslam").rglob("*.so"):
        shutil.copy(module, packages / module.relative_to(ROOT))
    # A folder that a .pth file names is searched last, and .pth files in it, of an editable installation, are not read.
    # The benchmarks are in no wheel: their commands run from the checkout.
    (packages / "others.pth").write_text("\n".join([*site.getsitepackages(), str(ROOT / "evaluation")]))
    environment = {**os.environ, "PATH": f"{venv / 'bin'}{os.pathsep}{os.environ['PATH']}"}
    environment.pop("PYTHONPATH", None)
    return environment


@pytest.fixture(scope="module")
def stand_ins(installed: dict[str, str], demo_sequence: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Stand-ins for what the commands read, and two runs."""
    folder = tmp_path_factory.mktemp("empty")
    write_stand_ins(demo_sequence, folder)
    shutil.copy(folder / CALIBRATION, folder / "kept.yaml")
    subprocess.run("sigmaslam track FOLDER --out tracked --tracks", shell=True, check=True, cwd=folder, env=installed)
    for run in ("run", "again", "other_run"):
        shutil.copytree(folder / "tracked", folder / run)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("commands", parts().values(), ids=parts())
def test_commands_run_as_they_stand(installed: dict[str, str], stand_ins: Path, tmp_path: Path, commands: list[str]):
    """One after another: what one command writes is there for the next."""
    folder = tmp_path / "empty"
    shutil.copytree(stand_ins, folder, symlinks=True)
    for command in commands:
        # Lines that write the same folder are alternatives; a map is read from a run with the same front-end.
        for out in re.findall(r"--out (\S+)", command):
            shutil.rmtree(folder / out, ignore_errors=True)
        (folder / CALIBRATION).unlink(missing_ok=True)
        if not re.search(rf"(--out|convert \S+) {CALIBRATION}", command):
            shutil.copy(folder / "kept.yaml", folder / CALIBRATION)
        if "run/map.npz" in command:
            shutil.rmtree(folder / "run", ignore_errors=True)
            shutil.copytree(folder / "tracked", folder / "run")
        small = next((more for start, more in SMALL.items() if command.startswith(start)), "")
        done = subprocess.run(
            f"{command} {small}", shell=True, cwd=folder, env=installed, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
