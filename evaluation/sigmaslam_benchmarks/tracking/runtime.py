"""CPU and wall time, memory and start-up of the tracker, of odometry from OpenCV, of cuVSLAM and of ORB-SLAM3."""

import compileall
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from importlib.resources import as_file, files
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

import sigmaslam
from sigmaslam.errors import InputError
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.readers import open_sequence
from sigmaslam.readers.trajectory_files import read_trajectory
from sigmaslam_benchmarks.tracking.decoded_pairs import DecodedPairs, write_pairs
from sigmaslam_benchmarks.tracking.page import check_names, write_results_page
from sigmaslam_benchmarks.tracking.runtime_page import SEQUENCE, SIZE, TimedRun, format_runtime, progress
from sigmaslam_benchmarks.tracking.sequences_page import Omission, method_label
from sigmaslam_benchmarks.tracking.stereo_peers import MissingPeerError
from sigmaslam_benchmarks.tracking.time_method import METHODS, WARM_UP, FailedMethodError, TimingJob, time_method
from sigmaslam_benchmarks.trial import render
from sigmaslam_evaluation.metrics.trajectory_errors import absolute_trajectory_error

REAL = {"kitti_raw_0926_0039_a": "poses.txt", "euroc_mh01_f000_099": "groundtruth.tum"}
"""Folder of the data, and its truth."""
SEQUENCES = ("kitti_raw_0926_0039_a", "room", "euroc_mh01_f000_099")
"""In the order of the page: KITTI's size, VGA, and 752x480 unrectified."""
FRAMES, ROUNDS = 60, 3
SCALES = (0.5, 0.75, 1.0, 1.5)
"""Of the images of the first sequence; the room's are halved."""
_SEED = 700  # a development seed
_DEMO = "demo"  # for those who have neither torch nor data


@dataclass(frozen=True, slots=True)
class TimingChoice:
    """What is timed.

    Attributes:
        data: folder of the real data sets, if there is one.
        methods: of `METHODS`.
        sequences: of `SEQUENCES`, or "demo"; the image size is varied on the first that is there.
        rounds: in which every method is run once.
        frames: of each sequence, from its start.
        renders: folder for these; a temporary one by default.
    Raises:
        InputError: a name is unknown, or there are too few frames.
    """

    data: Path | None
    methods: Sequence[str] = METHODS
    sequences: Sequence[str] = SEQUENCES
    rounds: int = ROUNDS
    frames: int = FRAMES
    renders: Path | None = None

    def __post_init__(self) -> None:
        check_names("method", self.methods, METHODS)
        check_names("sequence", self.sequences, (*SEQUENCES, _DEMO))
        if self.frames <= WARM_UP + 1:
            raise InputError(
                f"--frames is {self.frames}: give at least {WARM_UP + 2}, the first {WARM_UP} are not counted"
            )


@dataclass(frozen=True, slots=True)
class _Test:
    """What the methods take turns at in a round.

    Attributes:
        section: of the page.
        variant: size of the images.
        runs: method and threads of each.
    """

    section: str
    sequence: str
    variant: str
    pairs: DecodedPairs
    truth: Trajectory
    runs: Sequence[tuple[str, int]]


def write_runtime(
    path: Path,
    data: Path | None,
    command: str,
    methods: Sequence[str] = METHODS,
    sequences: Sequence[str] = SEQUENCES,
    rounds: int = ROUNDS,
    frames: int = FRAMES,
    renders: Path | None = None,
    note: Callable[[str], None] = lambda text: None,
) -> str:
    """Times everything, writes the page and returns it; what is below a line `<!-- notes -->` in the page is kept.

    When it is stopped, what was measured until then is written. Arguments and errors are those of `TimingChoice`.
    """
    results = time_everything(TimingChoice(data, methods, sequences, rounds, frames, renders), note)
    return write_results_page(path, results, lambda found, complete: format_runtime(found, command, rounds, complete))


def time_everything(
    choice: TimingChoice, note: Callable[[str], None] = lambda text: None
) -> Iterator[TimedRun | Omission]:
    """Times everything, one process at a time."""
    # As pip does it: from a checkout where Python may write no bytecode, a start takes 0.3 CPU seconds more.
    compileall.compile_dir(sigmaslam.__path__[0], quiet=2)
    methods, rounds = [method for method in METHODS if method in choice.methods], choice.rounds
    missing: set[str] = set()  # peers; each is told of once
    with ExitStack() as stack:
        scratch = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        demo = stack.enter_context(as_file(files("sigmaslam_synthetic") / "demo"))
        varied: list[tuple[str, DecodedPairs, Trajectory, Sequence[float]]] = []
        for name in (name for name in (*SEQUENCES, _DEMO) if name in choice.sequences):
            opened = _find(name, choice, scratch, demo, note)
            if isinstance(opened, Omission):
                note(f"{name} is left out: {opened.reason}")
                yield opened
                continue
            pairs, truth = _decode(*opened, scratch / name, choice.frames)
            if not varied or name == "room":
                varied.append((name, pairs, truth, SCALES[:1] if varied else SCALES))
            every = [(method, threads) for threads in (1, 2) for method in methods]
            yield from _take_turns([_Test(SEQUENCE, name, pairs.size, pairs, truth, every)], rounds, missing, note)
        tests = [test for each in varied for test in _vary_size(*each, methods, scratch)]
        yield from _take_turns(tests, rounds, missing, note)


def _find(
    name: str, choice: TimingChoice, scratch: Path, demo: Path, note: Callable[[str], None]
) -> tuple[Path, Path] | Omission:
    """Source and truth of a sequence, which is rendered if it has to be; or why it is left out."""
    if name == _DEMO:
        return demo, demo / "poses.txt"
    if name == "room":
        try:
            source = _render(choice.renders or scratch / "renders", choice.frames, note)
        except ImportError as error:
            return Omission(name, "", f"{error.name} is not installed: pip install 'sigmaslam[train]'")
        return source, source / "poses.txt"
    data = choice.data
    if data is None or not (data / name).is_dir():
        return Omission(name, "", f"{data or 'no folder'} does not hold it: give the folder of the data with --data")
    return data / name, data / name / REAL[name]


def _render(folder: Path, frames: int, note: Callable[[str], None]) -> Path:
    """Renders the room; frames that are there are kept."""
    from sigmaslam_synthetic.render_sequence import default_workers
    from sigmaslam_synthetic.simulation import Recipe

    began = time.perf_counter()
    recipe = Recipe("room", frames, _SEED, width=640, height=480)
    # A folder holds the render of one recipe.
    source = render(folder / f"runtime{frames}", recipe, default_workers())
    note(f"room rendered in {time.perf_counter() - began:.0f} s")
    return source


def _decode(source: Path, truth: Path, folder: Path, frames: int) -> tuple[DecodedPairs, Trajectory]:
    sequence = open_sequence(source)
    with closing(sequence.frames()) as pairs:
        return write_pairs(folder, islice(pairs, frames), sequence.camera), read_trajectory(truth)


def _vary_size(
    name: str, pairs: DecodedPairs, truth: Trajectory, scales: Sequence[float], methods: Sequence[str], scratch: Path
) -> Iterator[_Test]:
    for scale in scales:
        scaled = pairs if scale == 1.0 else pairs.resize(scratch / f"{name}-{scale}", scale)
        yield _Test(SIZE, name, scaled.size, scaled, truth, [(method, 1) for method in methods])


def _take_turns(
    tests: list[_Test], rounds: int, missing: set[str], note: Callable[[str], None]
) -> Iterator[TimedRun | Omission]:
    """Runs every method of every test once in each round; one that fails does not come again."""
    failed: set[tuple[str, str, str]] = set()
    for turn in range(rounds):
        for test in tests:
            for method, threads in test.runs:
                place = test.section, test.variant, method
                if method in missing or place in failed:
                    continue
                try:
                    timing = time_method(TimingJob(str(test.pairs.folder), method, threads))
                except MissingPeerError as error:
                    missing.add(method)
                    note(f"{method_label(method)} is left out: {error}")
                    yield Omission("", method, str(error))
                    continue
                except FailedMethodError as error:
                    failed.add(place)
                    note(f"{test.sequence} {test.variant}: {method_label(method)} is left out: {error}")
                    yield Omission(f"{test.sequence} {test.variant}", method, str(error))
                    continue
                ate = _ate(timing.timestamps, timing.poses, test.truth)
                run = TimedRun(test.section, test.sequence, test.variant, method, threads, turn, timing, ate)
                note(f"round {turn + 1}: {progress(run)}")
                yield run


def _ate(timestamps: Sequence[float], poses: Sequence[Any], truth: Trajectory) -> float:
    """Metres after the best rigid alignment; NaN where there are too few poses for one."""
    try:
        return absolute_trajectory_error(Trajectory(np.array(timestamps), np.array(poses)), truth).rmse
    except (InputError, ValueError):
        return float("nan")
