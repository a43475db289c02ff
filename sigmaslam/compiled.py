"""Modules that are compiled where a compiler was at hand, and have slower twins."""

import logging
from functools import cache
from importlib import import_module
from types import ModuleType

_LOGGER = logging.getLogger(__name__)


def open_compiled(name: str) -> ModuleType | None:
    """A compiled module by its name in the package; None where that was installed without a compiler."""
    try:
        return import_module(f"sigmaslam.{name}")
    except ImportError:
        return None


@cache
def tell_slow(what: str) -> None:
    """Says once what takes longer than it would compiled."""
    _LOGGER.warning(
        "%s: install the wheel of this Python and platform, or a C++ compiler (for poses without AVX2: clang) and then "
        "sigmaslam from its sources",
        what,
    )
