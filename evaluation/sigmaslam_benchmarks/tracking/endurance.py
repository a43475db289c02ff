"""A rendered lap tracked over and over, with the outputs of `sigmaslam track`: memory, time a frame, error of a lap."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from sigmaslam.bundle_adjustment.track_file import TRACKS_NAME
from sigmaslam.errors import InputError
from sigmaslam.geometry.se3 import se3_inverse
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.readers import StereoFrame, StereoSequence
from sigmaslam.readers.images import PairSource, RawPair
from sigmaslam.readers.trajectory_files import read_trajectory
from sigmaslam.runs.request import TrackerOptions
from sigmaslam.slam.tracker import TrackerConfig
from sigmaslam_benchmarks.rendered_camera import open_rendered
from sigmaslam_benchmarks.tracking.endurance_page import Block, Endurance, Lap, format_endurance
from sigmaslam_benchmarks.tracking.page import write_page
from sigmaslam_benchmarks.trial import Trial, TrialResult, read_trial, render, track_ours
from sigmaslam_synthetic.render_sequence import default_workers
from sigmaslam_synthetic.simulation import Recipe

LAP = Recipe("room", 400, 3000, "loop", width=320, height=240)
"""A path that ends one frame before its start, with the same velocity."""
BLOCK = 500
"""Frames that memory and time are told of together."""
_BEYOND = 60  # frames of the second lap that the run without loops goes on for


class LappedPairs(PairSource):
    """A lap over and over, in memory from the start; time goes on.

    Args:
        lap: whose last frame comes two frames before its first.
        frames: in all.
    """

    def __init__(self, lap: StereoSequence, frames: int) -> None:
        self._frames = list(lap.frames())
        if len(self._frames) < 2:
            raise InputError(f"{lap.source} has {len(self._frames)} frames: a lap needs at least two")
        step = self._frames[1].timestamp - self._frames[0].timestamp
        self.period = self._frames[-1].timestamp - self._frames[0].timestamp + 2.0 * step
        self.lap_frames = len(self._frames)
        self.length = self._count = frames
        self.source = lap.source

    def __iter__(self) -> Iterator[RawPair]:
        for number in range(self._count):
            lap, k = divmod(number, self.lap_frames)
            frame = self._frames[k]
            yield RawPair(
                number, frame.timestamp + lap * self.period, frame.left, frame.right, f"{k} left", f"{k} right"
            )


class WatchedSequence(StereoSequence):
    """Notes resident memory and processor time whenever a block of frames has been dealt with.

    Attributes:
        megabytes: after each block.
        cpu_ms: of all threads, a frame of each block.
    """

    def __init__(self, pairs: LappedPairs, lap: StereoSequence, block: int) -> None:
        super().__init__(pairs, lap.camera, lap.source, lap.format)
        self._block = block
        self.megabytes: list[float] = []
        self.cpu_ms: list[float] = []

    def frames(self) -> Generator[StereoFrame, None, None]:
        """The pairs, as of any sequence."""
        self.megabytes, self.cpu_ms = [], []
        since = time.process_time()
        for count, frame in enumerate(super().frames(), start=1):
            yield frame
            if count % self._block == 0:
                self.megabytes.append(resident_megabytes())
                now = time.process_time()
                self.cpu_ms.append(1e3 * (now - since) / self._block)
                since = now


@dataclass(frozen=True, slots=True)
class _LapTruth:
    """The lap's own poses, and how the repeats go on with them."""

    lap: Trajectory
    frames: int

    def poses(self, count: int) -> np.ndarray:
        """(count, 4, 4) relative to the first."""
        return se3_inverse(self.lap.poses[0]) @ self.lap.poses[np.arange(count) % self.frames]


def write_endurance(
    path: Path,
    frames: int,
    command: str,
    renders: Path | None = None,
    note: Callable[[str], None] = lambda text: None,
    recipe: Recipe = LAP,
    block: int = BLOCK,
) -> str:
    """Renders the lap unless it is there, tracks it until so many frames are done, writes the page and returns it.

    Stopped by Ctrl-C, what was measured until then is written.

    Args:
        path: Markdown page; what is below a line `<!-- notes -->` in it is kept.
        frames: to track.
        command: what the page says it was made by.
        renders: folder for the lap, which is used again; a temporary one unless given.
        note: is told of progress.
        recipe: of the lap.
        block: frames that are told of together.
    """
    with tempfile.TemporaryDirectory() as scratch:
        source = render(renders or Path(scratch), recipe, default_workers())
        note(f"the lap is in {source}")
        lap = open_rendered(source)
        truth = _LapTruth(read_trajectory(source / "poses.txt"), recipe.frames)

        # With ten keyframes in memory all are recent and none closes a loop.
        without = Path(scratch) / "without"
        some = min(frames, recipe.frames + _BEYOND)
        without_loops = partial(track_ours, tracker=TrackerOptions(config=TrackerConfig(max_keyframes=10)), tracks=True)
        open_run = Trial(WatchedSequence(LappedPairs(lap, some), lap, block), None, without_loops).run(without)
        with np.load(without / TRACKS_NAME) as tracks:
            names = ("frame", "landmark", "measurement", "covariance")
            tracks_bytes = sum(tracks[name].nbytes for name in names) / some
        open_errors = _errors(open_run, truth)
        note("tracked without loops")

        run = Path(scratch) / "run"
        sequence = WatchedSequence(LappedPairs(lap, frames), lap, block)
        began = time.perf_counter()
        try:
            Trial(sequence, None).run(run)
        finally:
            if (run / "trajectory.tum").exists():
                seconds = time.perf_counter() - began
                endurance = _measure(
                    read_trial(run, None), sequence, truth, block, frames, seconds, open_errors, tracks_bytes
                )
                page = write_page(path, format_endurance(endurance, command))
    return page


def _measure(
    run: TrialResult,
    sequence: WatchedSequence,
    truth: _LapTruth,
    block: int,
    asked: int,
    seconds: float,
    open_errors: np.ndarray,
    tracks_bytes: float,
) -> Endurance:
    totals, tracked = run.table.total_milliseconds, run.tracked
    keyframes = run.table.milliseconds["map"] > 5.0
    errors = _errors(run, truth)
    blocks = []
    for number, megabytes in enumerate(sequence.megabytes):
        rows = slice(number * block, (number + 1) * block)
        low, middle, high = np.percentile(totals[rows], [10, 50, 90])
        blocks.append(
            Block(
                (number + 1) * block,
                megabytes,
                sequence.cpu_ms[number],
                (float(low), float(middle), float(high)),
                float(keyframes[rows].mean()),
                int((~tracked[rows]).sum()) - (number == 0),
            )
        )
    laps = [
        Lap(
            float(errors[end - 1]),
            float(np.median(errors[end - truth.frames : end])),
            float(errors[end - truth.frames : end].max()),
        )
        for end in range(truth.frames, len(errors) + 1, truth.frames)
    ]
    return Endurance(
        asked,
        len(errors),
        seconds,
        truth.lap.path_length,
        truth.frames,
        blocks,
        laps,
        errors,
        open_errors,
        len(run.point_map["points"]),
        tracks_bytes,
    )


def _errors(run: TrialResult, truth: _LapTruth) -> np.ndarray:
    """(N,) distance between every position and the true one, in the world of the first frame, metres."""
    poses = run.trajectory.poses
    if len(poses) < len(run.table):
        raise InputError(f"tracking started {len(run.table) - len(poses)} frames late: the lap cannot be compared")
    return np.asarray(np.linalg.norm(poses[:, :3, 3] - truth.poses(len(poses))[:, :3, 3], axis=1))


def resident_megabytes() -> float:
    """Memory of this process that is in use now."""
    status = Path("/proc/self/status")
    if not status.exists():
        raise InputError("the benchmark endurance reads /proc/self/status: it needs Linux")
    (line,) = (line for line in status.read_text(encoding="ascii").splitlines() if line.startswith("VmRSS:"))
    return int(line.split()[1]) / 1024.0
