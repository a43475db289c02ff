"""Optional parts of the package: what a command says when one is not installed, and the option of Ray."""

from importlib import import_module
from typing import Annotated

import typer

from sigmaslam.errors import InputError

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

# By extra: what its commands cannot do without, and where it comes from.
_EXTRAS = {
    "train": (("torch", "kornia"), "pip install 'sigmaslam[train]'"),
    "viewer": (("rerun",), "pip install 'sigmaslam[viewer]'"),
    "report": (("matplotlib",), "pip install 'sigmaslam[report]'"),
}


def need_extra(extra: str, *packages: str) -> None:
    """Refuses a command where an extra is not installed; where packages are given, it needs these of it alone."""
    all_packages, mend = _EXTRAS[extra]
    for name in packages or all_packages:
        try:
            import_module(name)
        except ImportError as error:
            raise InputError(f"{error.name} is not installed: {mend}") from error
