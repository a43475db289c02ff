"""Tracking a whole sequence, from disk or live, into a run folder."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from sigmaslam.config import TrackerConfig
from sigmaslam.errors import SigmaSlamError
from sigmaslam.estimate import Estimate
from sigmaslam.outputs import RunWriter, describe_camera
from sigmaslam.readers import StereoFrame, StereoSequence
from sigmaslam.tracker import StereoTracker


def track_sequence(
    sequence: StereoSequence,
    out: Path,
    frontend: str = "learned",
    backend: str = "onnx",
    config: TrackerConfig | None = None,
    map_path: Path | None = None,
    tracks: bool = False,
) -> dict[str, Any]:
    """Tracks a sequence and writes the run folder; partial results are kept when it is stopped or fails.

    Args:
        sequence: opened by `sigmaslam.readers.open_sequence` or `open_cameras`.
        out: run folder, new or empty.
        frontend, backend, config: of `StereoTracker`.
        map_path: map.npz of an earlier run, whose world the poses are given in.
        tracks: write tracks.npz, too: what keyframes saw, for `sigmaslam refine`.
    Returns:
        The summary that run.json holds.
    Raises:
        InputError: the folder is not empty, or the sequence breaks off; what was computed is on disk then.
        KeyboardInterrupt: passed on after the partial results are written.
    """
    tracker = StereoTracker(sequence.camera, frontend, backend, config)
    if map_path is not None:
        tracker.load_map(map_path)
    writer = RunWriter(out, tracker.describe_rectified() if tracks else None)
    ended = "complete"
    try:
        # However this ends, cameras are given back before the results are written.
        with closing(sequence.frames()) as frames:
            _track(sequence, frames, tracker, writer)
    except KeyboardInterrupt:
        ended = "interrupted"
        raise
    except SigmaSlamError as error:
        ended = f"failed: {error}"
        raise
    except BaseException as error:
        ended = f"crashed: {error!r}"
        raise
    finally:
        summary = writer.finish(
            tracker.map(),
            tracker.pack_keyframes(),
            {
                "input": str(sequence.source),
                "format": sequence.format,
                "frontend": frontend,
                "backend": backend,
                "ended": ended,
                "dropped": sequence.dropped,
                "configuration": asdict(tracker.config),
                "calibration": describe_camera(sequence.camera),
            },
        )
    return summary


def _track(sequence: StereoSequence, frames: Iterator[StereoFrame], tracker: StereoTracker, writer: RunWriter) -> None:
    with Progress(
        BarColumn(bar_width=16),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
        console=Console(stderr=True),
    ) as progress:
        task = progress.add_task("", total=sequence.length, note="")
        noted, done = 0, 0
        began = since = time.perf_counter()
        for frame in frames:
            read_ms = 1e3 * (time.perf_counter() - since)
            # Frames that could not be read come to light with the next one that could.
            for skipped in sequence.skipped[noted:]:
                writer.add_skipped(skipped.timestamp)
            noted = len(sequence.skipped)
            estimate = tracker.step(frame.left, frame.right, frame.timestamp)
            writer.add(estimate, read_ms)
            writer.add_views(tracker.keyframe_views)
            done += 1
            since = time.perf_counter()
            progress.update(task, completed=done + noted, note=_note(estimate, done / (since - began)))
        for skipped in sequence.skipped[noted:]:
            writer.add_skipped(skipped.timestamp)
        progress.update(task, completed=done + len(sequence.skipped))


def _note(estimate: Estimate, rate: float) -> str:
    return f"{rate:.1f}/s, {estimate.inliers} inliers, belief {estimate.belief:.3f}, {estimate.status}"
