"""Which state of the sources runs, for what it makes: weights, and pages of benchmarks."""

import json
import subprocess
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

UNKNOWN = "unknown"


def current_commit() -> str:
    """The commit of the checkout, or of the repository that pip installed from; 'unknown' where neither is known."""
    return checked_out_commit() or _installed_commit() or UNKNOWN


def checked_out_commit() -> str | None:
    """That of the checkout in which this file is a part; None where it is in none."""
    try:
        # An installed package may lie inside of another repository.
        git("ls-files", "--error-unmatch", Path(__file__).name)
        return git("rev-parse", "HEAD")
    except (OSError, subprocess.CalledProcessError):
        return None


def _installed_commit() -> str | None:
    """What pip has noted of an installation from a repository (PEP 610)."""
    try:
        noted = json.loads(distribution("sigmaslam").read_text("direct_url.json") or "{}")
    except PackageNotFoundError:
        return None
    commit = noted.get("vcs_info", {}).get("commit_id")
    return None if commit is None else str(commit)


def git(*arguments: str) -> str:
    """What git says in the folder of this file."""
    folder = Path(__file__).resolve().parent
    return subprocess.run(["git", *arguments], cwd=folder, capture_output=True, text=True, check=True).stdout.strip()
