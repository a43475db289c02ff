"""Which state of the sources makes a page, in words."""

from functools import cache
from importlib.metadata import version

from sigmaslam_training.source_commit import UNKNOWN, checked_out_commit, current_commit, git

# A page is changed by making the one before it.
_NO_PAGES = (":(top,exclude)docs", ":(top,exclude)*.md")


@cache
def describe_source() -> str:
    """The commit and whether code has changed since, or the version: 'at commit 1a2b3c4', 'of version 0.1.0'.

    It stays what it was when it was first asked for: ask before a run that takes long.
    """
    commit = current_commit()
    if commit == UNKNOWN:
        return f"of version {version('sigmaslam')}"
    changed = checked_out_commit() and git("status", "--porcelain", "--untracked-files=no", "--", ":/", *_NO_PAGES)
    return f"at commit {commit[:7]}" + (" with uncommitted changes" if changed else "")
