"""Probability and covariance of matches on real images and renders, beside what people use today."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import astuple
from itertools import pairwise
from pathlib import Path

import cv2
import torch

from sigmaslam.frontend.match_confidence import ConfidenceEstimator
from sigmaslam_benchmarks.matching.dynamic_scenes import SHARES, judge_movers
from sigmaslam_benchmarks.matching.forward_motion import EDGES, judge_probability, measure_renders, measure_steps
from sigmaslam_benchmarks.matching.image_pairs import ImagePair, Motion, SameRows
from sigmaslam_benchmarks.matching.judgement import judge_homographies, judge_rows
from sigmaslam_benchmarks.matching.rejection import KEYPOINTS, compare_rejection
from sigmaslam_benchmarks.matching.relative_pose import compare_starts
from sigmaslam_benchmarks.matching.repeated_pairs import RepeatedPairs
from sigmaslam_benchmarks.matching.sets import check_sets, load_advances, load_set
from sigmaslam_benchmarks.tracking.page import fill_page, write_page
from sigmaslam_synthetic.homography_pairs import HomographyPair
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

    Raises:
        InputError: a set is missing.
    """
    check_sets((*_HOMOGRAPHIES, "fountain", *_STEREO), data)
    threads = cv2.getNumThreads(), torch.get_num_threads()
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    tables: dict[str, list[list[str]]] = {}
    try:
        judge = ConfidenceEstimator()
        for part in (_homographies, _rows, _probability, _rejection, _starts, _movers):
            name = part.__name__.strip("_")
            note(name)
            tables[name] = list(part(data, judge))
    finally:
        cv2.setNumThreads(threads[0])
        torch.set_num_threads(threads[1])
    page = fill_page(
        "matches",
        command,
        **tables,
        keypoints=_PHOTOGRAPH_KEYPOINTS,
        rejection_keypoints=KEYPOINTS,
        renders=_RENDER_PAIRS,
        mover_pairs=_MOVER_PAIRS,
        shares=[f"{100 * share:.0f}" for share in SHARES],
        bins=[f"{low:g}-{high:g}" for low, high in pairwise(EDGES)],
    )
    return write_page(path, page)


def _homographies(data: Path, judge: ConfidenceEstimator) -> Iterator[list[str]]:
    for name in _HOMOGRAPHIES:
        pairs = load_set(name, data)
        for kind, make in DETECTORS.items():
            measured = judge_homographies(pairs, make(_PHOTOGRAPH_KEYPOINTS), judge)
            yield [name, kind, *(f"{value:.3f}" for value in astuple(measured))]


def _rows(data: Path, judge: ConfidenceEstimator) -> Iterator[list[str]]:
    for name in _STEREO:
        pairs = [pair for pair in load_set(name, data) if isinstance(pair.truth, SameRows)]
        for kind, make in DETECTORS.items():
            measured = judge_rows(pairs, make(_STEREO_KEYPOINTS), judge)
            matches, *shares, correlation, median, sigma, bias = astuple(measured)
            cells = [f"{matches:.0f}", *(f"{100 * share:.1f}" for share in shares), f"{correlation:.2f}"]
            yield [name, kind, *cells, f"{median:.3f}", f"{sigma:.3f}", f"{bias:+.3f}"]


def _probability(data: Path, judge: ConfidenceEstimator) -> Iterator[list[str]]:
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
        yield [name, str(judged.matches), *curve, f"{judged.ece:.3f}", *(f"{100 * share:.1f}" for share in shares)]


def _rejection(data: Path, judge: ConfidenceEstimator) -> Iterator[list[str]]:
    for name, pairs in _motions(data):
        for thinned in (False, True):
            share, measured = compare_rejection(pairs, judge, thinned)
            label = f"{name}, thinned" if thinned else name
            for contender, reached in measured.items():
                shares = (f"{100 * value:.1f}" for value in (reached.f1, reached.precision, reached.recall))
                yield [label, f"{100 * share:.0f} %", contender, *shares, f"{reached.milliseconds:.1f}"]


def _starts(data: Path, judge: ConfidenceEstimator) -> Iterator[list[str]]:
    sets = [*_motions(data), ("euroc next", [p for p in load_set("euroc", data) if isinstance(p.truth, Motion)])]
    for name, pairs in sets:
        for kind in ("learned", "sift"):
            for contender, reached in compare_starts(pairs, DETECTORS[kind](_PHOTOGRAPH_KEYPOINTS), judge).items():
                errors = (f"{value:.3f}" for value in (reached.rotation, reached.direction, reached.mean))
                yield [name, kind, contender, *errors, f"{reached.milliseconds:.1f}"]


def _movers(data: Path, judge: ConfidenceEstimator) -> Iterator[list[str]]:
    measured = judge_movers(DETECTORS["learned"](_PHOTOGRAPH_KEYPOINTS), judge, _MOVER_SEED, _MOVER_PAIRS)
    yield [str(measured.pairs), *(f"{100 * value:.1f}" for value in astuple(measured)[1:])]


def _motions(data: Path) -> list[tuple[str, list[ImagePair]]]:
    return [
        ("fountain", load_set("fountain", data)),
        ("kitti gap 3", [pair for pair in load_set("kitti", data) if pair.part == "gap3"]),
    ]
