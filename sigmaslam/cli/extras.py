"""Optional parts of the package: what a command says when one is not installed, and the option of Ray."""

from typing import Annotated

import typer

from sigmaslam.errors import InputError
from sigmaslam.plot_style import NO_MATPLOTLIB, has_matplotlib

RayAddress = Annotated[
    str | None,
    typer.Option(
        "--ray",
        metavar="ADDRESS",
        help="Work on the Ray cluster at HOST:PORT, on the one that this machine is in ('auto'), or on a Ray that is "
        "started here ('local'); extra 'scale'.",
        show_default="processes of this machine",
    ),
]


def need_train_extra() -> None:
    """Refuses a command of the extra `train` where torch or kornia is missing."""
    need_torch()
    try:
        import kornia  # noqa: F401
    except ImportError as error:
        raise InputError(f"{error.name} is not installed: pip install 'sigmaslam[train]'") from error


def need_torch() -> None:
    """Refuses a command of the filters where torch is missing; nothing else of the extra `train` is needed."""
    try:
        import torch  # noqa: F401
    except ImportError as error:
        raise InputError("torch is not installed: pip install torch, or 'sigmaslam[train]'") from error


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
