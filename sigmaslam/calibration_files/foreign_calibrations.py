"""Writes a stereo calibration in the forms of other programs; what a form cannot say is refused."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sigmaslam.calibration_files.calibration_writer import write_calibration, write_yaml
from sigmaslam.calibration_files.kalibr_calibration import pinhole_entries
from sigmaslam.errors import CalibrationError, InputError
from sigmaslam.files import atomic_write_text, make_folder
from sigmaslam.geometry.camera import CameraModel, StereoCamera
from sigmaslam.geometry.rectification import StereoRectifier
from sigmaslam.geometry.se3 import se3_inverse

_YAML = (".yaml", ".yml")
# Radians: rays of rectified images that are off by more would not be read back.
_RECTIFIED = 1e-9


def write_foreign_calibration(path: Path, camera: StereoCamera, form: str) -> None:
    """Write a file, or for EuRoC and ROS a folder with a file an eye, that `read_calibration` reads back exactly.

    Sigmas and covariance stay behind in all forms but our own.

    Args:
        path: of the file or folder.
        form: of `FORMS`.

    Raises:
        InputError: the name does not fit the form, or cannot be written.
        CalibrationError: the form has no words for a lens or a pose of this calibration.
    """
    write, suffixes = FORMS[form]
    if suffixes and path.suffix.lower() not in suffixes:
        raise InputError(f"{path}: the form {form} is a file that ends in {' or '.join(suffixes)}: choose such a name")
    if not suffixes and (path.is_file() or path.suffix.lower() in (*_YAML, ".txt")):
        raise InputError(f"{path}: the form {form} is a folder with a file of each eye: choose the name of a folder")
    if form != "own" and (camera.left.skew or camera.right.skew):
        raise CalibrationError(f"the form {form} has no skew, the cameras have {camera.left.skew}, {camera.right.skew}")
    write(path, camera)


def _write_kalibr(path: Path, camera: StereoCamera) -> None:
    content: dict[str, Any] = {}
    for k, eye in enumerate((camera.left, camera.right)):
        entries = pinhole_entries(eye, *_lens(eye, "kalibr", "radtan", (4,)))
        content[f"cam{k}"] = {"cam_overlaps": [1 - k], **entries, "rostopic": f"/cam{k}/image_raw"}
    content["cam1"]["T_cn_cnm1"] = se3_inverse(camera.T_left_right).tolist()
    write_yaml(path, content)


def _write_euroc(path: Path, camera: StereoCamera) -> None:
    eyes = ((camera.left, np.eye(4)), (camera.right, camera.T_left_right))
    lenses = [_lens(eye, "euroc", "radial-tangential", (4,)) for eye, _ in eyes]
    for k, ((eye, T_body_eye), (model, coefficients)) in enumerate(zip(eyes, lenses, strict=True)):
        content = {
            "sensor_type": "camera",
            "comment": "the body is the left camera",
            "T_BS": _matrix(T_body_eye),
            "resolution": [eye.width, eye.height],
            "camera_model": "pinhole",
            "intrinsics": [eye.fx, eye.fy, eye.cx, eye.cy],
            "distortion_model": model,
            "distortion_coefficients": coefficients,
        }
        make_folder(path / f"cam{k}")
        write_yaml(path / f"cam{k}" / "sensor.yaml", content)


def _write_ros(path: Path, camera: StereoCamera) -> None:
    """R and P are those of `StereoRectifier`, of which the pose is read back."""
    rectifier = StereoRectifier(camera)
    eyes = (("left", camera.left, rectifier.R_rectified_left), ("right", camera.right, rectifier.R_rectified_right))
    lenses = [_lens(eye, "ros", "plumb_bob", (5, 8)) for _, eye, _ in eyes]
    make_folder(path)
    for (name, eye, R), (model, coefficients) in zip(eyes, lenses, strict=True):
        P = np.column_stack([rectifier.rectified.matrix, np.zeros(3)])
        P[0, 3] = -rectifier.rectified.focal_baseline * (name == "right")
        content = {
            "image_width": eye.width,
            "image_height": eye.height,
            "camera_name": name,
            "camera_matrix": _matrix(eye.matrix),
            "distortion_model": "rational_polynomial" if len(coefficients) == 8 else model,
            "distortion_coefficients": _matrix(np.array([coefficients])),
            "rectification_matrix": _matrix(R),
            "projection_matrix": _matrix(P),
        }
        write_yaml(path / f"{name}.yaml", content)


def _write_opencv(path: Path, camera: StereoCamera) -> None:
    eyes = (camera.left, camera.right)
    _need_alike(camera, "opencv")
    T = se3_inverse(camera.T_left_right)
    content: dict[str, Any] = {"image_width": camera.left.width, "image_height": camera.left.height}
    content["distortion_model"] = "equidistant" if camera.left.distortion_model == "equidistant" else "radtan"
    for k, eye in enumerate(eyes, start=1):
        content[f"K{k}"] = eye.matrix
        content[f"D{k}"] = np.array([_lens(eye, "opencv", "radtan", (5, 8))[1]])
    _write_storage(path, content | {"R": T[:3, :3], "T": T[:3, 3:]})


def _write_orb_slam(path: Path, camera: StereoCamera) -> None:
    """What ORB-SLAM3's settings have of the cameras; settings of its own program are not ours to choose."""
    eyes = (camera.left, camera.right)
    _need_alike(camera, "orb-slam")
    fisheye = camera.left.distortion_model == "equidistant"
    kind = "Rectified" if camera.is_rectified else "KannalaBrandt8" if fisheye else "PinHole"
    content: dict[str, Any] = {"File.version": "1.0", "Camera.type": kind}
    content |= {"Camera.width": camera.left.width, "Camera.height": camera.left.height}
    keys = ("k1", "k2", "k3", "k4") if kind == "KannalaBrandt8" else ("k1", "k2", "p1", "p2", "k3")
    for k, eye in enumerate(eyes, start=1):
        content |= {f"Camera{k}.{name}": getattr(eye, name) for name in ("fx", "fy", "cx", "cy")}
        if kind != "Rectified":
            lens = _lens(eye, "orb-slam", "radtan", (5,))[1]
            content |= {f"Camera{k}.{name}": value for name, value in zip(keys, lens, strict=True)}
    content |= {"Stereo.b": camera.baseline} if kind == "Rectified" else {"Stereo.T_c1_c2": camera.T_left_right}
    _write_storage(path, content)


def _write_kitti(path: Path, camera: StereoCamera) -> None:
    T = camera.T_left_right
    eyes = (camera.left, camera.right)
    if any(eye.distortion_model != "none" for eye in eyes) or np.abs(T[:3, :3] - np.eye(3)).max() > _RECTIFIED:
        raise CalibrationError(
            "the form kitti (calib.txt) is of rectified images, these are raw: write rectified ones by "
            "`sigmaslam calibrate rectify`, and convert the calibration.yaml beside them"
        )
    _need_alike(camera, "kitti")
    lines = []
    for k, (eye, position) in enumerate(zip(eyes, (np.zeros(3), T[:3, 3]), strict=True)):
        P = eye.matrix @ np.column_stack([np.eye(3), -position])
        lines.append(f"P{k}: {' '.join(repr(float(value)) for value in P.ravel())}\n")
    atomic_write_text(path, "".join(lines))


FORMS: dict[str, tuple[Callable[[Path, StereoCamera], None], tuple[str, ...]]] = {
    "own": (write_calibration, _YAML),
    "kalibr": (_write_kalibr, _YAML),
    "opencv": (_write_opencv, _YAML),
    "ros": (_write_ros, ()),
    "kitti": (_write_kitti, (".txt",)),
    "euroc": (_write_euroc, ()),
    "orb-slam": (_write_orb_slam, _YAML),
}
"""By name: what writes it, and how its file's name may end; nothing for a folder."""


def _need_alike(camera: StereoCamera, form: str) -> None:
    left, right = camera.left, camera.right
    for what, differ in (
        ("image size", (left.width, left.height) != (right.width, right.height)),
        ("lens model", (left.distortion_model == "equidistant") != (right.distortion_model == "equidistant")),
    ):
        if differ:
            raise CalibrationError(
                f"the form {form} has one {what} for both eyes, which differ here: use kalibr or ros"
            )


def _lens(eye: CameraModel, form: str, radtan: str, counts: tuple[int, ...]) -> tuple[str, list[float]]:
    """The form's name of a lens, and its coefficients with zeros up to the next of the form's counts."""
    if eye.distortion_model == "equidistant":
        return "equidistant", list(eye.distortion)
    values = list(eye.distortion)
    while values and values[-1] == 0.0:
        values.pop()
    count = next((count for count in counts if count >= len(values)), None)
    if count is None:
        raise CalibrationError(
            f"the form {form} has {counts[-1]} coefficients of a lens, this one has {len(values)} that are not zero: "
            f"calibrate with --lens radtan{counts[-1]} or equidistant, or choose opencv or ros"
        )
    return radtan, values + [0.0] * (count - len(values))


def _matrix(matrix: np.ndarray) -> dict[str, Any]:
    rows, cols = matrix.shape
    return {"rows": rows, "cols": cols, "data": matrix.ravel().tolist()}


def _write_storage(path: Path, content: Mapping[str, Any]) -> None:
    """OpenCV's FileStorage, which cv2 writes into its place while it goes: a crash would leave half a file."""
    lines = ["%YAML:1.0", "---"]
    for key, value in content.items():
        if isinstance(value, np.ndarray):
            rows, cols = value.shape
            numbers = ", ".join(repr(float(each)) for each in value.ravel())
            lines += [f"{key}: !!opencv-matrix", f"   rows: {rows}", f"   cols: {cols}", "   dt: d"]
            lines.append(f"   data: [ {numbers} ]")
        else:
            lines.append(f'{key}: "{value}"' if isinstance(value, str) else f"{key}: {value!r}")
    atomic_write_text(path, "\n".join(lines) + "\n")
