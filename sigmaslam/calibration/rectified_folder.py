"""A sequence as a folder of rectified pairs."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from sigmaslam.calibration_files.calibration_writer import write_calibration
from sigmaslam.files import atomic_write_bytes, atomic_write_text, check_new_folder, make_folder
from sigmaslam.geometry.camera import CameraModel
from sigmaslam.geometry.rectification import StereoRectifier
from sigmaslam.geometry.se3 import rigid_motion
from sigmaslam.readers.stereo_sequence import StereoSequence


def write_rectified(sequence: StereoSequence, out: Path, done: Callable[[], object]) -> int:
    """Write `left/` and `right/` PNG images, `times.txt` and `calibration.yaml`, which `track` reads.

    Args:
        out: folder, new or empty.
        done: called after each pair.

    Returns:
        The number of pairs.

    Raises:
        InputError: `out` holds something or cannot be written, or no pair can be read.
    """
    check_new_folder(out)
    rectifier = StereoRectifier(sequence.camera)
    for eye in ("left", "right"):
        make_folder(out / eye)
    view = rectifier.rectified
    model = CameraModel(view.width, view.height, view.fx, view.fy, view.cx, view.cy)
    place = rigid_motion(np.eye(3), [view.baseline, 0.0, 0.0])
    # Known as well as before.
    write_calibration(out / "calibration.yaml", replace(sequence.camera, left=model, right=model, T_left_right=place))
    times = []
    for frame in sequence.frames():
        for eye, image in zip(("left", "right"), rectifier.rectify(frame.left, frame.right), strict=True):
            atomic_write_bytes(out / eye / f"{frame.index:06d}.png", cv2.imencode(".png", image)[1].tobytes())
        times.append(frame.timestamp)
        done()
    atomic_write_text(out / "times.txt", "".join(f"{time!r}\n" for time in times))
    return len(times)
