"""Probability and covariance of matches on real images and renders, beside what people use today."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import astuple, fields
from itertools import pairwise
from pathlib import Path

import cv2
import torch

from sigmaslam.frontend.match_confidence import ConfidenceEstimator
from sigmaslam_benchmarks.matching.dynamic_scenes import SHARES, MoverJudgement, judge_movers
from sigmaslam_benchmarks.matching.forward_motion import (
    EDGES,
    judge_probability,
    measure_renders,
    measure_steps,
)
from sigmaslam_benchmarks.matching.image_pairs import ImagePair, Motion, SameRows
from sigmaslam_benchmarks.matching.judgement import (
    HomographyJudgement,
    RowJudgement,
    judge_homographies,
    judge_rows,
)
from sigmaslam_benchmarks.matching.rejection import KEYPOINTS, compare_rejection
from sigmaslam_benchmarks.matching.relative_pose import compare_starts
from sigmaslam_benchmarks.matching.sets import check_sets, load_advances, load_set
from sigmaslam_benchmarks.tracking.page import header, opening, row, write_page
from sigmaslam_synthetic.homography_pairs import HomographyPair
from sigmaslam_synthetic.repeated_pairs import RepeatedPairs
from sigmaslam_synthetic.scene_pairs import ScenePair, ScenePairs
from sigmaslam_training.matching.match_sets import DETECTORS, SIZE

_HOMOGRAPHIES, _STEREO = ("set12", "boat", "churchill"), ("kitti", "euroc")
_PHOTOGRAPH_KEYPOINTS, _STEREO_KEYPOINTS = 1024, 1500
_MOVER_SEED, _MOVER_PAIRS = 2_000_003, 320
_RENDER_SEED, _RENDER_PAIRS = 2_000_005, 64
_RENDERED = range(_RENDER_PAIRS)
# Worlds in which cameras advance.
_FORWARD_DOMAINS = ("street", "street", "drone", "room")


def write_matches(path: Path, data: Path, command: str, note: Callable[[str], None] = lambda text: None) -> str:
    """Measures everything, writes the page and returns it; notes in it are kept.

    Args:
        path: Markdown page.
        data: folder of the real data sets.
        command: what the page says it was made by.
        note: is told of progress.
    Raises:
        InputError: a set is missing.
    """
    check_sets((*_HOMOGRAPHIES, "fountain", *_STEREO), data)
    threads = cv2.getNumThreads(), torch.get_num_threads()
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    try:
        judge = ConfidenceEstimator()
        lines = _introduction(command)
        for part in (_homographies, _rows, _probability, _rejection, _starts, _movers):
            note(part.__name__.strip("_"))
            lines += part(data, judge)
    finally:
        cv2.setNumThreads(threads[0])
        torch.set_num_threads(threads[1])
    return write_page(path, "\n".join([*lines, ""]))


def _introduction(command: str) -> list[str]:
    return [
        *opening("Matches: do probability and covariance hold?", command, ", one thread, in one run. Nothing was"),
        "trained or tuned on these images. Shares in percent unless they are called sigma, AUROC or correlation.",
        "",
    ]


def _homographies(data: Path, judge: ConfidenceEstimator) -> list[str]:
    lines = [
        "## Real homographies",
        "",
        f"{_PHOTOGRAPH_KEYPOINTS} keypoints an image; right: within 3 px. *precision*: average precision among all",
        "nearest neighbours, by mutual + ratio and by the scorer, which sees no image. *AUROC* among mutual ones:",
        "by the ratio, by the scorer, and of the final probability, which has seen the aligned patches.",
        "*spearman*: rank correlation of error and sigma of the right matches; before: of the keypoints' own",
        "sigma. *best half*: RMS error of the half with the smaller sigma over that of all. *inside*: share of",
        "the right ones inside their 95 % ellipse; Set12's warps are exact, the homographies of boat and",
        "churchill are themselves off by tenths of a pixel.",
        "",
        *header("set", "features", *(field.name.replace("_", " ") for field in fields(HomographyJudgement))),
    ]
    for name in _HOMOGRAPHIES:
        pairs = load_set(name, data)
        for kind, make in DETECTORS.items():
            measured = judge_homographies(pairs, make(_PHOTOGRAPH_KEYPOINTS), judge)
            lines.append(row(name, kind, *(f"{value:.3f}" for value in astuple(measured))))
    return [*lines, ""]


def _rows(data: Path, judge: ConfidenceEstimator) -> list[str]:
    lines = [
        "## Rows of real stereo pairs",
        "",
        "Keypoints of the left image, searched for and aligned in the right one as the tracker does. The true row",
        "error is zero up to rectification. *within*: share of the matches with a row error within 1",
        "and 2 sigma, as the images are rectified; *mended*: after a polynomial of second degree, one for all",
        "pairs of a set, is taken out; *constant*: mended, with 0.3 px for every match. A normal error has 68.3",
        "and 95.4 %.",
        "",
        *header("set", "features", *(field.name.replace("_", " ") for field in fields(RowJudgement))),
    ]
    for name in _STEREO:
        pairs = [pair for pair in load_set(name, data) if isinstance(pair.truth, SameRows)]
        for kind, make in DETECTORS.items():
            measured = judge_rows(pairs, make(_STEREO_KEYPOINTS), judge)
            matches, *shares, correlation, median, sigma, bias = astuple(measured)
            cells = [f"{matches:.0f}", *(f"{100 * share:.1f}" for share in shares), f"{correlation:.2f}"]
            lines.append(row(name, kind, *cells, f"{median:.3f}", f"{sigma:.3f}", f"{bias:+.3f}"))
    return [*lines, ""]


def _probability(data: Path, judge: ConfidenceEstimator) -> list[str]:
    bins = [f"{low:g}-{high:g}" for low, high in pairwise(EDGES)]
    lines = [
        "## Probability in forward motion and on repeated structure",
        "",
        f"Mutual nearest neighbours of {_PHOTOGRAPH_KEYPOINTS} learned keypoints. *claimed / right*: mean probability",
        "and share of right ones of the matches of such a probability; right: within 3 px of the true place, which on",
        "real pairs is that of keypoints with a stereo match of at least 0.9, moved by the true motion. *precision*,",
        "*lost*: right ones among those of at least 0.5, and right ones that are not among them. *within*: errors of",
        "right matches within 1 and 2 sigma along the axes of their covariance.",
        f"Renders: {_RENDER_PAIRS} pairs of worlds and patterns of their own seed.",
        "",
        *header("set", "matches", *bins, "ece", "precision", "lost", "within 1", "within 2"),
    ]
    renders: dict[str, Sequence[ScenePair | HomographyPair]] = {
        "renders, forward": list(map(ScenePairs(_RENDER_SEED, SIZE, _FORWARD_DOMAINS, forward=True).pair, _RENDERED)),
        "renders, repeated": list(map(RepeatedPairs(_RENDER_SEED, SIZE).pair, _RENDERED)),
    }
    gaps = {f"kitti gap {gap}": load_advances(data, gap) for gap in (1, 3)}
    detect = DETECTORS["learned"](_PHOTOGRAPH_KEYPOINTS)
    measured = {name: measure_steps(steps, detect, judge) for name, steps in gaps.items()}
    measured |= {name: measure_renders(pairs, detect, judge) for name, pairs in renders.items()}
    for name, matches in measured.items():
        judged = judge_probability(matches)
        curve = (f"{claimed:.2f} / {right:.2f}" for claimed, right in zip(judged.claimed, judged.right, strict=True))
        shares = judged.precision, judged.lost, judged.within_1, judged.within_2
        cells = *curve, f"{judged.ece:.3f}", *(f"{100 * share:.1f}" for share in shares)
        lines.append(row(name, str(judged.matches), *cells))
    return [*lines, ""]


def _rejection(data: Path, judge: ConfidenceEstimator) -> list[str]:
    lines = [
        "## Right from wrong among SIFT's nearest neighbours",
        "",
        f"{KEYPOINTS} keypoints an image, every one with its nearest neighbour; right: within 1.5 px of the",
        "epipolar line. MAGSAC fits that very line, so it also accepts what is wrong along it. *thinned*: right",
        "matches are taken out at random until a quarter is right. Time without detection and descriptors: ours",
        "with neighbours and side information.",
        "",
        *header("set", "right", "contender", "F1", "precision", "recall", "ms"),
    ]
    for name, pairs in _motions(data):
        for thinned in (False, True):
            share, measured = compare_rejection(pairs, judge, thinned)
            for contender, reached in measured.items():
                shares = (f"{100 * value:.1f}" for value in (reached.f1, reached.precision, reached.recall))
                lines.append(
                    row(
                        f"{name}, thinned" if thinned else name,
                        f"{100 * share:.0f} %",
                        contender,
                        *shares,
                        f"{reached.milliseconds:.1f}",
                    )
                )
    return [*lines, ""]


def _starts(data: Path, judge: ConfidenceEstimator) -> list[str]:
    lines = [
        "## Relative pose without a prediction",
        "",
        f"Two views, known intrinsics, {_PHOTOGRAPH_KEYPOINTS} keypoints; degrees. The truth of KITTI (GPS) and",
        "EuRoC is no better than some tenths of a degree in the direction of a short step: there the contenders",
        "cannot differ much.",
        "",
        *header("set", "features", "estimator", "median rotation", "median direction", "mean of the larger", "ms"),
    ]
    sets = [*_motions(data), ("euroc next", [p for p in load_set("euroc", data) if isinstance(p.truth, Motion)])]
    for name, pairs in sets:
        for kind in ("learned", "sift"):
            for contender, reached in compare_starts(pairs, DETECTORS[kind](_PHOTOGRAPH_KEYPOINTS), judge).items():
                errors = (f"{value:.3f}" for value in (reached.rotation, reached.direction, reached.mean))
                lines.append(row(name, kind, contender, *errors, f"{reached.milliseconds:.1f}"))
    return [*lines, ""]


def _motions(data: Path) -> list[tuple[str, list[ImagePair]]]:
    return [
        ("fountain", load_set("fountain", data)),
        ("kitti gap 3", [pair for pair in load_set("kitti", data) if pair.part == "gap3"]),
    ]


def _movers(data: Path, judge: ConfidenceEstimator) -> list[str]:
    measured = judge_movers(DETECTORS["learned"](_PHOTOGRAPH_KEYPOINTS), judge, _MOVER_SEED, _MOVER_PAIRS)
    low, high = (f"{100 * share:.0f}" for share in SHARES)
    return [
        "## Rendered scenes with half of the matches on moving things",
        "",
        f"Of {_MOVER_PAIRS} rendered pairs those with {low} to {high} % of the right matches on things that moved.",
        "A mover's match is a right match; which ones move with the scene is for the estimator to say. Share of",
        "what is accepted that lies on the static scene:",
        "",
        *header(*(field.name.replace("_", " ") for field in fields(MoverJudgement))),
        row(str(measured.pairs), *(f"{100 * value:.1f}" for value in astuple(measured)[1:])),
        "",
    ]
