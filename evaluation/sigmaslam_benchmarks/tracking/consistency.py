"""Whether poses and map are as sure as they say, and whether covariances of matches pay: renders with exact truth."""

import os
from collections.abc import Callable
from contextlib import redirect_stderr
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
import torch

from sigmaslam.geometry.calibration_sigmas import CalibrationSigmas
from sigmaslam.geometry.rectification import StereoRectifier
from sigmaslam.readers.trajectory_files import read_trajectory
from sigmaslam.runs.request import TrackerOptions
from sigmaslam.slam.point_map import PointMap
from sigmaslam.slam.tracker import TrackerConfig
from sigmaslam_benchmarks.code_hash import hash_once
from sigmaslam_benchmarks.rendered_camera import draw_calibration, open_rendered, read_simulation
from sigmaslam_benchmarks.tracking import map_consistency as consistency
from sigmaslam_benchmarks.tracking.consistency_page import DRAWN, ConsistencyResult, Scale, format_noise, format_page
from sigmaslam_benchmarks.tracking.trial_pool import SequenceTrials, TrialKind, write_trials
from sigmaslam_benchmarks.trial import Trial, track_ours
from sigmaslam_evaluation.metrics.trajectory_errors import coverage
from sigmaslam_evaluation.truth_conventions import find_truth
from sigmaslam_synthetic.simulation import Recipe, Studio

# The images of all three are rectified, so that the injected offset shifts all disparities alike.
SCALES = (
    Scale("driving", "street", 576, 176),
    Scale("indoors", "room", 360, 270),
    Scale("endoscope", "organ", 360, 288),
)
_CONSTANT = TrackerConfig(constant_sigma=(0.15, 0.2))
METHODS = {
    "ours": TrackerConfig(),
    "one covariance": _CONSTANT,
    f"one covariance, {DRAWN}": _CONSTANT,
    f"ours, {DRAWN}": TrackerConfig(),
}
"""The first is what `sigmaslam track` does. *One* is for all matches, the best of four on development renders."""
OFFSET = 0.3
"""Pixels by which the rendered disparities exceed what the calibration says."""
FRAMES = 30
_FIRST_SEED = 861_000  # others were looked at while the tracker was made
_GROSS = 5.0  # sigmas


def write_consistency(
    path: Path,
    runs: Path,
    seeds: int,
    workers: int,
    command: str,
    ray: str | None = None,
    note: Callable[[str], None] = lambda text: None,
    form_page: Callable[..., str] = format_page,
) -> str:
    """Renders and tracks what is missing, writes the page and returns it; notes in it are kept.

    Args:
        ray: of `write_trials`, and what it raises.
        seeds: sequences of each scale.
        form_page: Markdown of what there is.
    """

    def form(done: list[SequenceTrials], missing: list[str]) -> str:
        results: dict[Scale, dict[str, list[ConsistencyResult]]] = {}
        for scale in SCALES:
            of_scale = [trials for trials in done if trials.recipe.preset == scale.preset]
            if of_scale:
                results[scale] = {
                    method: [ConsistencyResult(**trials.read(method) or {}) for trials in of_scale]
                    for method in METHODS
                }
        return form_page(results, OFFSET, FRAMES, (_FIRST_SEED, seeds), command, missing)

    # Run all scales of a seed before the next seed: an interrupted benchmark is balanced.
    recipes = [
        Recipe(scale.preset, FRAMES, seed, disparity_offset=OFFSET, width=scale.width, height=scale.height)
        for seed in range(_FIRST_SEED, _FIRST_SEED + seeds)
        for scale in SCALES
    ]
    kind = TrialKind(METHODS, _track, partial(hash_once, Path(__file__)))
    return write_trials(path, runs, kind, recipes, form, workers, ray, note)


write_noise = partial(write_consistency, form_page=format_noise)
"""The same sequences and results, own covariances beside one for all."""


@lru_cache(maxsize=1)
def _open_scene(source: Path) -> Studio:
    """Of a sequence, whose methods are judged one after another."""
    return Studio(read_simulation(source))


def depths_around(studio: Studio, frame: int, pixels: np.ndarray) -> np.ndarray:
    """(M, 3, 3) z at pixels (M, 2) of an undistorted left image and one pixel around them; inf where nothing is."""
    times = np.array([frame / studio.simulation.fps])
    with torch.inference_mode():
        sight = studio.renderer.look(studio.left, studio.simulation.path.poses(times), times)
        v, u = np.mgrid[-1:2, -1:2]
        around = pixels[:, None, None] + np.stack([u, v], axis=-1)
        places = torch.from_numpy(around.reshape(-1, 2).T.copy())
        view = torch.zeros(places.shape[1], dtype=torch.int64)
        facet = sight.resolve(view, places)
        seen = facet >= 0
        inverse = torch.zeros(len(facet), dtype=torch.float64)
        inverse[seen] = sight.evaluate(view[seen], facet[seen], places[:, seen])[2]
        return np.asarray((1.0 / inverse).numpy().reshape(-1, 3, 3))


def _track(source: Path, recipe: Recipe, method: str) -> ConsistencyResult:
    truth = find_truth(source)
    # The others are given what is right but for the offset, which is estimated.
    sequence, config, drawn = open_rendered(source), METHODS[method], method.endswith(DRAWN)
    if drawn:
        uncertain = replace(sequence.camera, sigmas=CalibrationSigmas())
        sequence.camera = draw_calibration(uncertain, np.random.default_rng(recipe.seed))
    with Path(os.devnull).open("w") as nowhere, redirect_stderr(nowhere):
        trial = Trial(sequence, truth, partial(track_ours, tracker=TrackerOptions(config=config))).run()
    evaluation, tracked, point_map = trial.evaluation, trial.tracked, trial.point_map
    assert evaluation.nees is not None
    columns = trial.table.columns
    if drawn:
        # Its pixels are those of another camera than the one that the true depths are known of.
        point_map = {name: point_map[name][:0] for name in PointMap.__slots__}
    true = read_trajectory(truth)
    hosts = np.abs(point_map["timestamps"][:, None] - true.timestamps).argmin(axis=1)
    pixels = point_map["pixels"]
    depths, scene = np.zeros((len(pixels), 3, 3)), _open_scene(source)
    for host in np.unique(hosts):
        depths[hosts == host] = depths_around(scene, int(host), pixels[hosts == host])
    clear = ~consistency.depth_edges(depths)
    camera = StereoRectifier(sequence.camera).rectified
    true_points = consistency.points_of_depth(pixels[clear], depths[clear, 1, 1], camera, true.poses[hosts[clear]])
    nees = consistency.point_nees(point_map["points"][clear], point_map["covariances"][clear], true_points)
    some, dof = len(nees) > 0, columns["dof"][tracked].sum()
    nan = float("nan")
    return ConsistencyResult(
        nees=evaluation.nees.mean,
        inside=coverage(evaluation.nees.per_frame, 6),
        nis=float(columns["nis"][tracked].sum() / dof) if dof else nan,
        ate=evaluation.ate.rmse,
        path_length=evaluation.path_length,
        offset_error=float(columns["disparity_offset"][-1] - OFFSET),
        lost=int((~tracked[1:]).sum()),
        point_nees=float(nees.mean()) if some else nan,
        point_inside=coverage(nees, 3),
        point_gross=float((3.0 * nees > _GROSS**2).mean()) if some else nan,
        relative={span.span: (span.mean_nees, span.inside) for span in evaluation.relative or ()},
    )
