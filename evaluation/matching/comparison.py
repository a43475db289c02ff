"""Everyone on every set, side by side."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path

from sigmaslam.errors import FrameError, InputError
from sigmaslam.evaluation.matching.extractors import load_extractor
from sigmaslam.evaluation.matching.pairs import ImagePair
from sigmaslam.evaluation.matching.run import Scores, score_pairs, score_refined
from sigmaslam.evaluation.matching.sets import ALL, REFINED, STEPS, TRACKS, load_set, load_steps, load_tracks
from sigmaslam.evaluation.matching.stereo import score_steps
from sigmaslam.evaluation.matching.tracks import KLT, TRACKED_KEYPOINTS, score_klt
from sigmaslam.match import temperature_of


def compare(
    names: Sequence[str], sets: Sequence[str], data: Path, note: Callable[[str], None] = lambda text: None
) -> dict[str, Scores]:
    """Scores by name of the extractor, then by set; the set kitti_tracks adds a row for KLT, and the sets of
    `sets.REFINED` a second one for everyone with what `sigmaslam match` makes of the same features.

    A graph of fixed size that is too small for the images of a set is left out there, and `note` is told.

    Args:
        names: as `load_extractor` takes them.
        sets: of `sets.ALL`.
        data: folder of the real data sets.
        note: is told of progress.
    Raises:
        InputError: a name, a set or a file cannot be used; names of sets are checked before anything is scored.
    """
    unknown = [name for name in sets if name not in ALL]
    if unknown:
        raise InputError(f"there is no set '{unknown[0]}': choose among {', '.join(ALL)}")
    for name in names:
        load_extractor(name)
    results: dict[str, Scores] = {name: {} for name in names}
    for name in sets:
        score, count = _scorer(name, data)
        for label in (*names, KLT) if name == TRACKS else names:
            start = time.perf_counter()
            try:
                found = score(label)
            except FrameError as error:
                note(f"{name}: left out {label}: {error}")
                continue
            results.setdefault(label, {})[name] = found
            if name in REFINED:
                results.setdefault(f"{label} + sigmaslam match", {})[name] = _score_refined(label, name, data)
            note(f"{name}: {label}, {count} pairs in {time.perf_counter() - start:.1f} s")
    return results


def _scorer(name: str, data: Path) -> tuple[Callable[[str], dict[str, float]], int]:
    """What scores an extractor by name on a set, and the number of its pairs."""
    if name == STEPS:
        steps = load_steps(data)
        return lambda label: score_steps(load_extractor(label), steps), len(steps)
    if name == TRACKS:
        tracks = load_tracks(data)
        return lambda label: _score_tracks(label, tracks), len(tracks)
    pairs = load_set(name, data)
    return lambda label: score_pairs(load_extractor(label), pairs), len(pairs)


def _score_refined(label: str, name: str, data: Path) -> dict[str, float]:
    extractor, temperature = load_extractor(label), temperature_of(label)
    if name == STEPS:
        return score_steps(extractor, load_steps(data), temperature)
    return score_refined(extractor, load_set(name, data), temperature)


def _score_tracks(label: str, tracks: Sequence[ImagePair]) -> dict[str, float]:
    if label == KLT:
        return score_klt(tracks)
    return score_pairs(load_extractor(label, TRACKED_KEYPOINTS), tracks, TRACKED_KEYPOINTS)
