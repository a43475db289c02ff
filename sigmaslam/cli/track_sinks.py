"""What `track` gives its frames to beside the run folder: a stream, a video."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from sigmaslam.geometry.camera import StereoCamera
    from sigmaslam.runs.frame_sink import FrameSink

UNREAD = 1
"""Exit code where nobody reads the output any more."""
# How long a run that was stopped waits for the reader of its stream, seconds.
_PATIENCE = 5.0


@contextmanager
def open_sinks(stream: str | None, video: Path | None, out: Path, camera: StereoCamera) -> Iterator[list[FrameSink]]:
    """The sinks that the command line names; with a stream on the standard output all else goes to the standard error.

    Args:
        stream: `stdout` or `udp://HOST:PORT`.
        video: .mp4 to write.
        out: folder of the run.
        camera: of its images.
    Raises:
        InputError: a name is wrong.
        typer.Exit: the run is whole, but nobody reads the stream any more.
    """
    from sigmaslam.runs.estimate_stream import PipeStream, open_stream

    sinks: list[FrameSink] = []
    if video is not None:
        sinks.append(_open_video(video, out, camera))
    if stream is None:
        yield sinks
        return
    told = open_stream(stream)
    sinks.insert(0, told)
    if not isinstance(told, PipeStream):
        yield sinks
        return
    with redirect_stdout(sys.stderr):
        try:
            yield sinks
        except BaseException:
            told.close()
            told.wait(_PATIENCE)
            raise
        told.wait(None)
    if told.is_broken:
        raise typer.Exit(UNREAD)


def _open_video(path: Path, out: Path, camera: StereoCamera) -> FrameSink:
    from sigmaslam.runs.frame_sink import ThreadedSink
    from sigmaslam.runs.video import VideoSink, check_video_path

    check_video_path(path, out)
    return ThreadedSink(VideoSink(path, camera))
