"""Sequences tracked into a run folder, in few words."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sigmaslam.readers import StereoSequence
from sigmaslam.runs.request import InputOptions, LiveOptions, OutputOptions, TrackerOptions, TrackRequest
from sigmaslam.runs.track import track_sequence


def track(
    source: Path | StereoSequence,
    out: Path,
    frontend: str = "learned",
    tracks: bool = False,
    resume: bool = False,
    live: LiveOptions | None = None,
    **tracker: Any,
) -> dict[str, Any]:
    """The summary of the run; other arguments are those of `TrackerOptions`."""
    outputs = OutputOptions(out, tracks=tracks, resume=resume)
    return track_sequence(
        TrackRequest(InputOptions(source), outputs, TrackerOptions(frontend, **tracker), live or LiveOptions())
    )
