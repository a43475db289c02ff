"""Removing a run to make room for another one."""

from pathlib import Path

from sigmaslam.errors import InputError
from sigmaslam.files import check_new_folder, left_behind
from sigmaslam.run_record.appended_file import check_not_in_use
from sigmaslam.run_record.dense_points import CLOUD_NAME, DENSE_NAME, RECONSTRUCTION_NAME
from sigmaslam.run_record.evaluated_frames import EVALUATED_FRAMES_NAME, EVALUATION_NAME
from sigmaslam.run_record.frame_pictures import PICTURES_NAME
from sigmaslam.run_record.frame_table import FRAMES_NAME
from sigmaslam.run_record.inertial_file import INERTIAL_NAME
from sigmaslam.run_record.pose_file import PARTIAL_POSES, POSES_NAME
from sigmaslam.run_record.recorded_run import REFINE_NAME, REFINED_TRAJECTORY
from sigmaslam.run_record.relative_pose_file import PARTIAL_RELATIVE_POSES, RELATIVE_POSES_NAME
from sigmaslam.run_record.run_folder import FINAL_COVARIANCE, FINAL_TRAJECTORY, RERUN_NAME, RUN_NAME, VIDEO_NAME

_NAMES = (
    *(FRAMES_NAME, PARTIAL_POSES, PARTIAL_RELATIVE_POSES, RELATIVE_POSES_NAME, POSES_NAME, PICTURES_NAME),
    *("trajectory.tum", "trajectory.kitti", "times.txt", "covariance.npy", "covariance_matching.npy"),
    *(FINAL_TRAJECTORY, FINAL_COVARIANCE, "trajectory_location.tum", "tracks.npz", "map.npz", "map.ply"),
    *(EVALUATION_NAME, EVALUATED_FRAMES_NAME, "evaluation.png", REFINE_NAME, REFINED_TRAJECTORY, "report.html"),
    *(VIDEO_NAME, RERUN_NAME, INERTIAL_NAME),
    *(DENSE_NAME, RECONSTRUCTION_NAME, CLOUD_NAME),
    RUN_NAME,  # the last one, by which the folder is known
)


def remove_run(folder: Path) -> None:
    """Removes the files of a run from its folder; nothing is done where there is no folder, or an empty one.

    Raises:
        InputError: the folder holds other files, or what is no run, or the run still goes on: nothing is removed then.
    """
    if not folder.is_dir() or not any(folder.iterdir()):
        check_new_folder(folder)
        return
    if not (folder / RUN_NAME).is_file():
        raise InputError(f"{folder}: holds no {RUN_NAME}, so it is no run that could be removed: choose another --out")
    leftovers = left_behind(folder)
    ours = {*_NAMES, *(path.name for path in leftovers)}
    others = sorted(path.name for path in folder.iterdir() if path.name not in ours)
    if others:
        raise InputError(f"{folder}: holds {others[0]}, which no run has written: move it, or choose another --out")
    if (folder / PARTIAL_POSES).is_file():
        check_not_in_use(folder / PARTIAL_POSES)
    try:
        for path in (*leftovers, *(folder / name for name in _NAMES)):
            path.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{error.filename}: cannot be removed ({error.strerror}): choose another --out") from None


def remove_results(folder: Path) -> None:
    """Removes what was made of a run in its folder, and leaves what `write_results` makes it of."""
    for name in _NAMES:
        if name not in (RUN_NAME, FRAMES_NAME, INERTIAL_NAME, PARTIAL_POSES, PARTIAL_RELATIVE_POSES):
            (folder / name).unlink(missing_ok=True)
