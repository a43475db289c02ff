"""What `track` gives its frames to beside the run folder: a stream, a video, a viewer, a web page."""

import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import typer

from sigmaslam.cli.extras import need_extra
from sigmaslam.errors import InputError
from sigmaslam.geometry.camera import StereoCamera
from sigmaslam.live.estimate_stream import PipeStream, open_stream
from sigmaslam.live.frame_sink import FrameSink, ThreadedSink, check_sink_path
from sigmaslam.live.video import VideoSink
from sigmaslam.run_record.frame_table import TRACKED
from sigmaslam.run_record.run_folder import RERUN_NAME, VIDEO_NAME, describe_camera
from sigmaslam.run_record.verdict import calibration_verdict, expected_offset
from sigmaslam.runs.request import LiveOptions
from sigmaslam.slam.estimate import CalibrationEstimate

if TYPE_CHECKING:
    from sigmaslam.live.rerun_viewer import RerunSink

UNREAD = 1
"""Exit code where nobody reads the output any more."""
# How long a run that was stopped waits for the reader of its stream, seconds.
_PATIENCE = 5.0


@contextmanager
def open_sinks(options: LiveOptions, out: Path, camera: StereoCamera) -> Iterator[list[FrameSink]]:
    """The sinks that the command line names; with a stream on the standard output all else goes to the standard error.

    Args:
        options: stream, video, viewer, web page and dense cloud.
        out: folder of the run.
    Raises:
        InputError: a name is wrong.
        typer.Exit: the run is whole, but nobody reads the stream any more.
    """
    sinks: list[FrameSink] = []
    if options.video is not None:
        check_sink_path("--video", options.video, out, VIDEO_NAME)
        sinks.append(ThreadedSink(VideoSink(options.video, camera)))
    viewer = None if options.viewer is None else _open_viewer(options.viewer, out, camera)
    if options.dense is not None:
        sinks.append(_open_cloud(options.dense, out, camera, None if viewer is None else viewer.show_cloud))
    if viewer is not None:
        # It is closed after the cloud, which it shows.
        sinks.append(ThreadedSink(viewer))
    if options.serve is not None:
        sinks.append(ThreadedSink(_open_page(options.serve, camera)))
    if options.stream is None:
        yield sinks
        return
    told = open_stream(options.stream)
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


def _open_viewer(viewer: str, out: Path, camera: StereoCamera) -> "RerunSink":
    name, colon, file = viewer.partition(":")
    is_url = name in ("rerun+http", "rerun+https") and file.startswith("//")
    if not is_url and (name != "rerun" or (colon and not file)):
        mend = "give rerun for a window, rerun:FILE.rrd, or an open viewer's rerun+http://HOST:9876/proxy"
        raise InputError(f"--viewer {viewer}: is no viewer; {mend}")
    need_extra("viewer")
    from sigmaslam.live.rerun_viewer import RerunSink

    if is_url:
        return RerunSink(viewer, camera)
    path = Path(file) if file else None
    if path is not None:
        check_sink_path("--viewer", path, out, RERUN_NAME)
    return RerunSink(path, camera)


def _open_page(address: str, camera: StereoCamera) -> FrameSink:
    from sigmaslam.live.web_page import WebPageSink

    expected = expected_offset(describe_camera(camera))

    def judge(calibration: CalibrationEstimate, statuses: Counter[str], points: int) -> str:
        return calibration_verdict(calibration, sum(statuses[each] for each in TRACKED), points, expected)

    page = WebPageSink(address, camera, judge)
    typer.echo(f"Watch the run at {page.url}", err=True)
    return page


def _open_cloud(
    path: Path, out: Path, camera: StereoCamera, show: Callable[[np.ndarray, np.ndarray], None] | None
) -> FrameSink:
    from sigmaslam.reconstruction.live_cloud import CloudSink
    from sigmaslam.run_record.dense_points import CLOUD_NAME

    check_sink_path("--dense", path, out, CLOUD_NAME)
    return ThreadedSink(CloudSink(path, out, camera, show))
