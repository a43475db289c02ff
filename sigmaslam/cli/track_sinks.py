"""What `track` gives its frames to beside the run folder: a stream."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from sigmaslam.runs.frame_sink import FrameSink

UNREAD = 1
"""Exit code where nobody reads the output any more."""
# How long a run that was stopped waits for the reader of its stream, seconds.
_PATIENCE = 5.0


@contextmanager
def open_sinks(stream: str | None) -> Iterator[list[FrameSink]]:
    """The sinks that the command line names; with a stream on the standard output all else goes to the standard error.

    Args:
        stream: `stdout` or `udp://HOST:PORT`.
    Raises:
        InputError: a name is wrong.
        typer.Exit: the run is whole, but nobody reads the stream any more.
    """
    from sigmaslam.runs.estimate_stream import PipeStream, open_stream

    told = None if stream is None else open_stream(stream)
    if not isinstance(told, PipeStream):
        yield [] if told is None else [told]
        return
    with redirect_stdout(sys.stderr):
        try:
            yield [told]
        except BaseException:
            told.close()
            told.wait(_PATIENCE)
            raise
        told.wait(None)
    if told.is_broken:
        raise typer.Exit(UNREAD)
