"""Writes rendered stereo sequences with exact truth: in parallel, and again from where it stopped.

A folder holds the images in KITTI's or EuRoC's layout with calibration, times and true poses; `scene.json`, from which
everything can be made again; `truth/NNNNNN.npz` for each frame; and `landmarks.npz`.
"""

from __future__ import annotations

import json
import os
import zipfile
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from sigmaslam.errors import InputError
from sigmaslam.files import atomic_path, atomic_write_text, check_new_folder
from sigmaslam.synthetic.landmark_tracks import Landmarks, choose_landmarks, observe
from sigmaslam.synthetic.layouts import image_paths, write_layout
from sigmaslam.synthetic.render_choices import TRUTHS
from sigmaslam.synthetic.simulation import Frame, Recipe, Simulation, Studio, simulate

SCENE_NAME, LANDMARKS_NAME = "scene.json", "landmarks.npz"
_CHUNK = 8  # frames handed to a process at a time, at most
_TRACK_KEYS = ("landmark", "left", "right", "left_visible", "right_visible", "depth")


def write_sequence(
    out: Path,
    recipe: Recipe,
    truth: str = "dense",
    workers: int = 1,
    device: str = "cpu",
    ray: bool = False,
    done: Callable[[int], None] = lambda frames: None,
) -> int:
    """Renders a sequence into a folder; frames that are there already are kept.

    Args:
        out: new, empty, or left from the same recipe.
        recipe: what to render.
        truth: 'dense' for depth, instance ids, flow and occlusion of every pixel beside the landmarks; 'sparse' for
            the landmarks alone.
        workers: processes.
        device: where frames are drawn.
        ray: spread the frames over a Ray cluster instead; `out` must be a folder that all its machines share.
        done: called with the number of frames that are there.
    Returns:
        How many frames were there before.
    Raises:
        InputError: the recipe is wrong, or the folder holds something else.
    """
    if truth not in TRUTHS:
        raise InputError(f"truth {truth!r} is unknown; choose one of {', '.join(TRUTHS)}")
    recipe.check()
    description = prepare(out, recipe, truth)
    missing = missing_frames(out, recipe.frames)
    before = recipe.frames - len(missing)
    done(before)
    size = int(np.clip(len(missing) // (4 * workers), 1, _CHUNK))
    chunks = [missing[k : k + size] for k in range(0, len(missing), size)]
    count = before
    crew = _ray_crew if ray else _film_crew
    with crew(out, description, truth, min(workers, len(chunks)), device) as film:
        for finished in film(chunks):
            count += finished
            done(count)
    join_tracks(out, recipe.frames)
    return before


def prepare(out: Path, recipe: Recipe, truth: str) -> dict[str, Any]:
    """Makes the folder with all but its frames, or checks the one that is there; returns the simulation as JSON.

    Raises:
        InputError: the folder holds something else.
    """
    asked = {"recipe": asdict(recipe), "truth": truth}
    scene = out / SCENE_NAME
    if scene.is_file():
        try:
            content: dict[str, Any] = json.loads(scene.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise InputError(f"{scene} cannot be read ({error}); remove it or choose another --out") from error
        # Folders from before there were worlds of one's own lack the key.
        there = {"recipe": {"world": None, **content.get("recipe", {})}, "truth": content.get("truth")}
        if there != asked:
            raise InputError(f"{scene} was made with {there}, not {asked}; choose another --out")
        return dict(content["simulation"])
    check_new_folder(out)
    simulation = simulate(recipe)
    description = simulation.to_json()
    (out / "truth").mkdir(parents=True)
    write_layout(out, simulation)
    studio = Studio(simulation)
    landmarks = choose_landmarks(studio)
    _save(out / LANDMARKS_NAME, asdict(landmarks))
    # The last to be written: a folder with scene.json is complete but for its frames.
    atomic_write_text(scene, json.dumps({**asked, "command": command(recipe, truth), "simulation": description}) + "\n")
    return description


def missing_frames(out: Path, frames: int) -> list[int]:
    """Numbers of the frames whose truth, the last of their files, is not there."""
    return [k for k in range(frames) if not _truth_path(out, k).is_file()]


def write_frames(out: Path, studio: Studio, landmarks: Landmarks, truth: str, numbers: list[int]) -> int:
    """Renders and writes these frames; returns how many."""
    batch = 1 if studio.renderer.device.type == "cpu" else _CHUNK
    for start in range(0, len(numbers), batch):
        part = numbers[start : start + batch]
        left, right = studio.views(np.array(part))
        frames = studio.frames(np.array(part), (left, right))
        for view, (number, frame) in enumerate(zip(part, frames, strict=True)):
            for path, image in zip(image_paths(out, studio.simulation, number), (frame.left, frame.right), strict=True):
                _write_image(path, image)
            tracks = observe(landmarks, left.sight, right.sight, view)
            _save(_truth_path(out, number), _truth_of(tracks, frame, truth))
    return len(numbers)


def join_tracks(out: Path, frames: int) -> None:
    """Adds the observations of all frames to landmarks.npz, one row a landmark and frame."""
    with np.load(out / LANDMARKS_NAME) as content:
        landmarks = {key: content[key] for key in ("points", "facet", "body")}
    rows: dict[str, list[np.ndarray]] = {key: [] for key in ("frame", *_TRACK_KEYS)}
    for k in range(frames):
        with np.load(_truth_path(out, k)) as content:
            for key in _TRACK_KEYS:
                rows[key].append(content[f"track_{key}"])
        rows["frame"].append(np.full(len(rows["landmark"][-1]), k))
    _save(out / LANDMARKS_NAME, {**landmarks, **{f"track_{key}": np.concatenate(v) for key, v in rows.items()}})


def command(recipe: Recipe, truth: str) -> str:
    """The command line that writes the same folder again."""
    plain = Recipe(recipe.preset, recipe.frames)
    words = ["sigmaslam", "render", recipe.preset, "--out", "DIR", "--frames", str(recipe.frames)]
    for name, value in asdict(recipe).items():
        if name not in ("preset", "frames") and (value != getattr(plain, name) or name == "seed"):
            words += [f"--{name.replace('_', '-')}", str(value)]
    return " ".join(words if truth == "dense" else [*words, "--truth", truth])


@contextmanager
def _film_crew(
    out: Path, description: dict[str, Any], truth: str, workers: int, device: str
) -> Iterator[Callable[[list[list[int]]], Iterable[int]]]:
    """Something that films chunks of frames, here or in processes, and yields how many are done."""
    if workers <= 1:
        crew = _Crew(out, description, truth, device)
        yield lambda chunks: (crew.film([number]) for chunk in chunks for number in chunk)
        return
    context = get_context("spawn")
    with ProcessPoolExecutor(workers, context, _start_worker, (out, description, truth, device)) as pool:
        try:
            yield lambda chunks: pool.map(_work, chunks)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


@contextmanager
def _ray_crew(
    out: Path, description: dict[str, Any], truth: str, workers: int, device: str
) -> Iterator[Callable[[list[list[int]]], Iterable[int]]]:
    """The same on a Ray cluster: the one that RAY_ADDRESS names, or this machine."""
    try:
        import ray
        from ray.util import ActorPool
    except ImportError as error:
        raise InputError(f"{error.name} is not installed: pip install 'sigmaslam[scale]'") from error
    if not ray.is_initialized():
        ray.init(log_to_driver=False)
    # Ray itself sees to it that an actor of one processor keeps to one thread.
    actor = ray.remote(num_cpus=1, num_gpus=0 if device == "cpu" else 1)(_Crew)
    resources: dict[str, float] = ray.cluster_resources()  # type: ignore[no-untyped-call, unused-ignore]
    size = max(1, int(resources.get("CPU" if device == "cpu" else "GPU", 1)))
    pool = ActorPool([actor.remote(out.resolve(), description, truth, device) for _ in range(size)])
    try:
        yield lambda chunks: pool.map(lambda crew, chunk: crew.film.remote(chunk), chunks)
    finally:
        ray.shutdown()


class _Crew:
    """A studio with its landmarks, made once for many frames."""

    def __init__(self, out: Path, description: dict[str, Any], truth: str, device: str) -> None:
        self._out, self._truth = out, truth
        self._studio = Studio(Simulation.from_json(description), device)
        with np.load(out / LANDMARKS_NAME) as content:
            self._landmarks = Landmarks(content["points"], content["facet"], content["body"])

    def film(self, numbers: list[int]) -> int:
        """Renders and writes these frames; returns how many."""
        with torch.inference_mode():
            return write_frames(self._out, self._studio, self._landmarks, self._truth, numbers)


_crew: _Crew | None = None


def _start_worker(out: Path, description: dict[str, Any], truth: str, device: str) -> None:
    global _crew
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    _crew = _Crew(out, description, truth, device)


def _work(numbers: list[int]) -> int:
    assert _crew is not None
    return _crew.film(numbers)


def _truth_of(observed: dict[str, np.ndarray], frame: Frame, truth: str) -> dict[str, np.ndarray]:
    tracks = {f"track_{key}": value for key, value in observed.items()}
    if truth == "sparse":
        return tracks
    images = {key: value for key, value in asdict(frame).items() if key not in ("left", "right")}
    return {**images, **tracks}


def _truth_path(out: Path, frame: int) -> Path:
    return out / "truth" / f"{frame:06d}.npz"


def _save(path: Path, arrays: dict[str, Any]) -> None:
    """A .npz like numpy's compressed ones, at the fastest level: numpy's own takes as long as the rendering."""
    with (
        atomic_path(path) as temporary,
        zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
    ):
        for name, array in arrays.items():
            info = zipfile.ZipInfo(f"{name}.npy")  # with a fixed date: the same arrays are the same bytes
            info.compress_type = zipfile.ZIP_DEFLATED
            with archive.open(info, "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.ascontiguousarray(array), allow_pickle=False)


def _write_image(path: Path, image: np.ndarray) -> None:
    ok, encoded = cv2.imencode(".png", image)
    if not ok:
        raise InputError(f"{path} cannot be encoded as PNG")
    with atomic_path(path) as temporary:
        temporary.write_bytes(encoded.tobytes())


def default_workers() -> int:
    """One process a core."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
