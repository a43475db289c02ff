"""A trial: a sequence is rendered or opened, tracked by one method, evaluated, and its run folder read back."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sigmaslam.errors import InputError
from sigmaslam.files import atomic_write_text
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.readers import StereoSequence, open_sequence
from sigmaslam.readers.trajectory_files import read_trajectory
from sigmaslam.run_record.frame_table import FrameTable, read_frames
from sigmaslam.run_record.run_folder import check_has_trajectory
from sigmaslam.runs.request import InputOptions, OutputOptions, TrackerOptions, TrackRequest
from sigmaslam.runs.track import track_sequence
from sigmaslam_benchmarks.code_hash import hash_renderer
from sigmaslam_evaluation.evaluation_result import Evaluation
from sigmaslam_evaluation.run_evaluation import evaluate_run

if TYPE_CHECKING:
    from sigmaslam_synthetic.simulation import Recipe


Method = Callable[[StereoSequence, Path], object]
"""Writes what it makes of a sequence into a new run folder: `track_ours`, or another one with its arguments."""
_DEFAULT = TrackerOptions()


def track_ours(
    sequence: StereoSequence, out: Path, tracker: TrackerOptions = _DEFAULT, tracks: bool = False
) -> dict[str, Any]:
    """What `sigmaslam track` does, with --tracks or without; its summary."""
    return track_sequence(TrackRequest(InputOptions(sequence), OutputOptions(out, tracks=tracks), tracker))


@dataclass(frozen=True, slots=True)
class TrialResult:
    """What a run folder holds, and its evaluation.

    Attributes:
        trajectory: estimated poses.
        frames: the rows of frames.csv; None for a method that does not write it.
        point_map: the arrays of map.npz; empty for a method that does not write it.
        evaluated: against the truth; None for a trial without truth.
    """

    trajectory: Trajectory
    frames: FrameTable | None
    point_map: dict[str, np.ndarray]
    evaluated: Evaluation | None

    @property
    def table(self) -> FrameTable:
        """Every frame, of a method that writes frames.csv."""
        assert self.frames is not None
        return self.frames

    @property
    def evaluation(self) -> Evaluation:
        """The evaluation of a trial with truth."""
        assert self.evaluated is not None
        return self.evaluated

    @property
    def tracked(self) -> np.ndarray:
        """(N,) bool, frames with a pose from the images, without the first and relocalised ones."""
        return np.array(self.table.status) == "tracking"

    @property
    def tracked_poses(self) -> np.ndarray:
        """(M,) bool, `tracked` of the frames of the trajectory, in which frames before the start have no row."""
        rows = np.searchsorted(self.table.columns["timestamp"], self.trajectory.timestamps - 1e-6)
        return self.tracked[rows]

    @property
    def nis(self) -> np.ndarray:
        """(M,) normalised innovation squared per degree of freedom of the tracked frames."""
        columns = self.table.columns
        return np.asarray(columns["nis"][self.tracked] / columns["dof"][self.tracked])


@dataclass(frozen=True, slots=True)
class Trial:
    """One method on one sequence.

    Attributes:
        source: what `open_sequence` opens, or a sequence that is open.
        truth: trajectory file; None: nothing is evaluated.
        method: tracks the sequence.
        truth_sigmas: of the true poses, metres and degrees, as `evaluate_run` takes them; None: exact.
    """

    source: Path | StereoSequence
    truth: Path | None
    method: Method = track_ours
    truth_sigmas: tuple[float, float] | None = None

    def run(
        self, out: Path | None = None, lengths: Sequence[float] | None = None, step: int | None = None
    ) -> TrialResult:
        """Tracks and evaluates.

        Args:
            out: run folder; a temporary one unless given.
            lengths, step: KITTI segments, as `evaluate_run` takes them.
        """
        if out is None:
            with tempfile.TemporaryDirectory() as scratch:
                return self.run(Path(scratch) / "run", lengths, step)
        sequence = open_sequence(self.source) if isinstance(self.source, Path) else self.source
        self.method(sequence, out)
        return read_trial(out, self.truth, lengths, step, self.truth_sigmas)


def read_trial(
    run: Path,
    truth: Path | None,
    lengths: Sequence[float] | None = None,
    step: int | None = None,
    truth_sigmas: tuple[float, float] | None = None,
) -> TrialResult:
    """The result of a trial whose run folder is there; arguments as `Trial` and `Trial.run` take them."""
    check_has_trajectory(run)
    point_map = {}
    if (run / "map.npz").is_file():
        with np.load(run / "map.npz") as content:
            point_map = dict(content)
    evaluated = None
    if truth is not None:
        position, rotation = truth_sigmas or (None, None)
        evaluated = evaluate_run(
            run,
            truth,
            lengths=lengths,
            step=step,
            plot=False,
            truth_sigma_position=position,
            truth_sigma_rotation=rotation,
        )
    return TrialResult(
        read_trajectory(run / "trajectory.tum"),
        read_frames(run / "frames.csv") if (run / "frames.csv").is_file() else None,
        point_map,
        evaluated,
    )


def render(folder: Path, recipe: Recipe, workers: int, done: Callable[[int], None] = lambda frames: None) -> Path:
    """Renders a sequence with its landmarks into a folder of its name, and returns where it is.

    Frames that are there are kept, of the same recipe and the same renderer: the folder's name has both.
    """
    from sigmaslam_synthetic.render_sequence import write_sequence

    source = folder / f"{recipe.name}-{hash_renderer()[:8]}"
    write_sequence(source, recipe, "sparse", workers, done=done)
    return source


def read_figures(path: Path, made_from: Mapping[str, Any]) -> dict[str, Any] | None:
    """Figures that `write_figures` kept; None where there are none, or of something else.

    Raises:
        InputError: the file is no such one.
    """
    if not path.is_file():
        return None
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError(f"{path} is no result of this benchmark ({error}): remove it") from error
    asked = json.loads(json.dumps(made_from))
    return dict(content["result"]) if content.get("made_from") == asked else None


def write_figures(path: Path, made_from: Mapping[str, Any], figures: Mapping[str, Any]) -> None:
    """Keeps figures as JSON, with what they are made from: they are used again while that is the same."""
    atomic_write_text(path, json.dumps({"made_from": made_from, "result": figures}, indent=1) + "\n")
