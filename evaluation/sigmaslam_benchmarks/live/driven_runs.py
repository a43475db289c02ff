"""Faulty frames tracked in this process: what each method says of each frame, and in words."""

import io
import logging
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import typer

from sigmaslam.bodies.object_tracker import ObjectEstimate
from sigmaslam.checks.check import SAMPLES_BEFORE_TRACKING, check_sequence
from sigmaslam.checks.finding import wrong
from sigmaslam.cli.run_summary import tell_summary
from sigmaslam.errors import SigmaSlamError
from sigmaslam.geometry.camera import StereoCamera
from sigmaslam.readers import StereoFrame, StereoSequence
from sigmaslam.readers.images import ListedPairs
from sigmaslam.readers.inertial import InertialRecording
from sigmaslam.runs.request import InputOptions, LiveOptions, OutputOptions, TrackerOptions, TrackRequest
from sigmaslam.runs.track import track_sequence
from sigmaslam.slam.estimate import Estimate
from sigmaslam_benchmarks.live.driver_faults import DrivenFrame
from sigmaslam_benchmarks.live.judge import DrivenPose
from sigmaslam_benchmarks.tracking.stereo_peers import RECTIFIED, open_peer


@dataclass(frozen=True, slots=True)
class DrivenRun:
    """What a method says.

    Attributes:
        poses: of the frames that it was given, in order.
        said: sentences about the run.
        refused: why it broke off; empty where it did not.
        learned: errors of the calibration by name: value and standard deviation.
    """

    poses: list[DrivenPose]
    said: list[str]
    refused: str = ""
    learned: dict[str, tuple[float, float]] = field(default_factory=dict)


Method = Callable[[Sequence[DrivenFrame], StereoCamera, Path], DrivenRun]
"""Tracks frames; a run folder may be written to the path, which does not exist."""


class DrivenSequence(StereoSequence):
    """Delivered frames as a sequence that remembers which of them was read last.

    Attributes:
        latest: number of that frame; a consumer looks up what it says of a frame by it, not by the stamp.
    """

    def __init__(self, frames: Sequence[DrivenFrame], camera: StereoCamera) -> None:
        pairs = [(each.left, each.right, each.timestamp) for each in frames]
        super().__init__(ListedPairs(pairs), camera, "driver", "memory")
        self.latest = -1

    def frames(self) -> Iterator[StereoFrame]:  # type: ignore[override]
        """The frames in order."""
        with closing(super().frames()) as frames:
            for frame in frames:
                self.latest = frame.index
                yield frame


def track_ours(
    frames: Sequence[DrivenFrame], camera: StereoCamera, out: Path, imu: InertialRecording | None = None
) -> DrivenRun:
    """What `sigmaslam track` does and says, in one thread."""
    by_frame: dict[int, DrivenPose] = {}
    learned: dict[str, tuple[float, float]] = {}

    def keep(result: Estimate | ObjectEstimate) -> None:
        estimate, moment = result.camera, frames[sequence.latest].moment
        by_frame[sequence.latest] = DrivenPose(moment, estimate.status, estimate.T_world_camera, estimate.covariance)
        found = estimate.calibration
        learned.update(offset=(found.disparity_offset, found.disparity_offset_sigma), **found.errors)

    warnings, refused, told = _Warnings(), "", io.StringIO()
    logger = logging.getLogger("sigmaslam")
    logger.addHandler(warnings)
    try:
        sequence = DrivenSequence(frames, camera)
        sequence.imu = imu
        with Path(os.devnull).open("w") as nowhere, redirect_stderr(nowhere):
            check = check_sequence(sequence, SAMPLES_BEFORE_TRACKING, 1)
            findings, sequence.camera = check.findings, check.camera
            source, live = InputOptions(sequence, findings=findings), LiveOptions(on_estimate=keep)
            summary = track_sequence(TrackRequest(source, OutputOptions(out), TrackerOptions(threads=1), live))
        told.write("".join(f"{each.message}\n" for each in wrong(findings)))
        _tell(summary, out, told)
    except SigmaSlamError as error:
        refused = str(error)
    finally:
        logger.removeHandler(warnings)
    missing = [
        DrivenPose(frame.moment, "refused" if refused else "skipped", np.full((4, 4), np.nan), None) for frame in frames
    ]
    poses = [by_frame.get(number, none) for number, none in enumerate(missing)]
    words = [*warnings.words, *(line.strip() for line in told.getvalue().splitlines())]
    said = [line for line in dict.fromkeys(words) if line and not line.startswith("Report:")]
    return DrivenRun(poses, said, refused, learned)


def _tell(summary: dict[str, Any], out: Path, told: io.StringIO) -> None:
    """What the command prints in the end."""
    with redirect_stdout(told), redirect_stderr(told):
        try:
            tell_summary(summary, out)
        except typer.Exit:
            return


class _Warnings(logging.Handler):
    """Keeps the words of warnings and errors."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.words: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.words.append(record.getMessage())


def track_with_peer(frames: Sequence[DrivenFrame], camera: StereoCamera, out: Path, name: str) -> DrivenRun:
    """A peer, which says nothing in words; MissingPeerError where it is not installed."""
    poses = []
    with closing(open_peer(name, camera, [frame.timestamp for frame in frames])) as peer:
        for frame in frames:
            found = peer.step(frame.left, frame.right, frame.timestamp)
            pose = np.full((4, 4), np.nan) if found.T_world_camera is None else found.T_world_camera
            # cuVSLAM's does not grow along the path: it is not that of the pose relative to the start.
            covariance = None if name in RECTIFIED else found.covariance
            poses.append(DrivenPose(frame.moment, found.status, pose, covariance))
    return DrivenRun(poses, [])


METHODS: dict[str, Method] = {
    "ours": track_ours,
    **{name: partial(track_with_peer, name=name) for name in ("klt-pnp", "cuvslam", "orbslam3")},
}
"""The first is what goals are for."""
