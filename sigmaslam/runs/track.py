"""Tracking a whole sequence, from disk or live, into a run folder."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Any

from sigmaslam.bodies.object_region import read_region
from sigmaslam.bodies.object_tracker import OBJECT_CONFIG, ObjectEstimate, ObjectTracker
from sigmaslam.checks.finding import Finding
from sigmaslam.errors import InputError, OutputError, SigmaSlamError
from sigmaslam.files import printable
from sigmaslam.fusion.location_filter import LocationFilter
from sigmaslam.fusion.readings import Locations
from sigmaslam.inference.networks import WeightsFolder
from sigmaslam.live.frame_sink import FrameSink, TrackedFrame, close_all
from sigmaslam.progress import open_progress
from sigmaslam.readers import StereoFrame, StereoSequence
from sigmaslam.readers.trajectory_files import write_tum
from sigmaslam.run_record.frame_pictures import PictureRecorder
from sigmaslam.run_record.real_time import Latency, RealTimePlayer, describe_real_time
from sigmaslam.run_record.run_folder import RunWriter, describe_camera, describe_weights
from sigmaslam.runs.denoise import StereoFilter
from sigmaslam.runs.results import TrackerResults, output_error, write_results
from sigmaslam.runs.resume import StoppedRun, read_stopped_run
from sigmaslam.runs.stop_signals import Stopped, StopSignals
from sigmaslam.slam.config import TrackerConfig
from sigmaslam.slam.estimate import Estimate
from sigmaslam.slam.start_pose import StartPose
from sigmaslam.slam.tracker import StereoTracker

Tracker = StereoTracker | ObjectTracker


def track_sequence(
    sequence: StereoSequence,
    out: Path,
    frontend: str = "learned",
    backend: str = "onnx",
    config: TrackerConfig | None = None,
    map_path: Path | None = None,
    tracks: bool = False,
    track_object: str | None = None,
    locations: Locations | None = None,
    real_time: bool = False,
    threads: int = 2,
    findings: Sequence[Finding] = (),
    denoise: bool = False,
    resume: bool = False,
    provider: str = "cpu",
    weights: WeightsFolder = None,
    on_estimate: Callable[[Estimate | ObjectEstimate], None] | None = None,
    sinks: Sequence[FrameSink] = (),
) -> dict[str, Any]:
    """Tracks a sequence and writes the run folder; partial results are kept when it is stopped or fails.

    Args:
        sequence: opened by `sigmaslam.readers.open_sequence` or `open_cameras`.
        out: run folder, new or empty.
        frontend, backend, config, threads, provider, weights: of `StereoTracker`.
        map_path: map.npz of an earlier run; poses are in its world.
        tracks: write tracks.npz, too, the observations of keyframes for `sigmaslam refine`.
        track_object: box or mask, see `read_region`: the camera is at rest and follows one body. Poses are then
            T_camera_object, their covariances in the body's frame, and the map that of the body in its own frame.
        locations: readings to fuse of a sensor on the moving camera or body; writes trajectory_location.tum, too, the
            poses in the sensor's world.
        real_time: play a recording at its time stamps; frames are dropped when tracking falls behind.
        findings: what a check of the input found; they are kept in run.json, and explain a run that fails.
        denoise: filter the images before they are tracked, see `sigmaslam.image_filtering.SequenceFilter`.
        resume: `out` holds a run of the same sequence that was stopped or killed, which goes on where it was. The map
            is then that of the frames from its last keyframe on, and there is no trajectory after the fact.
        on_estimate: called with the estimate of each frame when it is on disk; an error that it raises ends the run.
        sinks: take each frame after that, and are closed in the end.
    Returns:
        The summary in run.json, in which `failure` says why less than half of the frames were tracked, and is None
        where more were; with `locations` also the counts of the readings, under `location`, and in real time
        what was dropped and the latency, under `real_time`.
    Raises:
        InputError: the folder is not empty, or holds no run that could go on, an argument is wrong, or the sequence
            breaks off; what was computed is on disk then.
        OutputError: results could not be written, the others are; what was said of each frame is on disk.
        Stopped: by Ctrl-C, SIGTERM or SIGHUP, after the partial results are written.
    """
    if track_object is not None and (map_path is not None or tracks):
        raise InputError("--map and --tracks are of a moving camera's world: leave them out with --track-object")
    if resume:
        _check_can_resume(sequence, map_path, tracks, track_object, locations, real_time)
    settings: dict[str, Any] = {
        "input": printable(sequence.source),
        "format": sequence.format,
        "frontend": frontend,
        "backend": backend,
        "provider": provider,
        "weights": describe_weights(frontend, backend, weights),
        "map": None if map_path is None else printable(map_path),
        "configuration": asdict(config or (TrackerConfig() if track_object is None else OBJECT_CONFIG)),
        "calibration": describe_camera(sequence.camera),
    }
    stopped = read_stopped_run(out, settings) if resume else None
    if stopped is not None:
        stopped.check_sequence(sequence)
    start = None if stopped is None else stopped.start
    tracker = _build_tracker(sequence, frontend, backend, config, track_object, threads, start, provider, weights)
    location = None if locations is None else LocationFilter(locations, track_object is not None)
    rectified = None
    if isinstance(tracker, StereoTracker):
        if map_path is not None:
            tracker.load_map(map_path)
        rectified = tracker.describe_rectified() if tracks else None
    run = {
        **settings,
        "checks": [asdict(each) for each in findings],
        **({} if stopped is None else {"resumed_at": stopped.resumed_at}),
    }
    run |= _describe_location(location)
    if track_object is not None:
        run["object"] = {"region": track_object, "origin": None}  # which the first frame gives
    if stopped is not None:
        stopped.make_ready()
    writer = RunWriter(out, run, rectified, None if stopped is None else len(stopped.records))
    pictures = PictureRecorder(sequence.length)
    timing = _Timing(sequence, real_time)
    images = StereoFilter() if denoise else None
    listeners = [*((lambda frame: on_estimate(frame.result),) if on_estimate else ()), *(sink.add for sink in sinks)]
    if timing.is_real:
        tracker.warm_up()
    stopped_by: BaseException | None = None
    with StopSignals() as signals:
        try:
            # Cameras are released before the results are written, even after an error.
            with closing(sequence.frames()) as frames:
                played = timing.play(frames)
                _track(sequence, played, tracker, writer, pictures, location, timing, images, stopped, listeners)
            signals.hold()
        except BaseException as error:
            signals.hold()
            # Where the terminal is gone, showing the progress fails as well.
            stopped_by = error if signals.received is None else Stopped(signals.received)
        writer.close()
        unfinished = close_all(sinks)
        run = {
            **writer.run,
            "ended": _describe_end(stopped_by),
            "dropped": timing.dropped,
            **timing.describe(),
            **_describe_object(tracker, track_object),
            **_describe_location(location),
            **({} if images is None else {"noise": images.describe()}),
        }
        others = {"tracks.npz": writer.write_tracks} if writer.has_tracks else {}
        if location is not None and location.T_sensor_world is not None:
            others["trajectory_location.tum"] = lambda path: _write_location(path, location)
        # A sensor's readings correct poses as they come, not after the fact; what was before a stop is not in memory.
        final = tracker.final_trajectory if location is None and stopped is None else None
        results = TrackerResults(tracker.map, tracker.pack_keyframes, final, others, pictures.write)
        summary, failed = write_results(out, run, writer.calibration, results)
    if stopped_by is not None:
        raise stopped_by
    if failed:
        raise output_error(out, failed)
    if unfinished:
        raise OutputError(f"{', '.join(unfinished)} could not be written, as said above; the run itself is in {out}")
    summary = {**summary, **timing.describe()}
    return summary if location is None else {**summary, "location": asdict(location.summary)}


def _write_location(path: Path, location: LocationFilter) -> None:
    """Writes the poses in the world of a sensor that is known."""
    trajectory = location.trajectory()
    assert trajectory is not None
    write_tum(path, trajectory)


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


class _Timing:
    """Whether frames come in real time, from cameras or played, and how long their poses take."""

    def __init__(self, sequence: StereoSequence, real_time: bool) -> None:
        self._sequence = sequence
        self._live = sequence.format == "camera"
        self._latency = Latency() if self._live or real_time else None
        self._player: RealTimePlayer | None = None

    @property
    def is_real(self) -> bool:
        """Frames do not wait for the tracker."""
        return self._latency is not None

    @property
    def dropped(self) -> int:
        """Frames that came while others were tracked."""
        return self._sequence.dropped if self._player is None else self._player.dropped

    @property
    def waited(self) -> float:
        """Seconds until the last frame came, when it was the tracker that was early."""
        return 0.0 if self._player is None else self._player.waited

    def play(self, frames: Iterator[StereoFrame]) -> Iterator[StereoFrame]:
        """The frames as they come; cameras give them in real time anyway."""
        if self._latency is not None and not self._live:
            self._player = RealTimePlayer(frames, self._latency)
            frames = self._player.play()
        for frame in frames:
            if self._latency is not None:
                self._latency.start(frame.timestamp)
            yield frame

    def note(self, timestamp: float) -> None:
        """The pose of that frame is known."""
        if self._latency is not None:
            self._latency.note(timestamp)

    def describe(self) -> dict[str, Any]:
        """Entries of run.json."""
        return {} if self._latency is None else describe_real_time(self._latency, self.dropped)


def _build_tracker(
    sequence: StereoSequence,
    frontend: str,
    backend: str,
    config: TrackerConfig | None,
    track_object: str | None,
    threads: int,
    start: StartPose | None,
    provider: str,
    weights: WeightsFolder,
) -> Tracker:
    if track_object is None:
        return StereoTracker(sequence.camera, frontend, backend, config, None, threads, start, provider, weights)
    region = read_region(track_object, sequence.camera.left.width, sequence.camera.left.height)
    return ObjectTracker(sequence.camera, region, frontend, backend, config, threads, provider, weights)


def _check_can_resume(
    sequence: StereoSequence,
    map_path: Path | None,
    tracks: bool,
    track_object: str | None,
    locations: Locations | None,
    real_time: bool,
) -> None:
    """What needs what was in memory when the run was stopped, or frames that do not come again, is refused."""
    refused = {
        "--camera": sequence.format == "camera",
        "--map": map_path is not None,
        "--tracks": tracks,
        "--track-object": track_object is not None,
        "--location": locations is not None,
        "--realtime": real_time,
    }
    for option, given in refused.items():
        if given:
            raise InputError(f"--resume does not go with {option}: leave one of them out")


def _describe_object(tracker: Tracker, track_object: str | None) -> dict[str, Any]:
    """Entries of run.json for a followed body: its region, and the origin of its frame in the first left camera's."""
    if not isinstance(tracker, ObjectTracker):
        return {}
    return {"object": {"region": track_object, "origin": tracker.origin.tolist()}}


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


def _track(
    sequence: StereoSequence,
    frames: Iterator[StereoFrame],
    tracker: Tracker,
    writer: RunWriter,
    pictures: PictureRecorder,
    location: LocationFilter | None,
    timing: _Timing,
    images: StereoFilter | None,
    stopped: StoppedRun | None,
    listeners: Sequence[Callable[[TrackedFrame], None]],
) -> None:
    row = 0  # of frames.csv
    if stopped is not None:
        frames = stopped.frames(frames)
        row = len(stopped.timestamps)
    with open_progress() as progress:
        task = progress.add_task("frames", total=sequence.length, note="")
        reported, done, lost = 0, 0, 0
        began = since = time.perf_counter()
        for frame in frames:
            read_ms = 1e3 * (time.perf_counter() - since - timing.waited)
            # Skipped frames are reported together with a later readable one.
            while reported < len(sequence.skipped) and sequence.skipped[reported].timestamp < frame.timestamp:
                if stopped is None or stopped.is_new(sequence.skipped[reported].timestamp):
                    writer.add_skipped(sequence.skipped[reported].timestamp)
                    row += 1
                reported += 1
            if images is not None:
                frame = images.step(frame)
            estimate = tracker.step(frame.left, frame.right, frame.timestamp)
            timing.note(frame.timestamp)
            if location is not None:
                estimate = estimate.map_camera(location.fuse)
            if stopped is not None and not done and estimate.camera.tracks is None:
                raise InputError(
                    f"{sequence.source}: the frame at {frame.timestamp:.6f} s, the last keyframe of the run, "
                    "is none any more: track anew with --overwrite"
                )
            if stopped is None or stopped.is_new(frame.timestamp):
                writer.add(
                    estimate.camera, estimate.pose, estimate.pose_covariance, estimate.pose_matching_covariance, read_ms
                )
                for listener in listeners:
                    listener(TrackedFrame(row, estimate, tracker.last_frame))
                row += 1
            if tracker.last_frame is not None:
                pictures.add(estimate.camera, tracker.last_frame)
            done += 1
            lost += estimate.status == "lost"
            since = time.perf_counter()
            note = _note(estimate.camera, lost, done / (since - began))
            progress.update(task, completed=done + reported + timing.dropped, note=note)
        for skipped in sequence.skipped[reported:]:
            if stopped is None or stopped.is_new(skipped.timestamp):
                writer.add_skipped(skipped.timestamp)
        progress.update(task, completed=done + len(sequence.skipped) + timing.dropped)


def _note(estimate: Estimate, lost: int, rate: float) -> str:
    return f"{rate:.1f} frames/s, {lost} lost; {estimate.status}, {estimate.inliers} inliers"
