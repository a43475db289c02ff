"""Processes that render scenes and paint textures for ever, and a queue that brings them."""

import multiprocessing
import queue
import traceback
from typing import Any

import numpy as np
import torch

DOMAINS = ("room", "room", "street", "street", "street", "drone", "drone", "organ", "colon")
_KINDS = ("leaves", "leaves", "leaves", "facade", "plaster", "wood", "noise", "bricks", "cells", "strokes", "glyphs")
_KINDS_MORE = ("stripes", "checker", "asphalt", "grass", "tissue", "vessels")
_PAINTED_FIRST, _PAINTED_LATER = 24, 4
_TEXTURE = 512


def paint_textures(rng: np.random.Generator, count: int) -> np.ndarray:
    """(count, 512, 512) uint8."""
    from sigmaslam_synthetic.rendering.textures import paint

    kinds = _KINDS * 2 + _KINDS_MORE
    return np.stack([paint(kinds[rng.integers(len(kinds))], _TEXTURE, int(rng.integers(2**62))) for _ in range(count)])


def render_scene(seed: int, scene: int, size: int) -> dict[str, np.ndarray]:
    """Eight views of one scene from directions up to 60 degrees apart; 64 scenes of a seed share textures."""
    from sigmaslam_synthetic.scene_pairs import ScenePairs

    pairs = ScenePairs(seed, size, DOMAINS, max_moving_share=0.0, wide=True)
    with torch.inference_mode():
        views = pairs._render(scene)
    cameras = [view.sight.eye for view in views]
    return {
        "light": np.stack([view.image[0].numpy() for view in views]).astype(np.float16),
        "depth": np.stack([view.depth[0].float().numpy() for view in views]),
        "camera": np.array([(eye.fx, eye.cx, eye.cy) for eye in cameras], np.float32),
        "T_world_camera": np.stack([np.linalg.inv(view.sight.T_view_mover[0, 0].numpy()) for view in views]),
    }


def _work(worker: int, seed: int, size: int, results: Any) -> None:
    torch.set_num_threads(1)
    rng = np.random.default_rng((seed, worker))
    paints, failures, scene = _PAINTED_FIRST, 0, 0
    while failures < 20:
        made = []
        try:
            made.append(("textures", paint_textures(rng, paints)))
            paints = _PAINTED_LATER
            made.append(("scene", render_scene(1000 * (seed + 1) + worker, scene, size)))
        except Exception:
            failures += 1
            made.append(("failure", traceback.format_exc()))
        scene += 1
        for each in made:
            while True:
                try:
                    results.put(each, timeout=2.0)
                    break
                except queue.Full:
                    parent = multiprocessing.parent_process()
                    if parent is None or not parent.is_alive():
                        return


class SceneFeed:
    """Workers and what they have made.

    Args:
        workers: processes.
        seed: of all.
        size: side of the images.
    """

    def __init__(self, workers: int, seed: int, size: int) -> None:
        context = multiprocessing.get_context("spawn")
        self._results = context.Queue(maxsize=2 * workers + 2)
        self._processes = [
            context.Process(target=_work, args=(k, seed, size, self._results), daemon=True) for k in range(workers)
        ]
        for process in self._processes:
            process.start()

    def arrived(self, most: int = 4) -> list[tuple[str, Any]]:
        """What has come since the last call, at most so much."""
        found = []
        while len(found) < most:
            try:
                found.append(self._results.get_nowait())
            except queue.Empty:
                break
            except Exception as error:  # what a killed worker left half written
                found.append(("failure", repr(error)))
                break
        return found

    def alive(self) -> int:
        """Workers that run."""
        return sum(process.is_alive() for process in self._processes)

    def stop(self) -> None:
        """Ends all of them."""
        for process in self._processes:
            process.kill()
        for process in self._processes:
            process.join(2.0)
        self._results.cancel_join_thread()
