"""What training pairs come from, by name or file, and whose turn it is."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from sigmaslam.errors import InputError
from sigmaslam_synthetic.render_choices import PRESET_NAMES
from sigmaslam_synthetic.rendering.photograph_textures import photographs
from sigmaslam_synthetic.rendering.textures import KINDS
from sigmaslam_synthetic.worlds.own import SUFFIX, check_world
from sigmaslam_training.mixes import MIXES

WORLDS = PRESET_NAMES
"""Rendered 3D worlds, each of which is a source."""
SOURCES = (*WORLDS, *KINDS, "turned leaves", "patterns", "scenes", "endoscopy")
"""Names of sources; others are the path of a Python file that makes a world, or of a folder of photographs."""
Mix = str | Mapping[str, float]
"""A key of `mixes.MIXES`, or shares by source, which sum to 1."""
# Shares are hundredths.
_LAP = 100


def turns_of(mix: Mix) -> tuple[str, ...]:
    """The sources of a mix, in the order in which they take turns; each has its share of the lap.

    Raises:
        InputError: the mix is unknown, a share is out of range, or they do not sum to 1.
    """
    if isinstance(mix, str):
        if mix not in MIXES:
            raise InputError(f"data {mix!r} is unknown; choose one of {', '.join(MIXES)}")
        return MIXES[mix]
    counts = {source: round(_LAP * share) for source, share in sorted(mix.items())}
    if any(count < 1 for count in counts.values()) or abs(sum(mix.values()) - 1.0) > 1e-9 or not mix:
        raise InputError(
            f"--mix {','.join(f'{share:g}' for share in mix.values())} sums to {sum(mix.values()):g}: give each source "
            "a share of 0.01 or more, 1 together"
        )
    # Rounding may leave a lap that is a turn or two longer or shorter.
    common = math.gcd(*counts.values())
    lap = sum(counts.values()) // common
    places = [
        ((turn + 0.5) * lap / (count // common), source)
        for source, count in counts.items()
        for turn in range(count // common)
    ]
    return tuple(source for _, source in sorted(places))


def choose_shares(
    worlds: str | None, world: Path | None, textures: Path | None, mix: str | None
) -> dict[str, float] | None:
    """The shares that the command line asks for; None where it names no source.

    Args:
        worlds: names with commas between.
        world: Python file that makes a world.
        textures: folder of photographs.
        mix: shares with commas between, of the worlds, then the file, then the photographs; None: equal ones.
    Raises:
        InputError: a source is unknown or cannot be used, or the shares do not fit.
    """
    sources = [name.strip() for name in worlds.split(",")] if worlds is not None else []
    unknown = [name for name in sources if name not in SOURCES]
    if unknown:
        raise InputError(f"--worlds {unknown[0]!r} is unknown; choose among {', '.join(SOURCES)}")
    sources += [str(path.resolve()) for path in (world, textures) if path is not None]
    if world is not None and world.suffix != SUFFIX:
        raise InputError(f"--world {world} is no Python file: give one with a function generate(rng, wish)")
    if len(set(sources)) < len(sources):
        raise InputError(f"--worlds {worlds} names a source twice: give each once, and its share with --mix")
    if not sources:
        if mix is not None:
            raise InputError("--mix gives the shares of sources: name them with --worlds, --world or --textures")
        return None
    check_sources(sources)
    shares = dict(zip(sources, _read_shares(mix, sources), strict=True))
    turns_of(shares)
    return shares


def check_sources(sources: Sequence[str]) -> None:
    """Every source can be used.

    Raises:
        InputError: a name is unknown, a file makes no world, or a folder holds no photographs.
    """
    for source in sources:
        if source in SOURCES:
            continue
        if source.endswith(SUFFIX):
            check_world(source)
        else:
            photographs(source)


def label(source: str) -> str:
    """A source's name; of a path its last part, where it lies is nobody's business."""
    return source if source in SOURCES else Path(source).stem


def _read_shares(mix: str | None, sources: Sequence[str]) -> list[float]:
    names = ", ".join(label(source) for source in sources)
    if mix is None:
        # Hundredths as equal as can be.
        whole, rest = divmod(_LAP, len(sources))
        return [(whole + (k < rest)) / _LAP for k in range(len(sources))]
    try:
        shares = [float(share) for share in mix.split(",")]
    except ValueError:
        raise InputError(f"--mix {mix} is no list of numbers: give one for each of {names}, as 0.4,0.6") from None
    if len(shares) != len(sources):
        raise InputError(f"--mix {mix} has {len(shares)} shares: give {len(sources)}, for {names}")
    return shares
