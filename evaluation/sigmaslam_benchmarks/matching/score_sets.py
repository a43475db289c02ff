"""Scores of an extractor on the sets, and their table."""

import re
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from sigmaslam_benchmarks.matching.extractors import MAX_KEYPOINTS, Extractor, remembering
from sigmaslam_benchmarks.matching.image_pairs import ImagePair
from sigmaslam_benchmarks.matching.scores import (
    KeypointsAndDescriptors,
    match_judged,
    score_pair,
    score_points,
    summarize,
)

Scores = dict[str, dict[str, float]]
"""By set, then by name of the score; shares and areas in [0, 1], numbers of matches a pair."""

_COUNTS = ("correct_3", "matches", "steps_good", "steps", "inliers")
# In the .json beside the page alone: they rank the extractors as their neighbours do.
_UNLISTED = re.compile("(polished_)?auc_[15]|.*auc_10|correct_3|row_matches|rows_1")


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
    features = _limited(extractor, max_keypoints)
    return _summarize_parts(pairs, [score_pair(pair, features(pair.image0), features(pair.image1)) for pair in pairs])


def score_refined(extractor: Extractor, pairs: Sequence[ImagePair]) -> dict[str, float]:
    """As `score_pairs`, for the matches that `sigmaslam match` returns: probable ones, with aligned patches."""
    features = _limited(extractor, MAX_KEYPOINTS)
    scores = []
    for pair in pairs:
        matches = match_judged(pair.image0, pair.image1, features(pair.image0), features(pair.image1))
        points0, points1 = (points.astype(np.float64) for points in (matches.keypoints0, matches.keypoints1))
        scores.append(score_points(pair, points0, points1))
    return _summarize_parts(pairs, scores)


def _limited(extractor: Extractor, max_keypoints: int) -> Extractor:
    """The extractor, asked once for an image, which must not give more keypoints than everyone may."""

    def extract(image: np.ndarray) -> KeypointsAndDescriptors:
        features = extractor(image)
        if len(features[0]) > max_keypoints:
            raise ValueError(f"the extractor gave {len(features[0])} keypoints: at most {max_keypoints} are compared")
        return features

    return remembering(extract)


def _summarize_parts(pairs: Sequence[ImagePair], pair_scores: Sequence[dict[str, float]]) -> dict[str, float]:
    parts: dict[tuple[str, type], list[dict[str, float]]] = {}
    for pair, scores in zip(pairs, pair_scores, strict=True):
        parts.setdefault((pair.part, type(pair.truth)), []).append(scores)
    return {
        f"{part}_{name}" if part else name: value
        for (part, _), scores in parts.items()
        for name, value in summarize(scores).items()
    }


def format_scores(results: Mapping[str, Scores], beside: Collection[str] = ()) -> str:
    """Markdown tables, one a set with a row for each extractor; shares and areas in percent.

    Args:
        results: by name of the extractor, as `compare` gives them.
        beside: sets whose tables go beside the page, as of `write_page`.
    """
    lines = []
    for name in dict.fromkeys(name for scores in results.values() for name in scores):
        rows = {extractor: scores[name] for extractor, scores in results.items() if name in scores}
        names = dict.fromkeys(column for row in rows.values() for column in row)
        columns = [column for column in names if not _UNLISTED.fullmatch(column)]
        lines += [f"{name}:", f"<!-- rows {name} -->"] if name in beside else [f"## {name}", ""]
        lines += ["| extractor | " + " | ".join(columns) + " |", "|---|" + "---:|" * len(columns)]
        for extractor, row in rows.items():
            lines.append(f"| {extractor} | " + " | ".join(_number(column, row) for column in columns) + " |")
        lines += ["<!-- end -->", ""] if name in beside else [""]
    return "\n".join(lines)


def _number(column: str, row: Mapping[str, float]) -> str:
    if column not in row:
        return "-"
    return f"{row[column]:.0f}" if column.endswith(_COUNTS) else f"{100 * row[column]:.1f}"
