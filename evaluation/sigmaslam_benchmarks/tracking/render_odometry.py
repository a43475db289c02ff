"""SIFT odometry on rendered drives beside the same on a real one: is what a tracker meets there alike?"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from sigmaslam.errors import InputError
from sigmaslam.frontend.classical import SiftDetector
from sigmaslam.readers import open_sequence
from sigmaslam.runs.request import TrackerOptions
from sigmaslam.slam.tracker import TrackerConfig
from sigmaslam_benchmarks.matching.scores import mutual_nearest
from sigmaslam_benchmarks.trial import Trial, render, track_ours

REAL_DRIVE = "kitti_raw_0926_0039_a"
PROFILE = "kitti_gt_trajectories/07.txt"
"""The drive whose motion the renders have, at about the speed of the real one."""
SEEDS = (0, 1, 2)
FRAMES = 70
WIDTH, HEIGHT = 1242, 376
LIMIT = 2.0
"""Ratio of render to real, either way, up to which the two behave alike."""
_LENGTHS = (10.0, 20.0, 30.0, 40.0, 50.0)  # metres, fit into every drive
_STEREO_STEP = 5  # every so many frames the eyes are matched without the tracker's help
_ROW_GATE = 3.0  # pixels; matches whose rows differ by more are wrong
_FITS = 6  # of the quadratic, without the outliers of the one before


@dataclass(frozen=True, slots=True)
class Drive:
    """What SIFT and the tracker make of a drive.

    Attributes:
        name: of the sequence.
        stereo_matches: mutual nearest neighbours of the two eyes' keypoints whose rows differ by less than 3 pixels
            and whose disparity is positive; median of the frames.
        row_error: median |v_left - v_right| of them, pixels.
        row_noise: the same after a quadratic of (u, v), fitted robustly to the whole drive, is taken off: what is left
            when the calibration of the pair is mended.
        inliers: points that carry the pose of a frame, median.
        t_rel: translation error of segments of 10 to 50 m, percent.
        step_error: median error of the motion from frame to frame, percent of the mean distance a frame.
        roughness: median distance of a step's estimated length from the mean of its two neighbours, percent of the mean
            distance a frame; needs no truth.
    """

    name: str
    stereo_matches: float
    row_error: float
    row_noise: float
    inliers: float
    t_rel: float
    step_error: float
    roughness: float


# Attribute, title and format; each ratio should be within LIMIT.
_ROWS: tuple[tuple[str, str, str], ...] = (
    ("inliers", "inliers a frame", ".0f"),
    ("stereo_matches", "stereo matches of raw SIFT", ".0f"),
    ("row_error", "their row error px", ".3f"),
    ("row_noise", "row error px without calibration error", ".3f"),
    ("t_rel", "t_rel %, 10 to 50 m", ".2f"),
    ("step_error", "error of a step against the truth, % of its length", ".2f"),
    ("roughness", "roughness of the steps, % of their length", ".2f"),
)


def render_drives(folder: Path, data: Path, note: Callable[[str], None] = lambda text: None) -> list[Path]:
    """Renders the drives, one a seed; what the folder holds of them already is kept.

    Args:
        folder: for the sequences, one folder each.
        data: folder of the real data sets.
        note: told what is being done.
    """
    from sigmaslam_synthetic.render_sequence import default_workers
    from sigmaslam_synthetic.simulation import Recipe

    drives = []
    for seed in SEEDS:
        recipe = Recipe("street", FRAMES, seed, width=WIDTH, height=HEIGHT, profile=str(data / PROFILE))

        def done(count: int, seed: int = seed) -> None:
            note(f"rendering street{seed}: {count} of {FRAMES} frames")

        drives.append(render(folder, recipe, default_workers(), done))
    return drives


def follow(name: str, sequence: Path, truth: Path) -> Drive:
    """Tracks a sequence with SIFT and compares it with the truth."""
    result = Trial(sequence, truth, partial(track_ours, tracker=TrackerOptions("sift"))).run(lengths=_LENGTHS, step=1)
    evaluation, tracked, columns = result.evaluation, result.tracked, result.table.columns
    if not tracked.any():
        raise InputError(f"{sequence}: SIFT tracked none of its frames, there is nothing to compare")
    step = evaluation.path_length / (evaluation.matched - 1)
    lengths = np.linalg.norm(np.diff(result.trajectory.positions, axis=0), axis=1)
    bend = lengths[1:-1] - 0.5 * (lengths[:-2] + lengths[2:])
    counts, rows = _match_eyes(sequence)
    return Drive(
        name=name,
        stereo_matches=float(np.median(counts)),
        row_error=float(np.median(np.abs(rows[:, 3]))),
        row_noise=row_noise(rows[:, 0], rows[:, 1], rows[:, 3]),
        inliers=float(np.median(columns["inliers"][tracked])),
        t_rel=evaluation.kitti.mean_translation_percent,
        step_error=100 * evaluation.rpe.translation_median / step,
        roughness=100 * float(np.median(np.abs(bend))) / step,
    )


def compare_drives(real: Drive, renders: Sequence[Drive]) -> dict[str, Any]:
    """Rows of the page's table, one a quantity, and what is off by more than the limit."""
    rows, off = [], []
    for key, title, form in _ROWS:
        truth = getattr(real, key)
        values = [getattr(render, key) for render in renders]
        ratio = float(np.median(values)) / truth
        alike = 1 / LIMIT <= ratio <= LIMIT
        if not alike:
            off.append(f"{title} (x{ratio:.2f})")
        cells = [title, *(format(value, form) for value in (truth, *values)), f"{ratio:.2f}"]
        rows.append([*cells, "yes" if alike else "**no**"])
    return {"quantities": rows, "off": off}


def row_noise(u: np.ndarray, v: np.ndarray, difference: np.ndarray) -> float:
    """Median |row difference| after a quadratic of the place is taken off.

    Args:
        u, v: (N,) pixels of the left image.
        difference: (N,) v_left - v_right, pixels.
    """
    x, y = ((values - values.mean()) / max(float(values.std()), 1e-9) for values in (u, v))
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    kept = np.ones(len(x), dtype=bool)
    residual = difference
    for _ in range(_FITS):
        solution, *_ = np.linalg.lstsq(terms[kept], difference[kept], rcond=None)
        residual = np.abs(difference - terms @ solution)
        kept = residual <= 4.0 * np.median(residual)
    return float(np.median(residual))


def _match_eyes(sequence: Path) -> tuple[np.ndarray, np.ndarray]:
    """Raw SIFT between the eyes.

    Returns:
        (F,) matches in each frame looked at; (N, 4) u and v of the left
        image, u_left - u_right and v_left - v_right of the matches of all of them.
    """
    detect = SiftDetector(TrackerConfig().max_keypoints)
    counts, rows = [], []
    for frame in open_sequence(sequence).frames():
        if frame.index % _STEREO_STEP:
            continue
        left, right = detect(frame.left), detect(frame.right)
        index0, index1 = mutual_nearest(left.descriptors, right.descriptors)
        places = left.keypoints[index0].astype(np.float64)
        difference = places - right.keypoints[index1]
        good = (np.abs(difference[:, 1]) < _ROW_GATE) & (difference[:, 0] > 0)
        counts.append(good.sum())
        rows.append(np.concatenate([places[good], difference[good]], axis=1))
    return np.array(counts, dtype=np.float64), np.concatenate(rows)
