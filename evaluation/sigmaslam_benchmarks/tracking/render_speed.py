"""How fast renders are made on two cores: homography pairs, training pairs of scenes, stereo pairs with all truth."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from multiprocessing import get_context
from multiprocessing.synchronize import Barrier
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from sigmaslam_synthetic.simulation import Studio

PROCESSES = 2
SIZES = ((320, 240), (640, 480))
GOALS = {"homography": 100.0, "320x240": 8.0, "640x480": 2.0}
"""Pairs a second that were asked for, by what is made."""
_PAIR_SIZE = 224
_REPEATS = 4
_HOMOGRAPHY_PAIRS = 100  # of a repeat and process, like all below
_SCENE_PAIRS = 32  # so many come from a scene before it is replaced: in each repeat one new scene is made
_SCENE_REPEATS = 3
_STEREO_PAIRS = 2
_SEED = 0

# A repeat of a process: wall clock at its start and end, CPU seconds, number of pairs.
_Lap = tuple[float, float, float, int]


@dataclass(frozen=True, slots=True)
class Speed:
    """How fast something is made by two processes of one thread each.

    Attributes:
        name: of what is made.
        goal: pairs a second, None where none was set.
        rates: pairs a second of both together, one a repeat.
        cpu: CPU seconds a pair, one a repeat.
        preparation: CPU seconds of a process before its first pair: to make the world.
    """

    name: str
    goal: float | None
    rates: list[float]
    cpu: list[float]
    preparation: float


def measure_speeds(note: Callable[[str], None] = lambda text: None) -> list[Speed]:
    """Times everything; needs the machine for itself, or only the CPU seconds mean something."""
    from sigmaslam_synthetic.presets import PRESETS

    note("timing homography pairs")
    speeds = [_measure("homography pairs 224x224", GOALS["homography"], "homography", "")[0]]
    note("timing pairs of scenes")
    speeds += _measure("scene pairs 224x224", None, "scenes", "")
    for preset in PRESETS:
        note(f"timing stereo pairs of {preset}")
        speeds += _measure(preset, None, "stereo", preset)
    return speeds


def speed_rows(speeds: list[Speed]) -> list[list[str]]:
    """Rows of the page's table, with median, lowest and highest repeat."""
    rows = []
    for speed in speeds:
        reached = "" if speed.goal is None else "yes" if np.median(speed.rates) >= speed.goal else "**no**"
        goal = "" if speed.goal is None else f"{speed.goal:g}"
        rows.append([speed.name, _spread(speed.rates), goal, reached, _spread(speed.cpu), f"{speed.preparation:.1f}"])
    return rows


def describe_machine() -> str:
    """Processor, cores and how busy it is."""
    name = platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        models = [line.partition(":")[2] for line in cpuinfo.read_text().splitlines() if line.startswith("model name")]
        name = models[0].strip() if models else name
    text = f"{name}, {os.cpu_count()} cores"
    return f"{text}, load average {os.getloadavg()[0]:.1f} before" if hasattr(os, "getloadavg") else text


def _measure(name: str, goal: float | None, kind: str, preset: str) -> list[Speed]:
    """Both processes do the same in step; a stereo preset gives a speed a size."""
    context = get_context("spawn")
    barrier = context.Barrier(PROCESSES)
    with context.Pool(PROCESSES, _start, (barrier,)) as pool:
        # Whoever has taken a job waits for the other at the barrier, so that each gets one.
        results = pool.starmap(_work, [(kind, preset, _SEED + worker) for worker in range(PROCESSES)], chunksize=1)
    speeds = []
    for part in range(len(results[0][1])):
        laps = [result[1][part] for result in results]
        rates, cpu = [], []
        for repeat in zip(*laps, strict=True):
            pairs = sum(lap[3] for lap in repeat)
            rates.append(pairs / (max(lap[1] for lap in repeat) - min(lap[0] for lap in repeat)))
            cpu.append(sum(lap[2] for lap in repeat) / pairs)
        size = "x".join(map(str, SIZES[part])) if kind == "stereo" else ""
        preparation = float(np.mean([result[0] for result in results]))
        speeds.append(Speed(f"{name} {size}".strip(), GOALS.get(size, goal), rates, cpu, preparation))
    return speeds


_barrier: Barrier | None = None


def _start(barrier: Barrier) -> None:
    global _barrier
    import cv2
    import torch

    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    _barrier = barrier


def _work(kind: str, preset: str, seed: int) -> tuple[float, list[list[_Lap]]]:
    """CPU seconds of the preparation, and the laps of each part."""
    assert _barrier is not None
    _barrier.wait()
    begun = time.process_time()
    if kind == "stereo":
        return _work_stereo(preset, seed)
    if kind == "homography":
        from sigmaslam_synthetic.homography_pairs import HomographyPairs

        make: Callable[[int], object] = HomographyPairs(seed, _PAIR_SIZE).pair
        first, pairs, repeats = 8, _HOMOGRAPHY_PAIRS, _REPEATS
    else:
        from sigmaslam_synthetic.scene_pairs import ScenePairs

        make = ScenePairs(seed, _PAIR_SIZE).pair
        first, pairs, repeats = 8, _SCENE_PAIRS, _SCENE_REPEATS
    for index in range(first):
        make(index)
    preparation = time.process_time() - begun
    return preparation, [[_lap(make, first + k * pairs, pairs) for k in range(repeats)]]


def _work_stereo(preset: str, seed: int) -> tuple[float, list[list[_Lap]]]:
    import torch

    from sigmaslam_synthetic.camera.rig import Miscalibration
    from sigmaslam_synthetic.presets import PRESETS
    from sigmaslam_synthetic.simulation import Recipe, Studio, simulate

    frames = _STEREO_PAIRS * (_REPEATS + 1)
    begun = time.process_time()
    simulation = simulate(Recipe(preset, frames, seed, width=SIZES[0][0], height=SIZES[0][1]))
    Studio(simulation)
    preparation = time.process_time() - begun
    parts = []
    for width, height in SIZES:
        rig = PRESETS[preset].rig(width, height, np.random.default_rng(seed), Miscalibration())
        make = _frame_maker(Studio(replace(simulation, rig=rig)))
        with torch.inference_mode():
            # The first lap fills caches and is left out.
            laps = [_lap(make, k * _STEREO_PAIRS, _STEREO_PAIRS) for k in range(_REPEATS + 1)]
        parts.append(laps[1:])
    return preparation, parts


def _frame_maker(studio: Studio) -> Callable[[int], object]:
    return lambda number: studio.frames(np.array([number]))


def _lap(make: Callable[[int], object], first: int, pairs: int) -> _Lap:
    """Makes pairs from the number `first` on, when the other process is ready too."""
    assert _barrier is not None
    _barrier.wait()
    started, cpu = time.monotonic(), time.process_time()
    for index in range(first, first + pairs):
        make(index)
    return started, time.monotonic(), time.process_time() - cpu, pairs


def _spread(values: list[float]) -> str:
    return f"{np.median(values):.3g} ({min(values):.3g} - {max(values):.3g})"
