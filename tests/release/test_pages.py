"""The commands on the pages run as they stand there, from an installed wheel, outside the checkout."""

import os
import re
import shutil
import site
import subprocess
import sys
from pathlib import Path

import pytest

from release.build_dist import build_dist
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
    "sigmaslam train --": "half an hour and more",
    "sigmaslam train scorer": "half an hour",
    "sigmaslam train export": "needs what `train` makes",
    "sigmaslam benchmark": "an hour and more",
    "sigmaslam track FOLDER --out run --start 100": "the stand-in has ten pairs",
    "sigmaslam train render street --seeds": "ten drives",
    "sigmaslam train render street --out drives": "ten drives",
    "sigmaslam calibrate IMAGES --board charuco": "the stand-in is a chessboard",
    "sigmaslam calibrate IMAGES --board aprilgrid": "the stand-in is a chessboard",
    "sigmaslam calibrate mav0": "the stand-in has no inertial sensor",
    "sigmaslam calibrate run --imu": "the stand-in has no inertial sensor",
    "sigmaslam localize MRCLAM_Dataset6": "a recording of others",
    "sigmaslam localize dataset": "a recording of others",
    "sigmaslam map reconstruct run --out cloud.ply --mesh": "needs the extra `mesh`",
    "sigmaslam map reconstruct run --out cloud.ply --network": "needs a network of the user's",
}


def commands(page: Path) -> list[str]:
    """Every command in a block without a language, in their order."""
    blocks = re.findall(r"^```(\w*)\n(.*?)^```$", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    lines = [
        line.partition("  #")[0].strip()
        for language, content in blocks
        if not language
        for line in content.splitlines()
    ]
    return [line for line in lines if line.startswith("sigmaslam ")]


def test_the_pages_have_commands():
    lines = [line for page in PAGES for line in commands(page)]
    assert len(lines) > 30
    assert all(any(line.startswith(start) for line in lines) for start in NOT_RUN)


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Environment in which `sigmaslam` is the wheel of the last commit, beside what is installed here."""
    folder = tmp_path_factory.mktemp("installed")
    wheel = next(
        path
        for path in build_dist(folder / "dist", [sys.executable])
        if "none-any" not in path.name and path.suffix == ".whl"
    )
    venv = folder / "venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(venv)], check=True)
    pip = [sys.executable, "-m", "pip", "--python", str(venv), "install", "--quiet", "--no-deps", "--no-index"]
    subprocess.run([*pip, str(wheel)], check=True)
    packages = next(venv.glob("lib/python*/site-packages"))
    # A folder that a .pth file names is searched last, and .pth files in it, of an editable installation, are not read.
    # The benchmarks are in no wheel: their commands run from the checkout.
    (packages / "others.pth").write_text("\n".join([*site.getsitepackages(), str(ROOT / "evaluation")]))
    environment = {**os.environ, "PATH": f"{venv / 'bin'}{os.pathsep}{os.environ['PATH']}"}
    environment.pop("PYTHONPATH", None)
    return environment


@pytest.fixture(scope="module")
def stand_ins(installed: dict[str, str], demo_sequence: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Stand-ins for what the commands read, and a run."""
    folder = tmp_path_factory.mktemp("empty")
    write_stand_ins(demo_sequence, folder)
    shutil.copy(folder / CALIBRATION, folder / "kept.yaml")
    subprocess.run("sigmaslam track FOLDER --out tracked --tracks", shell=True, check=True, cwd=folder, env=installed)
    shutil.copytree(folder / "tracked", folder / "run")
    return folder


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("page", [page for page in PAGES if commands(page)], ids=lambda page: page.stem)
def test_commands_of_a_page_run_as_they_stand(installed: dict[str, str], stand_ins: Path, tmp_path: Path, page: Path):
    """One after another: what one command writes is there for the next."""
    folder = tmp_path / "empty"
    shutil.copytree(stand_ins, folder, symlinks=True)
    for command in commands(page):
        if command.startswith(tuple(NOT_RUN)):
            continue
        # Lines that write the same folder are alternatives; a map is read from a run with the same front-end.
        for out in re.findall(r"--out (\S+)", command):
            shutil.rmtree(folder / out, ignore_errors=True)
        (folder / CALIBRATION).unlink(missing_ok=True)
        if not re.search(rf"(--out|convert \S+) {CALIBRATION}", command):
            shutil.copy(folder / "kept.yaml", folder / CALIBRATION)
        if "run/map.npz" in command:
            shutil.rmtree(folder / "run", ignore_errors=True)
            shutil.copytree(folder / "tracked", folder / "run")
        done = subprocess.run(
            command, shell=True, cwd=folder, env=installed, capture_output=True, text=True, check=False, timeout=3600
        )
        assert done.returncode == 0, f"{page.name}: {command}\n{done.stdout}\n{done.stderr}"
