"""What `sigmaslam track` is asked for, in parts; fields have the names of the command's options."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sigmaslam.errors import InputError
from sigmaslam.readers import StereoSequence, open_cameras, open_sequence
from sigmaslam.readers.odometry import read_odometry
from sigmaslam.readers.open_inertial import open_imu
from sigmaslam.readers.selection import Selection

if TYPE_CHECKING:
    from sigmaslam.bodies.object_tracker import ObjectEstimate
    from sigmaslam.checks.finding import Finding
    from sigmaslam.fusion.readings import Locations
    from sigmaslam.inference.networks import WeightsFolder
    from sigmaslam.live.frame_sink import FrameSink
    from sigmaslam.slam.config import TrackerConfig
    from sigmaslam.slam.estimate import Estimate

# What a run that goes on lacks: what was in memory when it was stopped, and frames that do not come again.
_FORGOTTEN = ("--camera", "--map", "--tracks", "--track-object", "--location", "--realtime")
# An option, others, and why it and any of them are refused; "no X" stands for an option X that is not given.
_REFUSED = (
    ("no INPUT", ("no --camera",), "give either INPUT, a recording, or --camera, live cameras"),
    ("INPUT", ("--camera",), "give either INPUT, a recording, or --camera, live cameras, not both"),
    ("INPUT", ("--seconds",), "--seconds goes with --camera; a recording is tracked to its end"),
    ("--camera", ("no --calibration",), "--camera needs --calibration: any file that `sigmaslam calibrate show` reads"),
    ("--camera", ("--format", "--topic-left", "--topic-right"), "{all} go with INPUT, not with --camera"),
    ("--camera", ("--start", "--frames", "--every", "--scale"), "{all} go with INPUT, not with --camera"),
    ("--camera", ("--imu", "--odometry"), "{all} go with INPUT, not with --camera"),
    ("--resume", ("--overwrite",), "--resume goes on with the run in the folder, {all} removes it: give one of them"),
    ("--resume", ("--video", "--viewer", "--dense"), "--resume does not go with {all}, of whole runs: leave them out"),
    ("--resume", _FORGOTTEN, "--resume does not go with {given}: leave one of them out"),
    (
        "--save-calibration",
        ("--track-object", "--scale"),
        "--save-calibration is of the whole scene in images as they are: leave out {all}",
    ),
    ("--track-object", ("--imu", "--odometry"), "the camera is at rest with --track-object: leave out {all}"),
    (
        "--track-object",
        ("--map", "--tracks", "--dense"),
        "{all} are of a moving camera's world: leave them out with --track-object",
    ),
)


@dataclass(frozen=True, slots=True)
class InputOptions:
    """Which pairs are tracked.

    Attributes:
        source: a recording, for `open_sequence`, or a sequence that is open.
        format, calibration, topic_left, topic_right: for `open_sequence`.
        camera, seconds: for `open_cameras`, in place of a source.
        start, frames, every, scale: for `StereoSequence.select`.
        mask: for `StereoSequence.use_masks`.
        imu: for `open_imu`.
        odometry: for `read_odometry`.
        findings: of a check; they are kept in run.json, and explain a run that fails.
    Raises:
        InputError: options do not go together.
    """

    source: Path | StereoSequence | None = None
    format: str = "auto"
    calibration: Path | None = None
    camera: str | None = None
    seconds: float | None = None
    topic_left: str | None = None
    topic_right: str | None = None
    start: int = 0
    frames: int | None = None
    every: int = 1
    scale: float = 1.0
    mask: Path | None = None
    imu: str | None = None
    odometry: Path | None = None
    findings: "Sequence[Finding]" = ()

    def __post_init__(self) -> None:
        _check(_given(self))

    def open(self) -> StereoSequence:
        """The selected pairs of the recording, or the live cameras; InputError where they cannot be opened."""
        if self.camera is not None:
            assert self.calibration is not None
            return open_cameras(self.camera, self.calibration, self.seconds)
        assert self.source is not None
        sequence = self.source
        if not isinstance(sequence, StereoSequence):
            sequence = open_sequence(sequence, self.format, self.calibration, (self.topic_left, self.topic_right))
        selection = Selection(self.start, self.frames, self.every)
        if (selection, self.scale) != (Selection(), 1.0):
            sequence = sequence.select(selection, self.scale)
        if self.mask is not None:
            sequence.use_masks(self.mask)
        if self.imu is not None or not isinstance(self.source, StereoSequence):
            sequence.imu = open_imu(sequence, self.imu)
        if self.odometry is not None:
            sequence.odometry = read_odometry(self.odometry)
        return sequence


@dataclass(frozen=True, slots=True)
class OutputOptions:
    """The run folder.

    Attributes:
        out: the folder, new or empty.
        tracks: write tracks.npz, too, the observations of keyframes for `sigmaslam map refine`.
        overwrite: a run in the folder is removed before the first frame.
        resume: `out` holds a run of the same input that was stopped or killed, which goes on where it was. The map is
            then that of the frames from its last keyframe on, and there is no trajectory after the fact.
        save_calibration: a calibration file, new, for what the run learns of its own.
    Raises:
        InputError: there is a file of the name for the calibration, or none can be made.
    """

    out: Path
    tracks: bool = False
    overwrite: bool = False
    resume: bool = False
    save_calibration: Path | None = None

    def __post_init__(self) -> None:
        if (path := self.save_calibration) is None:
            return
        if path.exists():
            raise InputError(f"{path}: there is such a file: give --save-calibration another name")
        is_there = path.parent.is_dir() or path.parent.resolve() == self.out.resolve()
        if path.suffix.lower() not in (".yaml", ".yml") or not is_there:
            raise InputError(f"{path}: give --save-calibration a name that ends in .yaml, in a folder that is there")


@dataclass(frozen=True, slots=True)
class TrackerOptions:
    """How pairs are tracked.

    Attributes:
        frontend, backend, provider, weights, config, threads: of `StereoTracker`.
        map: map.npz of an earlier run; poses are in its world.
        track_object: box or mask, see `read_region`: the camera is at rest and follows one body. Poses are then
            T_camera_object, their covariances in the body's frame, and the map that of the body in its own frame.
        location: readings to fuse of a sensor on the moving camera or body; writes trajectory_location.tum, too, the
            poses in the sensor's world.
        realtime: play a recording at its time stamps; frames are dropped when tracking falls behind.
        denoise: filter the images before they are tracked, see `sigmaslam.image_filtering.SequenceFilter`.
    """

    frontend: str = "learned"
    backend: str = "onnx"
    provider: str = "cpu"
    weights: "WeightsFolder" = None
    config: "TrackerConfig | None" = None
    threads: int = 2
    map: Path | None = None
    track_object: str | None = None
    location: "Locations | None" = None
    realtime: bool = False
    denoise: bool = False


@dataclass(frozen=True, slots=True)
class LiveOptions:
    """Who is told of frames while the run goes on.

    Attributes:
        stream, video, viewer, serve, dense: sinks that the command opens.
        on_estimate: called with the estimate of each frame when it is on disk; an error that it raises ends the run.
        sinks: take each frame after that, and are closed in the end.
    """

    stream: str | None = None
    video: Path | None = None
    viewer: str | None = None
    serve: str | None = None
    dense: Path | None = None
    on_estimate: "Callable[[Estimate | ObjectEstimate], None] | None" = None
    sinks: "Sequence[FrameSink]" = ()


@dataclass(frozen=True, slots=True)
class TrackRequest:
    """A run that `track_sequence` makes; InputError where options do not go together."""

    input: InputOptions
    outputs: OutputOptions
    tracker: TrackerOptions = TrackerOptions()
    live: LiveOptions = LiveOptions()

    def __post_init__(self) -> None:
        _check(_given(self.input) | _given(self.outputs) | _given(self.tracker) | _given(self.live))


def _given(part: Any) -> set[str]:
    """Names on the command line of the options that are not at their default."""
    names = {field.name for field in fields(part) if getattr(part, field.name) != field.default}
    given = {"INPUT" if name == "source" else f"--{name.replace('_', '-')}" for name in names}
    if "INPUT" in given and isinstance(part.source, StereoSequence) and part.source.format == "camera":
        return given - {"INPUT"} | {"--camera", "--calibration"}  # open already
    return given


def _check(given: set[str]) -> None:
    for option, others, reason in _REFUSED:
        refused = [other for other in others if _holds(other, given)]
        if _holds(option, given) and refused:
            named = " and ".join(filter(None, [", ".join(others[:-1]), others[-1]]))
            raise InputError(reason.format(given=refused[0], all=named))


def _holds(option: str, given: set[str]) -> bool:
    return option.removeprefix("no ") not in given if option.startswith("no ") else option in given
