"""Tracking a whole sequence, from disk or live, into a run folder."""

import logging
import math
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any

import numpy as np

from sigmaslam.bodies.object_region import read_region
from sigmaslam.bodies.object_tracker import OBJECT_CONFIG, ObjectEstimate, ObjectTracker
from sigmaslam.calibration.learned_calibration import learned_calibration
from sigmaslam.calibration_files.calibration_writer import write_calibration
from sigmaslam.checks.finding import Finding, tracker_arguments, wrong
from sigmaslam.checks.images import check_light, light_ratio
from sigmaslam.checks.inertial_agreement import judge_motion
from sigmaslam.errors import InputError, OutputError, SigmaSlamError
from sigmaslam.files import printable
from sigmaslam.fusion.location_filter import LocationFilter
from sigmaslam.live.frame_sink import TrackedFrame, close_all
from sigmaslam.progress import open_progress
from sigmaslam.readers import StereoFrame, StereoSequence
from sigmaslam.readers.trajectory_files import write_tum
from sigmaslam.run_record.frame_pictures import PictureRecorder
from sigmaslam.run_record.real_time import FrameTiming
from sigmaslam.run_record.removal import remove_run
from sigmaslam.run_record.run_folder import RunWriter, describe_camera, describe_weights
from sigmaslam.runs.denoise import StereoFilter
from sigmaslam.runs.request import TrackerOptions, TrackRequest
from sigmaslam.runs.results import TrackerResults, output_error, write_results
from sigmaslam.runs.resume import StoppedRun, read_stopped_run
from sigmaslam.runs.stop_signals import Stopped, StopSignals
from sigmaslam.slam.config import TrackerConfig
from sigmaslam.slam.estimate import Estimate
from sigmaslam.slam.matched_frame import MatchedFrame
from sigmaslam.slam.start_pose import StartPose
from sigmaslam.slam.tracker import StereoTracker

Tracker = StereoTracker | ObjectTracker
logger = logging.getLogger(__name__)


def track_sequence(request: TrackRequest) -> dict[str, Any]:
    """Tracks a sequence and writes the run folder; partial results are kept when it is stopped or fails.

    Returns:
        The summary in run.json, in which `failure` says why less than half of the frames were tracked, and is None
        where more were; with a location sensor also the counts of the readings, under `location`, and in real time
        what was dropped and the latency, under `real_time`.
    Raises:
        InputError: the folder is not empty, or holds no run that could go on, an option is wrong, or the sequence
            breaks off; what was computed is on disk then.
        OutputError: results could not be written, the others are; what was said of each frame is on disk.
        Stopped: by Ctrl-C, SIGTERM or SIGHUP, after the partial results are written.
    """
    sequence, options, live, out = request.input.open(), request.tracker, request.live, request.outputs.out
    settings = _describe_settings(sequence, options)
    stopped = None
    if request.outputs.resume:
        stopped = read_stopped_run(out, settings)
        stopped.check_sequence(sequence)
    start = None if stopped is None else stopped.start
    tracker = _build_tracker(sequence, options, start, request.input.findings)
    location = None
    if options.location is not None:
        location = LocationFilter(options.location, options.track_object is not None)
    rectified = None
    if isinstance(tracker, StereoTracker):
        if options.map is not None:
            tracker.load_map(options.map)
        rectified = tracker.rectifier.describe() if request.outputs.tracks else None
    run = {
        **settings,
        "checks": [asdict(each) for each in request.input.findings],
        **({} if stopped is None else {"resumed_at": stopped.resumed_at}),
    }
    run |= _describe_location(location)
    if options.track_object is not None:
        run["object"] = {"region": options.track_object, "origin": None}  # which the first frame gives
    if stopped is not None:
        stopped.make_ready()
    if request.outputs.overwrite:  # now that all it asks for is read: its map, too
        remove_run(out)
    writer = RunWriter(out, run, rectified, None if stopped is None else len(stopped.records))
    pictures = PictureRecorder(sequence.length)
    images = StereoFilter() if options.denoise else None
    timing = FrameTiming(sequence.format == "camera", options.realtime)
    steps = _FrameSteps(images, tracker, timing, location, _sensors(sequence, tracker))
    on_estimate = live.on_estimate
    listeners = [(lambda frame: on_estimate(frame.result))] if on_estimate else []
    listeners += [sink.add for sink in live.sinks]
    if timing.is_real:
        tracker.warm_up()
    stopped_by: BaseException | None = None
    with StopSignals() as signals:
        try:
            # Cameras are released before the results are written, even after an error.
            with closing(sequence.frames()) as frames:
                _track(timing.play(frames), steps, _Rows(sequence, writer, stopped, listeners), pictures)
            signals.hold()
        except BaseException as error:
            signals.hold()
            # Where the terminal is gone, showing the progress fails as well.
            stopped_by = error if signals.received is None else Stopped(signals.received)
        writer.close()
        unfinished = close_all(live.sinks)
        run = {
            **writer.run,
            "ended": _describe_end(stopped_by),
            "checks": [*writer.run["checks"], *_judge_light([] if stopped else steps.light, request.input.findings)],
            "dropped": timing.dropped + sequence.dropped,
            **timing.describe(timing.dropped + sequence.dropped),
            **_describe_location(location),
            **({} if images is None else {"noise": images.describe()}),
        }
        if isinstance(tracker, ObjectTracker):
            run["object"] = run["object"] | {"origin": tracker.origin.tolist()}  # in the first left camera's frame
        results = _collect_results(request, sequence, steps, writer, pictures, goes_on=stopped is not None)
        summary, failed = write_results(out, run, writer.calibration, results)
    if stopped_by is not None:
        raise stopped_by
    if failed:
        raise output_error(out, failed)
    if unfinished:
        raise OutputError(f"{', '.join(unfinished)} could not be written, as said above; the run itself is in {out}")
    summary = {**summary, **timing.describe(timing.dropped + sequence.dropped)}
    return summary if location is None else {**summary, "location": asdict(location.summary)}


def _describe_settings(sequence: StereoSequence, options: TrackerOptions) -> dict[str, Any]:
    """Entries of run.json for what is tracked, and how."""
    config = options.config or (TrackerConfig() if options.track_object is None else OBJECT_CONFIG)
    return {
        "input": printable(sequence.source),
        "format": sequence.format,
        "frontend": options.frontend,
        "backend": options.backend,
        "provider": options.provider,
        "weights": describe_weights(options.frontend, options.backend, options.weights),
        "map": None if options.map is None else printable(options.map),
        **({} if sequence.imu is None else {"imu": printable(sequence.imu.source)}),
        **({} if sequence.odometry is None else {"odometry": printable(sequence.odometry.source)}),
        "mask": None if sequence.masks is None else printable(sequence.masks.source),
        "configuration": asdict(config),
        "calibration": describe_camera(sequence.camera),
    }


def _describe_end(stopped_by: BaseException | None) -> str:
    """Of a run, for run.json."""
    match stopped_by:
        case None:
            return "complete"
        case Stopped() if stopped_by.signal != signal.SIGINT:
            return f"interrupted by {stopped_by.signal.name}"
        case KeyboardInterrupt():
            return "interrupted"
        case SigmaSlamError():
            return f"failed: {printable(str(stopped_by))}"
    return f"crashed: {stopped_by!r}"


def _judge_light(light: Sequence[tuple[float, float]], findings: Sequence[Finding]) -> list[dict[str, Any]]:
    """That an eye was dark in a tenth of the frames, where no check has found it before."""
    if not light or any(each.name == "light" for each in wrong(findings)):
        return []
    times, ratios = np.array(light).T
    found = wrong([check_light(times.tolist(), ratios, most=0.1)])
    for each in found:
        logger.warning("%s: %s", each.name, each.message)
    return [asdict(each) for each in found]


def _build_tracker(
    sequence: StereoSequence, options: TrackerOptions, start: StartPose | None, findings: Sequence[Finding]
) -> Tracker:
    camera, names = sequence.camera, ("frontend", "backend", "config", "threads", "provider", "weights")
    common: dict[str, Any] = {name: getattr(options, name) for name in names}
    if options.track_object is not None:
        region = read_region(options.track_object, camera.left.width, camera.left.height)
        return ObjectTracker(camera, region, **common)
    imu = None if sequence.imu is None else sequence.imu.sensor
    odometry = None if sequence.odometry is None else sequence.odometry.sensor
    return StereoTracker(camera, start=start, imu=imu, odometry=odometry, **tracker_arguments(findings), **common)


def _describe_location(location: LocationFilter | None) -> dict[str, Any]:
    """Entries of run.json for a location sensor: counts of the readings, and the pose of its world."""
    if location is None:
        return {}
    T, covariance = location.T_sensor_world, location.T_sensor_world_covariance
    return {
        "location": {
            **asdict(location.summary),
            "T_sensor_world": None if T is None else T.tolist(),
            "T_sensor_world_covariance": None if covariance is None else covariance.tolist(),
        }
    }


@dataclass(slots=True)
class _Samples:
    """Samples of a sensor of motion: columns (N, ...), the times first, and what takes them one by one."""

    columns: Sequence[np.ndarray]
    shift: float
    add: Callable[..., None]
    given: int = 0

    def feed(self, timestamp: float) -> None:
        """Gives those up to a frame that were not given yet, and the one behind it."""
        end = int(np.searchsorted(self.columns[0], timestamp + self.shift)) + 1
        for row in zip(*(each[self.given : end] for each in self.columns), strict=True):
            self.add(*row)
        self.given = max(self.given, end)


@dataclass(frozen=True, slots=True)
class _FrameSteps:
    """What each frame goes through."""

    images: StereoFilter | None
    tracker: Tracker
    timing: FrameTiming
    location: LocationFilter | None
    sensors: list[_Samples]
    light: list[tuple[float, float]] = field(default_factory=list)

    def step(self, frame: StereoFrame) -> Estimate | ObjectEstimate:
        """What is said of the frame."""
        self.light.append((frame.timestamp, light_ratio(frame)))
        if self.images is not None:
            frame = self.images.step(frame)
        for samples in self.sensors:
            samples.feed(frame.timestamp)
        estimate = self.tracker.step(frame.left, frame.right, frame.timestamp, frame.mask)
        self.timing.note(frame.timestamp)
        return estimate if self.location is None else estimate.map_camera(self.location.fuse)


def _collect_results(
    request: TrackRequest,
    sequence: StereoSequence,
    steps: _FrameSteps,
    writer: RunWriter,
    pictures: PictureRecorder,
    goes_on: bool,
) -> TrackerResults:
    """What is written when a run has ended, beside poses and frames."""
    tracker, location, saved = steps.tracker, steps.location, request.outputs.save_calibration
    others = {"tracks.npz": writer.write_tracks} if writer.has_tracks else {}
    if location is not None and (placed := location.trajectory()) is not None:
        others["trajectory_location.tum"] = lambda path: write_tum(path, placed)
    if saved is not None and writer.calibration is not None and isinstance(tracker, StereoTracker):
        focal_length = float(tracker.rectifier.describe()["intrinsics"][0])
        learned = learned_calibration(sequence.camera, writer.calibration, focal_length)
        others[str(saved.resolve())] = lambda path: write_calibration(path, learned)
    # A sensor's readings correct poses as they come, not after the fact; what was before a stop is not in memory.
    final = tracker.final_trajectory if location is None and not goes_on else None
    judge_imu = None
    if sequence.imu is not None and location is None and isinstance(tracker, StereoTracker):
        judge_imu = partial(judge_motion, recording=sequence.imu)
    return TrackerResults(tracker.map, tracker.pack_keyframes, final, others, pictures.write, judge_imu)


def _sensors(sequence: StereoSequence, tracker: Tracker) -> list[_Samples]:
    """Of those that the tracker can use."""
    found = list[_Samples]()
    if isinstance(tracker, StereoTracker) and (odometry := sequence.odometry) is not None:
        moved = odometry.samples
        columns = moved.timestamp, moved.linear, moved.angular
        found.append(_Samples(columns, odometry.sensor.time_shift, tracker.add_odometry))
    if isinstance(tracker, StereoTracker) and (imu := sequence.imu) is not None:
        felt = imu.samples
        found.append(_Samples((felt.timestamp, felt.gyro, felt.accel), imu.sensor.time_shift, tracker.add_imu))
    return found


class _Rows:
    """Rows of frames.csv, and who is told of them; of a run that goes on none is written twice.

    `count` includes those before a stop; `skipped` are frames that could not be read, so far.
    """

    def __init__(
        self,
        sequence: StereoSequence,
        writer: RunWriter,
        stopped: StoppedRun | None,
        listeners: Sequence[Callable[[TrackedFrame], None]],
    ) -> None:
        self.sequence, self._writer, self._stopped, self._listeners = sequence, writer, stopped, listeners
        self.count = 0 if stopped is None else len(stopped.timestamps)
        self.skipped = 0

    def frames(self, frames: Iterator[StereoFrame]) -> Iterator[StereoFrame]:
        """Those of the sequence from which the run goes on."""
        return frames if self._stopped is None else self._stopped.frames(frames)

    def add_skipped(self, before: float = math.inf) -> None:
        """Skipped frames are reported together with a later readable one, at `before`, or at the end."""
        for skipped in self.sequence.skipped[self.skipped :]:
            if skipped.timestamp >= before:
                break
            if self._is_new(skipped.timestamp):
                self._writer.add_skipped(skipped.timestamp)
                self.count += 1
            self.skipped += 1

    def add(
        self, result: Estimate | ObjectEstimate, seen: MatchedFrame | None, colour: np.ndarray | None, read_ms: float
    ) -> None:
        """Takes what was said of a frame."""
        if self._is_new(result.camera.timestamp):
            covariances = result.pose_covariance, result.pose_matching_covariance
            self._writer.add(result.camera, result.pose, *covariances, read_ms)
            for listener in self._listeners:
                listener(TrackedFrame(self.count, result, seen, colour))
            self.count += 1

    def check_first(self, result: Estimate | ObjectEstimate) -> None:
        """InputError where the first frame of a run that goes on is no keyframe again."""
        if self._stopped is not None and result.camera.tracks is None:
            raise InputError(
                f"{self.sequence.source}: the frame at {result.camera.timestamp:.6f} s, the last keyframe of the run, "
                "is none any more: track anew with --overwrite"
            )

    def _is_new(self, timestamp: float) -> bool:
        return self._stopped is None or self._stopped.is_new(timestamp)


def _track(frames: Iterator[StereoFrame], steps: _FrameSteps, rows: _Rows, pictures: PictureRecorder) -> None:
    timing, tracker = steps.timing, steps.tracker
    with open_progress() as progress:
        task = progress.add_task("frames", total=rows.sequence.length, note="")
        lost = 0
        began = since = time.perf_counter()
        for done, frame in enumerate(rows.frames(frames), start=1):
            read_ms = 1e3 * (time.perf_counter() - since - timing.waited)
            rows.add_skipped(frame.timestamp)
            result = steps.step(frame)
            if done == 1:
                rows.check_first(result)
            rows.add(result, tracker.last_frame, frame.colour, read_ms)
            if tracker.last_frame is not None:
                pictures.add(result.camera, tracker.last_frame)
            lost += result.status == "lost"
            since = time.perf_counter()
            rate, camera = done / (since - began), result.camera
            note = f"{rate:.1f} frames/s, {lost} lost; {camera.status}, {camera.inliers} inliers"
            progress.update(task, completed=rows.count + timing.dropped + rows.sequence.dropped, note=note)
        rows.add_skipped()
        progress.update(task, completed=rows.count + timing.dropped + rows.sequence.dropped)
