"""The page of `benchmark reconstruction --real`: disparities and sigmas on real truth, beside OpenCV's matching."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

from sigmaslam.progress import open_progress
from sigmaslam.reconstruction.disparity import DisparityMap, measure_disparity, semi_global_disparity
from sigmaslam.table import Table
from sigmaslam_benchmarks.tracking.disparity_pairs import (
    DETAILED,
    DisparityPair,
    real_pairs,
    rendered_pairs,
    worse_camera,
)
from sigmaslam_benchmarks.tracking.image_statistics import summarize
from sigmaslam_benchmarks.tracking.page import fill_page, number, write_page

SWEEP_SEED, SEED = 310, 320
"""Renders that the setting of OpenCV's matching is chosen on, and those that all are judged on."""
_SWEEP = [(block, mode) for block in (3, 5, 7) for mode in (cv2.STEREO_SGBM_MODE_SGBM, cv2.STEREO_SGBM_MODE_HH)]
_MODES = {cv2.STEREO_SGBM_MODE_SGBM: "5 paths", cv2.STEREO_SGBM_MODE_HH: "8 paths"}
# Disparities that OpenCV's matching searches, as a share of the width, in its steps of 16.
_SEARCHED = 0.18
# Depths by which a scan's time may be wrong, metres: twice what the data's page says of it.
_SCAN_SHIFTS = np.arange(-0.15, 0.151, 0.01)
# A pixel is at an edge where the truths within so many pixels differ by more than this, pixels and share.
_EDGE_RADIUS, _EDGE_STEP, _EDGE_SHARE = 4, 2.0, 0.1
_GROSS = 3.0
"""Pixels; the bar of KITTI's stereo benchmark."""

_STREETS = ("street", *DETAILED)
_PICTURE_WIDTH, _QUALITY = 621, 75

Method = Callable[[np.ndarray, np.ndarray], DisparityMap]


@dataclass(frozen=True, slots=True)
class JudgedDisparities(Table):
    """Pixels of a set with known truth.

    Attributes:
        truth, truth_sigma: (N,) disparity and its sigma, pixels.
        edge: (N,) distance from the nearest depth edge, pixels.
        distance: (N,) metres, NaN where the baseline is not known.
        error, sigma: (N,) of a method, pixels; NaN where it has none.
    """

    truth: np.ndarray
    truth_sigma: np.ndarray
    edge: np.ndarray
    distance: np.ndarray
    error: np.ndarray
    sigma: np.ndarray

    @property
    def known(self) -> np.ndarray:
        """(N,) bool, pixels with a disparity."""
        return np.isfinite(self.error)

    @property
    def deviations(self) -> np.ndarray:
        """(N,) absolute errors in sigmas, that of the truth counted."""
        return np.asarray(np.abs(self.error) / np.hypot(self.sigma, self.truth_sigma))


def write_real(path: Path, data: Path, command: str) -> str:
    """Judges all methods on all sets, writes the page and returns it; notes in it are kept."""
    sets = real_pairs(data)
    real = list(sets)
    rendered = rendered_pairs((SEED,))
    rng = np.random.default_rng(SEED)
    sets |= rendered
    sets |= {f"{name}, worse camera": [worse_camera(pair, rng) for pair in rendered[name]] for name in rendered}
    sets |= rendered_pairs((SEED,), tuple(DETAILED))
    streets = {name: sets[name] for name in (real[0], *_STREETS)}
    write_streets(path.with_suffix(".jpg"), [pairs[0].left for pairs in streets.values()])
    block, mode = best_setting(rendered_pairs((SWEEP_SEED,)))
    methods: dict[str, Method] = {
        "ours": lambda left, right: measure_disparity(left, right, semi_global_disparity),
        "SGBM, block 5, 5 paths": lambda left, right: opencv_matching(left, right, 5, cv2.STEREO_SGBM_MODE_SGBM),
        f"SGBM, best on renders: block {block}, {_MODES[mode]}": lambda left, right: opencv_matching(
            left, right, block, mode
        ),
    }
    judged, seconds = {}, {}
    with open_progress() as progress:
        task = progress.add_task("sets", total=len(sets) * len(methods), note="")
        for name, pairs in sets.items():
            for method, match in methods.items():
                judged[name, method], seconds[name, method] = judge(pairs, match)
                progress.update(task, advance=1, note=f"{name}, {method}")
    page = fill_page(
        "real_disparity",
        command,
        seed=SEED,
        real=real,
        rows=list(_rows(list(sets), list(methods), judged, seconds)),
        streets=[_look(name, pairs) for name, pairs in streets.items()],
        split_set=next(iter(sets)),
        splits={
            title: list(_parts(judged[next(iter(sets)), next(iter(methods))], split))
            for title, split in _SPLITS.items()
        },
    )
    return write_page(path, page)


def write_streets(path: Path, images: list[np.ndarray]) -> None:
    """One above the other, of one width."""
    sizes = [(_PICTURE_WIDTH, round(image.shape[0] * _PICTURE_WIDTH / image.shape[1])) for image in images]
    small = [cv2.resize(each, size, interpolation=cv2.INTER_AREA) for each, size in zip(images, sizes, strict=True)]
    cv2.imwrite(str(path), np.concatenate(small), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])


def _look(name: str, pairs: Sequence[DisparityPair]) -> list[str]:
    """Median gradient, corners of 3 and 10, noise, and quantiles of the disparities of a set."""
    found = summarize(name, [pair.left.astype(np.float32) for pair in pairs])
    truth = np.concatenate([pair.truth[np.isfinite(pair.truth)] for pair in pairs])
    quantiles = [f"{each:.0f}" for each in np.percentile(truth, (5, 25, 50, 75, 95))]
    corners = [f"{each:.1f}" for each in found.corner_density]
    return [name, f"{found.median_gradient:.2f}", *corners, f"{found.median_noise:.2f}", " / ".join(quantiles)]


def opencv_matching(left: np.ndarray, right: np.ndarray, block: int, mode: int) -> DisparityMap:
    """OpenCV's semi-global matching by its samples' settings; it says nothing of its errors."""
    levels = 16 * int(np.ceil(_SEARCHED * left.shape[1] / 16))
    small, large = 8 * block**2, 32 * block**2
    matcher = cv2.StereoSGBM.create(0, levels, block, small, large, 1, 0, 10, 100, 2, mode)
    disparity = matcher.compute(left, right).astype(np.float32) / 16.0
    disparity[disparity <= 0.0] = np.nan
    return DisparityMap(disparity, np.full_like(disparity, np.nan))


def best_setting(pairs: dict[str, list[DisparityPair]]) -> tuple[int, int]:
    """Block and mode with the least median error, the mean over the worlds."""

    def error(setting: tuple[int, int]) -> float:
        found = [judge(of_world, lambda a, b: opencv_matching(a, b, *setting))[0] for of_world in pairs.values()]
        return float(np.mean([np.nanmedian(np.abs(each.error)) for each in found]))

    return min(_SWEEP, key=error)


def judge(pairs: Sequence[DisparityPair], match: Method) -> tuple[JudgedDisparities, float]:
    """Pixels of all pairs by a method, and its processor seconds a pair."""
    judged, seconds = [], 0.0
    for pair in pairs:
        began = time.process_time()
        found = match(pair.left, pair.right)
        seconds += time.process_time() - began
        known = np.isfinite(pair.truth)
        truth, disparity = pair.truth[known].astype(float), found.disparity[known].astype(float)
        distance = np.full(len(truth), np.nan)
        if pair.focal_baseline is not None:
            distance = pair.focal_baseline / truth
            truth = pair.focal_baseline / (distance + scan_shift(disparity, distance, pair.focal_baseline))
        edge = edge_distance(pair.truth)[known]
        sigma = np.sqrt(found.variance[known].astype(float))
        judged.append(JudgedDisparities(truth, pair.sigma[known], edge, distance, disparity - truth, sigma))
    return JudgedDisparities.concatenate(judged), seconds / len(pairs)


def scan_shift(disparity: np.ndarray, distance: np.ndarray, focal_baseline: float) -> float:
    """Metres that the drive went between scan and image, by the least median error; each method has its own."""
    known = np.isfinite(disparity)
    if not known.any():
        return 0.0
    errors = [np.median(np.abs(disparity - focal_baseline / (distance + by))[known]) for by in _SCAN_SHIFTS]
    return float(_SCAN_SHIFTS[int(np.argmin(errors))])


def edge_distance(truth: np.ndarray) -> np.ndarray:
    """(H, W) pixels to the nearest place where known disparities around differ as those of two surfaces do."""
    window = np.ones((2 * _EDGE_RADIUS + 1, 2 * _EDGE_RADIUS + 1), np.uint8)
    largest = cv2.dilate(np.where(np.isfinite(truth), truth, -np.inf).astype(np.float32), window)
    least = cv2.erode(np.where(np.isfinite(truth), truth, np.inf).astype(np.float32), window)
    with np.errstate(invalid="ignore", over="ignore"):
        steps = np.isfinite(least) & (largest - least > np.maximum(_EDGE_STEP, _EDGE_SHARE * largest))
    return np.asarray(cv2.distanceTransform((~steps).astype(np.uint8), cv2.DIST_L2, 5))


_Judged = dict[tuple[str, str], JudgedDisparities]
_Part = tuple[float, float, np.ndarray]


def _rows(
    sets: list[str], methods: list[str], judged: _Judged, seconds: dict[tuple[str, str], float]
) -> Iterator[list[str]]:
    for name in sets:
        common = np.logical_and.reduce([judged[name, method].known for method in methods])
        for method in methods:
            found = judged[name, method]
            answered = found.select(found.known)
            counts = str(len(found.truth)), f"{found.known.mean():.1%}"
            errors = *_errors(answered.error), *_errors(found.error[common])
            yield [name, method, *counts, *errors, *_coverage(answered), f"{seconds[name, method]:.2f}"]


def _parts(found: JudgedDisparities, split: Callable[[JudgedDisparities], list[_Part]]) -> Iterator[list[str]]:
    found = found.select(found.known)
    for low, high, inside in split(found):
        part = found.select(inside)
        if len(part.truth):
            ends = f"{low:.3g}", f"{high:.3g}", f"{inside.mean():.1%}"
            yield [*ends, *_errors(part.error), *_coverage(part)]


def _errors(error: np.ndarray) -> list[str]:
    if not len(error):
        return ["-"] * 3
    return [f"{np.median(np.abs(error)):.3f}", f"{np.median(error):+.3f}", f"{np.mean(np.abs(error) > _GROSS):.1%}"]


def _coverage(found: JudgedDisparities) -> list[str]:
    if not len(found.sigma) or np.isnan(found.sigma).all():
        return ["-"] * 3
    return [number(float(np.mean(found.deviations < many)), ".1%") for many in (1, 2, 3)]


def _ranges(values: np.ndarray, ends: Sequence[float]) -> list[_Part]:
    return [(low, high, (values >= low) & (values < high)) for low, high in pairwise(ends)]


def _deciles(values: np.ndarray) -> list[_Part]:
    ends = np.unique(np.quantile(values, np.linspace(0.0, 1.0, 11)))
    ends[-1] = np.nextafter(ends[-1], np.inf)
    return _ranges(values, ends.tolist())


_SPLITS: dict[str, Callable[[JudgedDisparities], list[_Part]]] = {
    "distance, metres": lambda found: _ranges(found.distance, (2, 10, 20, 40, 80)),
    "distance from a depth edge, pixels": lambda found: _ranges(found.edge, (0, 4, 8, 16, 1e4)),
    "decile of sigma": lambda found: _deciles(found.sigma),
}
