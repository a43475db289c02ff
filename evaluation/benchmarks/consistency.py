"""Whether poses and map are as sure as they say: the tracker on renders with exact truth, many seeds, five filters."""

from __future__ import annotations

import hashlib
import inspect
import json
import multiprocessing
import os
import shutil
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import redirect_stderr
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
import torch

from sigmaslam.errors import InputError
from sigmaslam.evaluation.benchmarks.consistency_page import Result, Results, Scale, format_page
from sigmaslam.evaluation.benchmarks.page import write_page
from sigmaslam.evaluation.metrics import map_consistency as consistency
from sigmaslam.evaluation.run_evaluation import evaluate_run
from sigmaslam.files import atomic_write_text, make_folder
from sigmaslam.geometry.rectification import StereoRectifier
from sigmaslam.inference.onnx_graph import shipped_weights
from sigmaslam.readers import open_sequence
from sigmaslam.readers.trajectory_files import read_trajectory
from sigmaslam.runs.report import read_frames
from sigmaslam.runs.track import track_sequence
from sigmaslam.slam.tracker import TrackerConfig
from sigmaslam.synthetic.render_sequence import SCENE_NAME, write_sequence
from sigmaslam.synthetic.simulation import Recipe, Simulation, Studio

# All three are written rectified, so that the injected offset is one of disparities, exactly.
SCALES = (
    Scale("driving", "street", 576, 176),
    Scale("indoors", "room", 360, 270),
    Scale("endoscope", "organ", 360, 288),
)
METHODS = {
    "ours": TrackerConfig(linearisation="unscented"),
    "UKF, one iteration": TrackerConfig(linearisation="unscented", iterations=1),
    "EKF, iterated": TrackerConfig(linearisation="extended"),
    "EKF, one iteration": TrackerConfig(linearisation="extended", iterations=1),
    "ours, offset not estimated": TrackerConfig(linearisation="unscented", offset_sigma=0.0, offset_walk=0.0),
}
"""The first is what `sigmaslam track` does, and what the others are compared with."""
OFFSET = 0.3
"""Pixels by which the rendered disparities exceed what the calibration says."""
FRAMES = 30
_FIRST_SEED = 1000  # seeds below were looked at while the tracker was made
_GROSS = 5.0  # sigmas


@dataclass(frozen=True, slots=True)
class _Job:
    """One sequence, with all methods."""

    runs: Path
    scale: Scale
    seed: int
    code: str

    @property
    def recipe(self) -> Recipe:
        scale = self.scale
        return Recipe(scale.preset, FRAMES, self.seed, disparity_offset=OFFSET, width=scale.width, height=scale.height)

    @property
    def source(self) -> Path:
        return self.runs / f"{self.scale.preset}{self.seed}"


def write_consistency(
    path: Path, runs: Path, seeds: int, workers: int, command: str, note: Callable[[str], None] = lambda text: None
) -> str:
    """Renders and tracks what is missing, writes the page and returns it; notes in it are kept.

    A result is used again when it comes from the same recipe, configuration and code.

    Args:
        path: Markdown page.
        runs: folder for renders and results.
        seeds: sequences of each scale.
        workers: processes; each takes a sequence at a time.
        command: what the page says it was made by.
        note: is told of progress.
    """
    make_folder(runs)
    code = _code_hash()
    # All scales of a seed before the next one: what is there when it is stopped is balanced.
    jobs = [_Job(runs, scale, _FIRST_SEED + k, code) for k in range(seeds) for scale in SCALES]
    missing = [job for job in jobs if any(_read_result(job, method) is None for method in METHODS)]
    note(f"{len(jobs) - len(missing)} of {len(jobs)} sequences are there")
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(workers, max(len(missing), 1)), context, _start_worker) as pool:
        try:
            futures = [pool.submit(_work, job) for job in missing]
            for count, future in enumerate(as_completed(futures), start=1):
                note(f"{count} of {len(missing)}: {future.result()}")
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    results: Results = {
        scale: {
            method: [result for job in jobs if job.scale == scale and (result := _read_result(job, method))]
            for method in METHODS
        }
        for scale in SCALES
    }
    return write_page(path, format_page(results, OFFSET, FRAMES, _FIRST_SEED, command))


def _start_worker() -> None:
    cv2.setNumThreads(1)
    torch.set_num_threads(1)


def _work(job: _Job) -> str:
    """Renders and tracks what is missing of one sequence; says how long both took."""
    try:
        return _make(job)
    except KeyboardInterrupt:
        os._exit(130)  # or this process would begin with the next sequence


def _make(job: _Job) -> str:
    began = time.perf_counter()
    _render(job)
    rendered = time.perf_counter()
    scene = _open_scene(job.source)
    count = 0
    for method, config in METHODS.items():
        if _read_result(job, method) is None:
            result = _track(job, config, scene)
            content = {"made_from": _made_from(job, config), "result": asdict(result)}
            atomic_write_text(_result_path(job, method), json.dumps(content, indent=1) + "\n")
            count += 1
    tracked = time.perf_counter()
    return f"{job.source.name}, rendered in {rendered - began:.0f} s, {count} methods in {tracked - rendered:.0f} s"


def _render(job: _Job) -> None:
    """Frames that are there are kept."""
    was_there = job.source.exists()
    try:
        write_sequence(job.source, job.recipe, "sparse")
    except BaseException:
        # Stopped before the scene was written it could not be gone on with.
        if not was_there and not (job.source / SCENE_NAME).is_file():
            shutil.rmtree(job.source, ignore_errors=True)
        raise


def _open_scene(source: Path) -> Studio:
    content = json.loads((source / SCENE_NAME).read_text(encoding="utf-8"))
    return Studio(Simulation.from_json(content["simulation"]))


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


def _track(job: _Job, config: TrackerConfig, scene: Studio) -> Result:
    truth = job.source / "poses.txt"
    sequence = open_sequence(job.source)
    with tempfile.TemporaryDirectory() as scratch, Path(os.devnull).open("w") as nowhere:
        run = Path(scratch) / "run"
        with redirect_stderr(nowhere):
            track_sequence(sequence, run, config=config)
        evaluation = evaluate_run(run, truth, plot=False)
        frames = read_frames(run / "frames.csv")
        with np.load(run / "map.npz") as content:
            point_map = dict(content)
    assert evaluation.nees is not None
    tracked = np.array(frames.status) == "tracking"
    columns = frames.columns
    offset, sigma = columns["disparity_offset"][-1], columns["disparity_offset_sigma"][-1]
    true = read_trajectory(truth)
    hosts = np.abs(point_map["timestamps"][:, None] - true.timestamps).argmin(axis=1)
    pixels = point_map["pixels"]
    depths = np.zeros((len(pixels), 3, 3))
    for host in np.unique(hosts):
        depths[hosts == host] = depths_around(scene, int(host), pixels[hosts == host])
    clear = ~consistency.depth_edges(depths)
    camera = StereoRectifier(sequence.camera).rectified
    true_points = consistency.points_of_depth(pixels[clear], depths[clear, 1, 1], camera, true.poses[hosts[clear]])
    nees = consistency.point_nees(point_map["points"][clear], point_map["covariances"][clear], true_points)
    per_frame = evaluation.nees.per_frame
    some, dof = len(nees) > 0, columns["dof"][tracked].sum()
    nan = float("nan")
    return Result(
        nees=evaluation.nees.mean,
        nees_last=float(per_frame[-1]) if len(per_frame) else nan,
        inside=consistency.coverage(per_frame, 6),
        nis=float(columns["nis"][tracked].sum() / dof) if dof else nan,
        ate=evaluation.ate.rmse,
        path_length=evaluation.path_length,
        offset_error=float(offset - OFFSET),
        offset_z=float((offset - OFFSET) / sigma) if sigma > 0 else nan,
        lost=int((~tracked[1:]).sum()),
        filter_ms=float(np.median(frames.milliseconds["filter"])),
        total_ms=float(np.median(frames.total_milliseconds)),
        points=int(clear.sum()),
        edges=int((~clear).sum()),
        point_nees=float(nees.mean()) if some else nan,
        point_median=float(np.median(nees)) if some else nan,
        point_inside=consistency.coverage(nees, 3),
        point_gross=float((3.0 * nees > _GROSS**2).mean()) if some else nan,
    )


def _result_path(job: _Job, method: str) -> Path:
    slug = "".join(letter if letter.isalnum() else "_" for letter in method)
    return job.runs / f"{job.source.name}-{slug}.json"


def _made_from(job: _Job, config: TrackerConfig) -> dict[str, object]:
    return {"recipe": asdict(job.recipe), "configuration": asdict(config), "code": job.code}


def _read_result(job: _Job, method: str) -> Result | None:
    """The result that is kept, unless it is of something else."""
    path = _result_path(job, method)
    if not path.is_file():
        return None
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError(f"{path} is no result of this benchmark ({error}): remove it") from error
    asked = json.loads(json.dumps(_made_from(job, METHODS[method])))
    return Result(**content["result"]) if content.get("made_from") == asked else None


def _code_hash() -> str:
    """Of everything between the images and a result: the tracker, its graphs, and this benchmark."""
    package = Path(inspect.getfile(TrackerConfig)).parent
    sources = list(package.glob("*.py"))
    sources += [path for folder in ("frontend", "readers") for path in (package / folder).glob("*.py")]
    sources += shipped_weights("features.onnx").parent.glob("*.onnx")
    sources += [Path(__file__), Path(consistency.__file__), Path(consistency.__file__).with_name("metrics.py")]
    digest = hashlib.sha256()
    for path in sorted(sources, key=lambda path: path.name):
        digest.update(path.read_bytes())
    return digest.hexdigest()
