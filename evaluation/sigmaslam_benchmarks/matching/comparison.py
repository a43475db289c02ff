"""Everyone on every set, side by side."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path

from sigmaslam.errors import FrameError
from sigmaslam_benchmarks.matching.extractors import Extractor, load_extractor, remembering
from sigmaslam_benchmarks.matching.image_pairs import ImagePair
from sigmaslam_benchmarks.matching.klt_tracks import KLT, TRACKED_KEYPOINTS, score_klt
from sigmaslam_benchmarks.matching.score_sets import Scores, score_pairs, score_refined
from sigmaslam_benchmarks.matching.sets import REFINED, STEPS, TRACKS, check_sets, load_set, load_steps, load_tracks
from sigmaslam_benchmarks.matching.stereo import score_steps
from sigmaslam_models.model_card import REFINED_NAME


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
    Raises:
        InputError: a name, a set or a file cannot be used; that sets are there is checked before anything is scored.
    """
    check_sets(sets, data)
    extractors = {name: load_extractor(name) for name in names}
    results: dict[str, Scores] = {name: {} for name in names}
    for name in sets:
        if name == TRACKS:
            _compare_tracks(results, load_tracks(data), names, note)
            continue
        score, count = _scorer(name, data)
        for label, extractor in extractors.items():
            start = time.perf_counter()
            features = remembering(extractor)
            try:
                results[label][name] = score(features, False)
                if name in REFINED:
                    refined = results.setdefault(label + REFINED_NAME, {})
                    refined[name] = score(features, True)
            except FrameError as error:
                note(f"{name}: left out {label}: {error}")
                continue
            note(f"{name}: {label}, {count} pairs in {time.perf_counter() - start:.1f} s")
    return results


def _scorer(name: str, data: Path) -> tuple[Callable[[Extractor, bool], dict[str, float]], int]:
    """What scores an extractor on a set, perhaps by the matches of `sigmaslam match`; the number of its pairs."""
    if name == STEPS:
        steps = load_steps(data)
        return lambda extractor, judged: score_steps(extractor, steps, judged), len(steps)
    pairs = load_set(name, data)

    def score(extractor: Extractor, judged: bool) -> dict[str, float]:
        return score_refined(extractor, pairs) if judged else score_pairs(extractor, pairs)

    return score, len(pairs)


def _compare_tracks(
    results: dict[str, Scores], tracks: Sequence[ImagePair], names: Sequence[str], note: Callable[[str], None]
) -> None:
    for label in (*names, KLT):
        start = time.perf_counter()
        try:
            scores = _score_tracks(label, tracks)
        except FrameError as error:
            note(f"{TRACKS}: left out {label}: {error}")
            continue
        results.setdefault(label, {})[TRACKS] = scores
        note(f"{TRACKS}: {label}, {len(tracks)} pairs in {time.perf_counter() - start:.1f} s")


def _score_tracks(label: str, tracks: Sequence[ImagePair]) -> dict[str, float]:
    if label == KLT:
        return score_klt(tracks)
    return score_pairs(load_extractor(label, TRACKED_KEYPOINTS), tracks, TRACKED_KEYPOINTS)
