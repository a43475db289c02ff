"""Processes that paint textures and then render pairs of our worlds for as long as they are let, into files in memory.

A place of the files is written once, and counted afterwards; a process that dies leaves its places empty.
"""

import multiprocessing
import os
import time
import traceback
from pathlib import Path

import numpy as np

WORLDS = ("street", "street", "room", "drone", "organ", "rubble", "street", "colon", "room", "tool")
"""One after another."""
_VIEWS = 5  # of a scene
_BASELINES = (0.012, 0.14)  # median depths
_FOCAL = (0.55, 1.3)  # widths
_KINDS = ("leaves",) * 5 + (
    "noise",
    "facade",
    "asphalt",
    "grass",
    "tissue",
    "wood",
    "plaster",
    "stripes",
    "bricks",
    "checker",
    "cells",
    "strokes",
    "glyphs",
    "vessels",
)


class RenderedPairs:
    """The processes and what they have made.

    Args:
        folder: of the files.
        seed: of everything.
        size: (H, W) of the images.
        workers: processes.
        places: pairs that each may render at most.
        textures: that each paints first.
        texture_size: their side.
    """

    def __init__(
        self, folder: Path, seed: int, size: tuple[int, int], workers: int, places: int, textures: int, texture_size: int
    ) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder, self._size, self._shape = folder, size, (workers, places, textures, texture_size)
        for name, (kind, shape) in _files(size, *self._shape).items():
            np.memmap(folder / name, kind, "w+", shape=shape).flush()
        context = multiprocessing.get_context("spawn")
        self._processes = [
            context.Process(target=_work, args=(folder, seed, size, self._shape, k), daemon=True)
            for k in range(workers)
        ]
        for process in self._processes:
            process.start()
        self._files = _open(folder, size, self._shape)
        self._taken = np.zeros(workers, np.int64)

    @property
    def painted(self) -> np.ndarray:
        """Textures (N, S, S) uint8 that are done."""
        counts = self._files["counts"][:, 1]
        return np.concatenate([self._files["textures"][k, :n] for k, n in enumerate(counts)])

    def new(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Images (2, H, W) float16 and disparities (H, W) float32 of pairs that have come since the last call."""
        found = []
        for k, count in enumerate(self._files["counts"][:, 0].copy()):
            for place in range(self._taken[k], count):
                found.append((np.array(self._files["images"][k, place]), np.array(self._files["disparity"][k, place])))
            self._taken[k] = count
        return found

    @property
    def alive(self) -> int:
        """Processes that still work."""
        return sum(process.is_alive() for process in self._processes)

    def close(self) -> None:
        """Ends the processes."""
        for process in self._processes:
            process.kill()
        for process in self._processes:
            process.join(5.0)


def _files(
    size: tuple[int, int], workers: int, places: int, textures: int, texture_size: int
) -> dict[str, tuple[type, tuple[int, ...]]]:
    return {
        "counts": (np.int64, (workers, 2)),
        "images": (np.float16, (workers, places, 2, *size)),
        "disparity": (np.float32, (workers, places, *size)),
        "textures": (np.uint8, (workers, textures, texture_size, texture_size)),
    }


def _open(folder: Path, size: tuple[int, int], shape: tuple[int, int, int, int]) -> dict[str, np.memmap]:
    return {name: np.memmap(folder / name, kind, "r+", shape=each) for name, (kind, each) in _files(size, *shape).items()}


def _work(folder: Path, seed: int, size: tuple[int, int], shape: tuple[int, int, int, int], worker: int) -> None:
    os.environ["OMP_NUM_THREADS"] = "1"
    os.nice(2)
    import torch

    from sigmaslam_synthetic.rendering.textures import paint

    torch.set_num_threads(1)
    files = _open(folder, size, shape)
    _, places, textures, side = shape
    rng = np.random.default_rng((seed, 1, worker))
    for k in range(textures):
        kind = _KINDS[int(rng.integers(len(_KINDS)))]
        files["textures"][worker, k] = paint(kind, side, int(rng.integers(2**62)))
        files["counts"][worker, 1] = k + 1
    done, scene = 0, 0
    parent = os.getppid()
    while done < places and os.getppid() == parent:
        try:
            for images, disparity in render_scene(seed, worker, scene, size):
                if done < places:
                    files["images"][worker, done], files["disparity"][worker, done] = images, disparity
                    done += 1
                    files["counts"][worker, 0] = done
        except Exception:  # a world may fail to be made; the next one may not
            traceback.print_exc()
            time.sleep(0.2)
        scene += 1


def render_scene(seed: int, worker: int, scene: int, size: tuple[int, int]):  # type: ignore[no-untyped-def]
    """Yields images (2, H, W) and disparities (H, W), NaN where there is nothing, of views of one scene."""
    import torch

    from sigmaslam.geometry.camera import CameraModel
    from sigmaslam.geometry.se3 import rigid_motion
    from sigmaslam_synthetic.rendering.renderer import Renderer
    from sigmaslam_synthetic.rendering.visibility import Eye
    from sigmaslam_synthetic.worlds import colon, hall, organ, room, rubble, street, tool
    from sigmaslam_synthetic.worlds.episode import Wish

    worlds = {
        "room": room,
        "street": street,
        "drone": hall,
        "colon": colon,
        "organ": organ,
        "tool": tool,
        "rubble": rubble,
    }
    rng = np.random.default_rng((seed, 2, worker, scene))
    world = worlds[WORLDS[(worker * 3 + scene) % len(WORLDS)]]
    wish = Wish(8.0, movers=float(rng.uniform(0.0, 0.3)), first_texture=int(rng.integers(2**40)), textures=4)
    episode = world.generate(rng, wish)
    renderer = Renderer(episode.scene)
    height, width = size
    for _ in range(_VIEWS):
        time_ = rng.uniform(0.5, 7.5, 1)
        T = episode.path.poses(time_)
        turn = 0.08 * rng.standard_normal(3)
        cos, sin = np.cos(turn[2]), np.sin(turn[2])
        T = T @ rigid_motion(np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]]), [0.0, 0.0, 0.0])
        focal = float(width * np.exp(rng.uniform(*np.log(_FOCAL))))
        eye = Eye(CameraModel(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2))
        with torch.inference_mode():
            left = renderer.render(eye, T, time_)
            depth = left.depth[0].numpy()
            if not np.isfinite(depth).any():
                continue
            baseline = float(np.median(depth[np.isfinite(depth)]) * np.exp(rng.uniform(*np.log(_BASELINES))))
            right = renderer.render(eye, T @ rigid_motion(np.eye(3), [baseline, 0.0, 0.0]), time_)
        disparity = (focal * baseline / depth).astype(np.float32)
        images = np.stack([left.image[0].numpy(), right.image[0].numpy()])
        if np.isfinite(images).all():
            yield np.minimum(images, 8.0).astype(np.float16), np.where(np.isfinite(depth), disparity, np.float32(0.0))
