"""What a command says when an optional part of the package is not installed."""

from __future__ import annotations

from sigmaslam.errors import InputError
from sigmaslam.plot_style import NO_MATPLOTLIB, has_matplotlib


def need_train_extra() -> None:
    """Refuses a command of the extra `train` where torch or kornia is missing."""
    try:
        import kornia  # noqa: F401
        import torch  # noqa: F401
    except ImportError as error:
        raise InputError(f"{error.name} is not installed: pip install 'sigmaslam[train]'") from error


def need_viewer_extra() -> None:
    """Refuses a viewer where rerun is missing."""
    try:
        import rerun  # noqa: F401
    except ImportError as error:
        raise InputError("rerun is not installed: pip install 'sigmaslam[viewer]'") from error


def need_report_extra() -> None:
    """Refuses a command that only draws where matplotlib is missing."""
    if not has_matplotlib():
        raise InputError(NO_MATPLOTLIB)
