"""A world of one's own: a Python file with a function `generate`, as every module of this folder has one."""

import importlib.util
import sys
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np

from sigmaslam.errors import InputError
from sigmaslam_synthetic.rendering.renderer import Renderer
from sigmaslam_synthetic.worlds.episode import Episode, Wish

Generate = Callable[[np.random.Generator, Wish], Episode]
"""Makes a random world as wished for; the same state of the generator gives the same world."""

SUFFIX = ".py"
_EXAMPLE = "see examples/my_world.py"


@lru_cache(maxsize=8)
def load_world(path: str) -> Generate:
    """The function `generate(rng, wish)` of a Python file, which is run.

    Raises:
        InputError: there is no such file, it fails, or it has no such function.
    """
    file = Path(path)
    if not file.is_file() or file.suffix != SUFFIX:
        raise InputError(f"{path}: is no Python file: give one with a function generate(rng, wish), {_EXAMPLE}")
    name = f"sigmaslam_world_{file.stem}"
    spec = importlib.util.spec_from_file_location(name, file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # Dataclasses of the file look their module up.
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except Exception as error:  # whatever the user's code raises
        raise InputError(f"{path}: cannot be run ({type(error).__name__}: {error}): mend it, {_EXAMPLE}") from error
    generate = getattr(module, "generate", None)
    if not callable(generate):
        raise InputError(f"{path}: has no function generate(rng, wish) that makes an Episode: add it, {_EXAMPLE}")
    return generate


@lru_cache(maxsize=8)
def check_world(path: str) -> None:
    """Makes one world by a file, before long work relies on it.

    Raises:
        InputError: as of `load_world`, or the world cannot be made, or is none.
    """
    generate = load_world(path)
    try:
        episode = generate(np.random.default_rng(0), Wish(duration=2.0))
        if isinstance(episode, Episode):
            Renderer(episode.scene)
    except Exception as error:  # whatever the user's code raises
        raise InputError(
            f"{path}: generate(rng, wish) or its rendering fails ({type(error).__name__}: {error}): mend it, {_EXAMPLE}"
        ) from error
    if not isinstance(episode, Episode):
        raise InputError(f"{path}: generate(rng, wish) returns {type(episode).__name__}, not an Episode, {_EXAMPLE}")
