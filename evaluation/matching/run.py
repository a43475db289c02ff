"""Scores of an extractor on the sets, and their table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from sigmaslam.evaluation.matching.extractors import MAX_KEYPOINTS, Extractor
from sigmaslam.evaluation.matching.pairs import ImagePair
from sigmaslam.evaluation.matching.scores import Features, score_pair, score_points, summarize, without_sigma
from sigmaslam.evaluation.matching.sets import load_set
from sigmaslam.match import match_features, refine_matches

Scores = dict[str, dict[str, float]]
"""By set, then by name of the score; shares and areas in [0, 1], numbers of matches a pair."""

_COUNTS = ("correct_3", "matches", "steps_good", "steps", "inliers")


def score(extractor: Extractor, sets: Sequence[str], data: Path) -> Scores:
    """Scores of an extractor.

    Args:
        extractor: image to keypoints and descriptors.
        sets: names from SELECTION and FINAL.
        data: folder of the real data sets.
    Raises:
        InputError: a set is unknown or missing.
    """
    return {name: score_pairs(extractor, load_set(name, data)) for name in sets}


def score_pairs(
    extractor: Extractor, pairs: Sequence[ImagePair], max_keypoints: int = MAX_KEYPOINTS
) -> dict[str, float]:
    """Scores of an extractor on pairs, each image extracted once.

    Args:
        extractor: image to keypoints and descriptors.
        pairs: images with the truth between them.
        max_keypoints: what everyone in the comparison may give.
    Returns:
        Means over the pairs; names as in `scores.score_pair` and `scores.summarize`, after the name of the part of the
        set where there is one ("gap1_epipolar_1").
    Raises:
        ValueError: the extractor gives more keypoints.
    """
    features = _extract_all(extractor, pairs, max_keypoints)
    return _summarize_parts(
        pairs, [score_pair(pair, features[id(pair.image0)], features[id(pair.image1)]) for pair in pairs]
    )


def score_refined(extractor: Extractor, pairs: Sequence[ImagePair], inverse_temperature: float) -> dict[str, float]:
    """As `score_pairs`, for the matches that `sigmaslam match` returns: consistent ones, with aligned patches."""
    features = _extract_all(extractor, pairs, MAX_KEYPOINTS)
    scores = []
    for pair in pairs:
        both = [without_sigma(features[id(image)]) for image in (pair.image0, pair.image1)]
        matches = refine_matches(pair.image0, pair.image1, match_features(both[0], both[1], inverse_temperature))
        points0, points1 = (points.astype(np.float64) for points in (matches.keypoints0, matches.keypoints1))
        scores.append(score_points(pair, points0, points1))
    return _summarize_parts(pairs, scores)


def _extract_all(extractor: Extractor, pairs: Sequence[ImagePair], max_keypoints: int) -> dict[int, Features]:
    features: dict[int, Features] = {}
    # `pairs` keeps the arrays alive, so their ids stay apart.
    for image in (image for pair in pairs for image in (pair.image0, pair.image1)):
        if id(image) not in features:
            keypoints, descriptors = extractor(image)
            features[id(image)] = keypoints, descriptors
            if len(keypoints) > max_keypoints:
                raise ValueError(f"the extractor gave {len(keypoints)} keypoints: at most {max_keypoints} are compared")
    return features


def _summarize_parts(pairs: Sequence[ImagePair], found: Sequence[dict[str, float]]) -> dict[str, float]:
    parts: dict[tuple[str, type], list[dict[str, float]]] = {}
    for pair, scores in zip(pairs, found, strict=True):
        parts.setdefault((pair.part, type(pair.truth)), []).append(scores)
    return {
        f"{part}_{name}" if part else name: value
        for (part, _), scores in parts.items()
        for name, value in summarize(scores).items()
    }


def format_scores(results: Mapping[str, Scores]) -> str:
    """Markdown tables, one a set with a row for each extractor; shares and areas in percent.

    Args:
        results: by name of the extractor what `score` gave.
    """
    lines = []
    for name in dict.fromkeys(name for scores in results.values() for name in scores):
        rows = {extractor: scores[name] for extractor, scores in results.items() if name in scores}
        columns = list(dict.fromkeys(column for row in rows.values() for column in row))
        lines += [f"## {name}", "", "| extractor | " + " | ".join(columns) + " |", "|---|" + "---:|" * len(columns)]
        for extractor, row in rows.items():
            lines.append(f"| {extractor} | " + " | ".join(_number(column, row) for column in columns) + " |")
        lines.append("")
    return "\n".join(lines)


def _number(column: str, row: Mapping[str, float]) -> str:
    if column not in row:
        return "-"
    return f"{row[column]:.0f}" if column.endswith(_COUNTS) else f"{100 * row[column]:.1f}"
