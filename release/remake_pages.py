"""Remake the pages that commands make, each by the command that it names: hours for all of them.

    python release/remake_pages.py [PAGE ...] [--ages]

A page whose data or peers are absent would lose rows: it is skipped, and said so. Renders go to build/results and are
used again. Records of commands that are gone, or of work by hand, name no command and stay. --ages makes nothing: it
tells how old the pages are, and how much of the code that they measure has changed since.
"""

import argparse
import itertools
import os
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from importlib.util import find_spec
from pathlib import Path

from sigmaslam_benchmarks.code_hash import code_files
from sigmaslam_benchmarks.commands import BENCHMARKS, reads_data

ROOT = Path(__file__).resolve().parents[1]
RENDERS = "build/results"
# Modules beside which a benchmark measures.
PEERS = {
    "filters": ("filterpy", "stonesoup", "dynamax", "pypose", "torch_kf"),
    "geometry": ("poselib", "pycolmap"),
    "runtime": ("dim_odom", "pyorbslam3"),
    "sequences": ("dim_odom", "pyorbslam3"),
}


def main() -> None:
    """Entry point; exit code 1 if a command failed."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("pages", nargs="*", type=Path, help="all by default")
    parser.add_argument("--ages", action="store_true", help="tell how old the pages are, and make none")
    arguments = parser.parse_args()
    chosen = [page.resolve() for page in arguments.pages] or sorted((ROOT / "docs").rglob("*.md"))
    if arguments.ages:
        print(*(describe_age(page) for page in chosen if command_of(page)), sep="\n")
        return
    failed = remake(chosen, lambda words: subprocess.run(words, cwd=ROOT, check=False).returncode)
    sys.exit(f"failed: {', '.join(failed)}" if failed else 0)


def remake(pages: Iterable[Path], run: Callable[[list[str]], int]) -> list[str]:
    """Runs the command of each page that has one.

    Args:
        pages: Markdown files.
        run: runs the words of a command and returns its exit code.
    Returns:
        Names of the pages whose command failed.
    """
    failed = []
    for page in pages:
        words = command_of(page)
        if not words:
            continue
        name = page.relative_to(ROOT).as_posix() if page.is_relative_to(ROOT) else str(page)
        reason = absent(words)
        print(f"{name}: " + (f"skipped, {reason}" if reason else shlex.join(words)), flush=True)
        if not reason and run(runnable(words)):
            failed.append(name)
    return failed


def command_of(page: Path) -> list[str]:
    """Words of the command that a page was made by; none if it names none."""
    found = re.search(r"^Made by `([^`]+)`", page.read_text(encoding="utf-8"), re.MULTILINE)
    return shlex.split(found[1]) if found else []


def describe_age(page: Path, root: Path = ROOT) -> str:
    """When a page was made, and how many files that its figures depend on have changed since.

    Args:
        page: Markdown of the repository `root`, made by a command.
    """
    commit, name = _commit_of(page, root), page.relative_to(root).as_posix()
    try:
        days = (time.time() - int(_git(root, "show", "--no-patch", "--format=%ct", commit))) / 86400
        changed = set(_git(root, "diff", "--name-only", commit).splitlines())
    except subprocess.CalledProcessError:
        return f"{name}: of commit {commit}, which is not in this history"
    measured = {path.relative_to(root).as_posix() for path in _measured(command_of(page), root)}
    stale = len(changed & measured)
    return f"{name}: commit {commit}, {days:.0f} days, {stale} of {len(measured)} files that it measures changed since"


def days_behind(page: Path, root: Path = ROOT) -> float:
    """How many days passed from the commit that a page was made at to the last change of what it measures."""
    made = _commit_of(page, root)
    files = map(str, _measured(command_of(page), root))
    changed = _git(root, "log", "-1", "--format=%ct", f"{made}..", "--", *files)
    return (int(changed) - int(_git(root, "show", "--no-patch", "--format=%ct", made))) / 86400 if changed else 0.0


def _commit_of(page: Path, root: Path) -> str:
    """The one that a page says it was made at, else the one that last changed it."""
    named = re.search(r"\bat commit ([0-9a-f]{7,})", page.read_text(encoding="utf-8"))
    return named[1] if named else _git(root, "log", "-1", "--format=%h", "--", str(page))


def _measured(words: list[str], root: Path) -> list[Path]:
    """Files that the figures of a command depend on; without a benchmark all of our Python."""
    if words[2] not in BENCHMARKS:
        return [path for path in root.glob("*/**/*.py") if not path.is_relative_to(root / "tests")]
    return code_files(ROOT / f"evaluation/sigmaslam_benchmarks/{BENCHMARKS[words[2]].module.replace('.', '/')}.py")


def _git(root: Path, *arguments: str) -> str:
    return subprocess.run(["git", "-C", root, *arguments], capture_output=True, text=True, check=True).stdout.strip()


def absent(words: list[str]) -> str:
    """What the command of a page lacks here; empty if nothing."""
    # `sigmaslam benchmark NAME ...`, `python -m NAME ...`
    name = words[2]
    data = Path(os.environ.get("SIGMASLAM_DATA") or "/nowhere")
    if (reads_data(name) or name == "tests.faults") and not data.is_dir():
        return "SIGMASLAM_DATA names no folder of the real data sets"
    for option, graph in itertools.pairwise(words):
        if option == "--peer" and not Path(graph).is_file():
            return f"{graph} is missing: make it by python -m sigmaslam_benchmarks.matching.peer_exports"
    peers = PEERS.get(name, ())
    modules = [module for module in peers if find_spec(module) is None]
    if modules:
        return f"{', '.join(modules)} not installed: pip install 'sigmaslam[peers]'"
    if "pyorbslam3" in peers and not Path(os.environ.get("PYORBSLAM3_VOCAB") or "/nowhere").is_file():
        return (
            "PYORBSLAM3_VOCAB names no vocabulary of ORB-SLAM3: make one by "
            "python -m sigmaslam_benchmarks.tracking.orb_vocabulary"
        )
    return ""


def runnable(words: list[str]) -> list[str]:
    """The command with this interpreter, its renders in a folder that git does not see."""
    program = {"sigmaslam": [sys.executable, "-m", "sigmaslam"], "python": [sys.executable]}[words[0]]
    rest = (f"{RENDERS}/{word}" if before == "--runs" else word for before, word in itertools.pairwise(words))
    return [*program, *rest]


if __name__ == "__main__":
    main()
