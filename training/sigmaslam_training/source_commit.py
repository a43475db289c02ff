"""Which state of the sources runs, for what it makes: weights and pages."""

import json
import subprocess
from functools import cache
from importlib.metadata import PackageNotFoundError, distribution, version
from pathlib import Path

UNKNOWN = "unknown"


def current_commit() -> str:
    """The commit of the checkout, or of the repository that pip installed from; 'unknown' where neither is known."""
    return _checked_out_commit() or _installed_commit() or UNKNOWN


@cache
def describe_source() -> str:
    """The commit and whether code has changed since, or the version: 'at commit 1a2b3c4', 'of version 0.1.0'.

    It stays what it was when it was first asked for: ask before a run that takes long.
    """
    commit = current_commit()
    if commit == UNKNOWN:
        return f"of version {version('sigmaslam')}"
    changed = _checked_out_commit() and _git("status", "--porcelain", "--untracked-files=no", "--", ":/", *_NO_PAGES)
    return f"at commit {commit[:7]}" + (" with uncommitted changes" if changed else "")


# A page is changed by making the one before it.
_NO_PAGES = (":(top,exclude)docs", ":(top,exclude)*.md")


def _checked_out_commit() -> str | None:
    try:
        # An installed package may lie inside of another repository.
        _git("ls-files", "--error-unmatch", Path(__file__).name)
        return _git("rev-parse", "HEAD")
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


def _git(*arguments: str) -> str:
    """What git says in the folder of this file."""
    folder = Path(__file__).resolve().parent
    return subprocess.run(["git", *arguments], cwd=folder, capture_output=True, text=True, check=True).stdout.strip()
