"""Results of a run that was killed, or whose disk was full, from what it left in its folder."""

from pathlib import Path
from typing import Any

from sigmaslam.bounded_files import read_json
from sigmaslam.errors import InputError
from sigmaslam.files import left_behind
from sigmaslam.run_record.appended_file import check_not_in_use
from sigmaslam.run_record.frame_table import FRAMES_NAME
from sigmaslam.run_record.pose_file import PARTIAL_POSES
from sigmaslam.run_record.relative_pose_file import PARTIAL_RELATIVE_POSES
from sigmaslam.run_record.run_folder import RUN_NAME, UNFINISHED
from sigmaslam.runs.results import output_error, write_results


def finish_run(run: Path) -> dict[str, Any] | None:
    """Writes trajectory, covariances, relative poses, run.json and report.html of a run that did not write them.

    The map, the tracks of `--tracks` and the trajectory after the fact were in memory alone: those that are not there
    are lost.

    Returns:
        The summary in run.json; None where the run is finished, and nothing was to be done.
    Raises:
        InputError: it is no folder of a run, or the run still goes on.
        OutputError: a file could not be written.
    """
    partial = run / PARTIAL_POSES
    if not ((run / RUN_NAME).is_file() and (run / FRAMES_NAME).is_file()):
        raise InputError(f"{run}: holds no {RUN_NAME} and {FRAMES_NAME}; give a folder written by `sigmaslam track`")
    if not (partial.is_file() and (run / PARTIAL_RELATIVE_POSES).is_file()):
        return None
    check_not_in_use(partial)
    for path in left_behind(run):
        path.unlink(missing_ok=True)
    entries = read_json(run / RUN_NAME, "the run", "remove it")
    if entries["ended"] == UNFINISHED:
        entries["ended"] = "killed"
    summary, failed = write_results(run, entries, None, None)
    if failed:
        raise output_error(run, failed)
    return summary
