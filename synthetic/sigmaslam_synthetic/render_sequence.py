"""Writes rendered stereo sequences with exact truth: in parallel, and again from where it stopped.

A folder holds the images in KITTI's or EuRoC's layout with calibration, times and true poses; `scene.json`, from which
everything can be made again; `truth/NNNNNN.npz` for each frame; `landmarks.npz`; and, if asked for, an inertial sensor.
"""

import hashlib
import json
import os
import shlex
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from sigmaslam.errors import InputError, OutputError
from sigmaslam.files import atomic_write_bytes, atomic_write_text, check_new_folder
from sigmaslam_synthetic.landmark_tracks import Landmarks, choose_landmarks, observe
from sigmaslam_synthetic.layouts import image_paths, save_arrays, write_inertial, write_layout
from sigmaslam_synthetic.parallel_jobs import list_failures, run_jobs
from sigmaslam_synthetic.render_choices import TRUTHS
from sigmaslam_synthetic.simulation import Frame, Recipe, Simulation, Studio, inertial_of, simulate

SCENE_NAME, LANDMARKS_NAME = "scene.json", "landmarks.npz"
_BEGUN_NAME = ".begun.json"
_CHUNK = 8  # frames handed to a process at a time, at most
_TRACK_KEYS = ("landmark", "left", "right", "left_visible", "right_visible", "depth")


def write_sequence(
    out: Path,
    recipe: Recipe,
    truth: str = "dense",
    workers: int = 1,
    device: str = "cpu",
    ray: str | None = None,
    done: Callable[[int], None] = lambda frames: None,
) -> int:
    """Renders a sequence into a folder; frames that are there already are kept.

    Args:
        out: new, empty, or left from the same recipe.
        recipe: what to render.
        truth: 'dense' for depth, instance ids, flow and occlusion of every pixel beside the landmarks; 'sparse' for
            the landmarks alone.
        device: where frames are drawn.
        ray: address of a Ray cluster that renders instead, as `run_jobs` takes it; all its machines must share `out`.
        done: called with the number of frames that are there.
    Returns:
        How many frames were there before.
    Raises:
        InputError: the recipe is wrong, or the folder holds something else.
    """
    if truth not in TRUTHS:
        raise InputError(f"truth {truth!r} is unknown; choose one of {', '.join(TRUTHS)}")
    recipe.check()
    prepare(out, recipe, truth)
    # The truth of a frame is the last of its files.
    missing = [k for k in range(recipe.frames) if not _truth_path(out, k).is_file()]
    before = recipe.frames - len(missing)
    done(before)
    size = int(np.clip(len(missing) // (4 * workers), 1, _CHUNK))
    film = _Film(out.resolve(), truth, device)
    chunks = [missing[k : k + size] for k in range(0, len(missing), size)]
    count = before

    def ended(_: list[int], written: int | Exception) -> None:
        nonlocal count
        if isinstance(written, Exception):
            raise written
        count += written
        done(count)

    if ray is None and min(workers, len(chunks)) <= 1:
        opened = film.open() if missing else None
        for number in missing:
            ended([number], _write_chunk(film, [number], opened))
    else:
        run_jobs(partial(_write_chunk, film), chunks, workers, ended, ray, int(device != "cpu"))
    join_tracks(out, recipe.frames)
    return before


def write_sequences(
    out: Path,
    recipes: Sequence[Recipe],
    truth: str = "dense",
    workers: int = 1,
    device: str = "cpu",
    ray: str | None = None,
    done: Callable[[int], None] = lambda sequences: None,
) -> None:
    """Renders sequences into folders of their names, each in one worker.

    Args:
        out: the folder of these folders; arguments are else as of `write_sequence`.
        recipes: what to render; their names differ.
        done: called with the number of sequences that have ended.
    Raises:
        InputError: a recipe is wrong.
        OutputError: sequences failed; the others are there.
    """
    for recipe in recipes:
        recipe.check()
    failed: dict[str, Exception] = {}
    count = 0

    def ended(recipe: Recipe, outcome: int | Exception) -> None:
        nonlocal count
        if isinstance(outcome, Exception):
            failed[recipe.name] = outcome
        count += 1
        done(count)

    run_jobs(partial(_render, out.resolve(), truth, device), recipes, workers, ended, ray, int(device != "cpu"))
    if failed:
        raise OutputError(f"{out} lacks {list_failures(failed)}: the same command tries what is missing again")


def prepare(out: Path, recipe: Recipe, truth: str) -> None:
    """Makes the folder with all but its frames, or checks the one that is there.

    Raises:
        InputError: the folder holds something else.
    """
    asked: dict[str, Any] = {"recipe": asdict(recipe), "truth": truth}
    if recipe.world is not None:
        asked["world_sha256"] = hashlib.sha256(Path(recipe.world).read_bytes()).hexdigest()
    scene = out / SCENE_NAME
    if scene.is_file():
        try:
            content: dict[str, Any] = json.loads(scene.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise InputError(f"{scene} cannot be read ({error}); remove it or choose another --out") from error
        # Folders from before there were worlds of one's own, and inertial sensors, lack the keys.
        there = {name: content.get(name, wish) for name, wish in asked.items()}
        there["recipe"] = {"world": None, "imu": None, **content.get("recipe", {})}
        if there != asked:
            raise InputError(f"{scene} was made with {there}, not {asked}; choose another --out")
        return
    # Where this process is killed before the scene is written, the same recipe may begin again.
    begun, text = out / _BEGUN_NAME, json.dumps(asked)
    again = begun.is_file() and begun.read_text(encoding="utf-8") == text
    if not again:
        check_new_folder(out)
    simulation = simulate(recipe)
    if not again:
        out.mkdir(parents=True, exist_ok=True)
        atomic_write_text(begun, text)
    (out / "truth").mkdir(exist_ok=True)
    write_layout(out, simulation)
    if recipe.imu is not None:
        write_inertial(out, simulation, inertial_of(recipe, simulation))
    save_arrays(out / LANDMARKS_NAME, asdict(choose_landmarks(Studio(simulation))))
    # The last to be written: a folder with scene.json is complete but for its frames.
    content = {**asked, "command": command(recipe, truth), "simulation": simulation.to_json()}
    atomic_write_text(scene, json.dumps(content) + "\n")
    begun.unlink()


def write_frames(out: Path, studio: Studio, landmarks: Landmarks, truth: str, numbers: list[int]) -> int:
    """Renders and writes these frames; returns how many."""
    batch = 1 if studio.renderer.device.type == "cpu" else _CHUNK
    for start in range(0, len(numbers), batch):
        part = numbers[start : start + batch]
        left, right = studio.views(np.array(part))
        frames = studio.frames(np.array(part), (left, right))
        for view, (number, frame) in enumerate(zip(part, frames, strict=True)):
            for path, image in zip(image_paths(out, studio.simulation, number), (frame.left, frame.right), strict=True):
                atomic_write_bytes(path, cv2.imencode(".png", image)[1].tobytes())
            tracks = observe(landmarks, left.sight, right.sight, view)
            save_arrays(_truth_path(out, number), _truth_of(tracks, frame, truth))
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
    save_arrays(out / LANDMARKS_NAME, {**landmarks, **{f"track_{key}": np.concatenate(v) for key, v in rows.items()}})


def command(recipe: Recipe, truth: str) -> str:
    """The command line that writes the same folder again."""
    plain = Recipe(recipe.preset, recipe.frames)
    words = ["sigmaslam", "train", "render", recipe.preset, "--out", "DIR", "--frames", str(recipe.frames)]
    for name, value in asdict(recipe).items():
        if name not in ("preset", "frames") and (value != getattr(plain, name) or name == "seed"):
            words += [f"--{name.replace('_', '-')}", str(value)]
    return shlex.join(words if truth == "dense" else [*words, "--truth", truth])


def _render(out: Path, truth: str, device: str, recipe: Recipe) -> int:
    return write_sequence(out / recipe.name, recipe, truth, device=device)


@dataclass(frozen=True, slots=True)
class _Film:
    """A sequence whose frames are to be written."""

    out: Path
    truth: str
    device: str

    def open(self) -> tuple[Studio, Landmarks]:
        """What all frames are made with."""
        content = json.loads((self.out / SCENE_NAME).read_text(encoding="utf-8"))
        with np.load(self.out / LANDMARKS_NAME) as arrays:
            landmarks = Landmarks(arrays["points"], arrays["facet"], arrays["body"])
        return Studio(Simulation.from_json(content["simulation"]), self.device), landmarks


def _write_chunk(film: _Film, numbers: list[int], opened: tuple[Studio, Landmarks] | None = None) -> int:
    with torch.inference_mode():
        studio, landmarks = opened or _open_once(film)
        return write_frames(film.out, studio, landmarks, film.truth, numbers)


@lru_cache(maxsize=1)
def _open_once(film: _Film) -> tuple[Studio, Landmarks]:
    """Of a worker, which has many chunks of one sequence."""
    return film.open()


def _truth_of(observed: dict[str, np.ndarray], frame: Frame, truth: str) -> dict[str, np.ndarray]:
    tracks = {f"track_{key}": value for key, value in observed.items()}
    if truth == "sparse":
        return tracks
    images = {key: value for key, value in asdict(frame).items() if key not in ("left", "right")}
    return {**images, **tracks}


def _truth_path(out: Path, frame: int) -> Path:
    return out / "truth" / f"{frame:06d}.npz"


def default_workers() -> int:
    """One process a core."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
