"""OpenCV's FileStorage (YAML, XML): files of its stereo calibration, and the settings of ORB-SLAM2 and ORB-SLAM3."""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np

from sigmaslam.bounded_files import CALIBRATION_BYTES, read_text
from sigmaslam.calibration_files.camera_infos import CameraInfo, stereo_from_infos
from sigmaslam.calibration_files.lens_models import (
    ImageSize,
    camera_model,
    intrinsics_of,
    naming,
    need_image_size,
    stereo_camera,
)
from sigmaslam.errors import CalibrationError
from sigmaslam.geometry.camera import CameraModel, StereoCamera
from sigmaslam.geometry.checked_yaml import CalibrationYaml
from sigmaslam.geometry.se3 import rigid_motion

logger = logging.getLogger(__name__)

# Names of K, of the coefficients, and of R and P of rectification, for the left and the right eye.
_EYES = (
    (("K1", "K2"), ("D1", "D2"), ("R1", "R2"), ("P1", "P2")),
    (("M1", "M2"), ("D1", "D2"), ("R1", "R2"), ("P1", "P2")),
    (("cameraMatrix1", "cameraMatrix2"), ("distCoeffs1", "distCoeffs2"), ("R1", "R2"), ("P1", "P2")),
    (("LEFT.K", "RIGHT.K"), ("LEFT.D", "RIGHT.D"), ("LEFT.R", "RIGHT.R"), ("LEFT.P", "RIGHT.P")),
)
_SIZES = (("image_width", "image_height"), ("Camera.width", "Camera.height"), ("LEFT.width", "LEFT.height"))


def is_file_storage(text: str) -> bool:
    """Whether a text is in OpenCV's form, YAML or XML."""
    return text.startswith("%YAML") or "<opencv_storage>" in text


def _read_storage(paths: Sequence[Path]) -> CalibrationYaml:
    """The keys of all files.

    cv2.FileStorage is not used: changed bytes in a file make it corrupt memory (OpenCV 5.0).
    """
    entries: dict[str, Any] = {}
    for path in paths:
        entries |= _read_xml(path) if path.suffix.lower() == ".xml" else CalibrationYaml.read(path).entries
    return CalibrationYaml(Path(" and ".join(map(str, paths))), entries)


def _read_xml(path: Path) -> dict[str, Any]:
    text = read_text(path, CALIBRATION_BYTES, "the calibration", CalibrationError)
    try:
        # Entities, which could grow without limit, are declared in a DOCTYPE.
        root = None if "<!DOCTYPE" in text else ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise CalibrationError(f"{path}: cannot read the calibration: {error}") from None
    if root is None or root.tag != "opencv_storage":
        raise CalibrationError(f"{path}: expected <opencv_storage> and no DOCTYPE")
    entries: dict[str, Any] = {}
    for element in root:
        words = (element.text or "").split()
        if element.get("type_id") == "opencv-matrix":
            entries[element.tag] = {"data": (element.findtext("data") or "").split()}
        else:
            entries[element.tag] = words if len(words) > 1 else " ".join(words).strip('"')
    return entries


def _has(storage: CalibrationYaml, *keys: str) -> bool:
    return all(key in storage.entries for key in keys)


def _matrix(storage: CalibrationYaml, key: str, shape: tuple[int, ...] | None = None) -> np.ndarray:
    """A float64 matrix in this shape; None gives its values in one row."""
    values = storage.section(key).numbers("data", (None,))
    if shape is None:
        return values
    if values.size != int(np.prod(shape)):
        size = "x".join(map(str, shape))
        raise storage.error(f"key '{key}' must be a matrix of {size} numbers, it has {values.size}")
    return values.reshape(shape)


def _image_size(storage: CalibrationYaml, given: ImageSize | None) -> ImageSize:
    """(width, height) that the file names; where it names none, the one that is given."""
    for width, height in _SIZES:
        if _has(storage, width, height):
            return storage.integer(width), storage.integer(height)
    if _has(storage, "imageSize"):
        width, height = storage.numbers("imageSize", (2,))
        return int(width), int(height)
    return need_image_size(str(storage.path), given)


def read_opencv(paths: Sequence[Path], image_size: ImageSize | None, rectified: bool) -> StereoCamera:
    """Stereo camera of one file, or of intrinsics and extrinsics.

    The sets of keys: K1 D1 K2 D2 R T (also M1, M2 or cameraMatrix1, distCoeffs1) of OpenCV's stereo calibration, where
    R and T take points of the left camera into the right one; LEFT.K, LEFT.D, LEFT.R, LEFT.P and RIGHT's of ORB-SLAM2;
    Camera1.fx ... and Stereo.T_c1_c2 or Stereo.b of ORB-SLAM3; Camera.fx ... and Camera.bf, of rectified images.

    Args:
        paths: the file, or two whose keys complete each other.
        image_size: (width, height) of the images, for files that do not name it.
        rectified: the images are rectified: P1 and P2 are their cameras.

    Raises:
        CalibrationError: names file, key and what was expected.
    """
    storage = _read_storage(paths)
    with naming(storage.path):
        for keys in _EYES:
            if _has(storage, *keys[0]):
                return _from_matrices(storage, keys, image_size, rectified)
        if _has(storage, "Camera1.fx"):
            return _from_orb_slam3(storage, image_size)
        if _has(storage, "Camera.fx", "Camera.bf"):
            eye = _pinhole(storage, "Camera", image_size)
            return StereoCamera(eye, eye, _beside(storage.number("Camera.bf") / eye.fx))
    raise CalibrationError(
        f"{storage.path}: no stereo calibration; looked for K1 + K2 (or M1, cameraMatrix1) with D1, D2, R and T, "
        "LEFT.K + RIGHT.K, Camera1.fx + Camera2.fx, and Camera.fx + Camera.bf; two files are given as "
        "intrinsics.yml,extrinsics.yml"
    )


def _from_matrices(
    storage: CalibrationYaml, keys: tuple[tuple[str, str], ...], image_size: ImageSize | None, rectified: bool
) -> StereoCamera:
    Ks, Ds, Rs, Ps = keys
    size = _image_size(storage, image_size)
    if rectified or not _has(storage, "R", "T"):
        wanted = (*Ps, *(() if rectified else Rs))
        if not _has(storage, *wanted):
            missing = ", ".join(key for key in wanted if not _has(storage, key))
            instead = "" if rectified else "R and T (from the left camera into the right one), or "
            raise CalibrationError(f"{instead}{missing} missing; extrinsics in another file are given with a comma")
        infos = [
            CameraInfo(
                name=str(storage.path),
                width=size[0],
                height=size[1],
                lens=storage.text("distortion_model", "radtan"),
                D=() if rectified else _matrix(storage, D).tolist(),
                K=_matrix(storage, K, (3, 3)),
                R=np.eye(3) if rectified else _matrix(storage, R, (3, 3)),
                P=_matrix(storage, P, (3, 4)),
            )
            for K, D, R, P in zip(Ks, Ds, Rs, Ps, strict=True)
        ]
        return stereo_from_infos(infos[0], infos[1], rectified)
    models = []
    for key, D in zip(Ks, Ds, strict=True):
        K, where = _matrix(storage, key, (3, 3)), str(storage.path)
        models.append(camera_model(where, size, intrinsics_of(K), *_lens(storage, D), key=D))
    rotation = _matrix(storage, "R")
    R = cv2.Rodrigues(rotation)[0] if rotation.size == 3 else _matrix(storage, "R", (3, 3))
    return stereo_camera(f"{storage.path}: R and T", models, rigid_motion(R, _matrix(storage, "T", (3,))))


def _lens(storage: CalibrationYaml, key: str) -> tuple[str, list[float]]:
    """Lens and coefficients of a file that need not say whether these are cv2.fisheye's, which are four."""
    coefficients = _matrix(storage, key).tolist()
    name = storage.text("distortion_model", "")
    if not name and len(coefficients) == 4 and any(coefficients):
        logger.warning(
            "%s: %s has 4 coefficients, taken as k1 k2 p1 p2; if they are cv2.fisheye's, "
            'write distortion_model: "equidistant" into the file',
            storage.path,
            key,
        )
    return name or "radtan", coefficients


def _from_orb_slam3(storage: CalibrationYaml, image_size: ImageSize | None) -> StereoCamera:
    kind = storage.text("Camera.type", "PinHole")
    names: dict[str, tuple[str, ...]] = {
        "pinhole": ("k1", "k2", "p1", "p2", "k3"),
        "kannalabrandt8": ("k1", "k2", "k3", "k4"),
        "rectified": (),
    }
    if kind.lower() not in names:
        raise CalibrationError(f"Camera.type is {kind!r}; known are PinHole, KannalaBrandt8 and Rectified")
    models = []
    for camera in ("Camera1", "Camera2"):
        if kind.lower() == "rectified" and not _has(storage, f"{camera}.fx"):
            camera = "Camera1"
        keys = [f"{camera}.{name}" for name in names[kind.lower()]]
        lens = "equidistant" if kind.lower() == "kannalabrandt8" else "radtan"
        values = [storage.number(key) for key in keys if lens == "equidistant" or _has(storage, key)]
        models.append(_pinhole(storage, camera, image_size, lens, values))
    if kind.lower() == "rectified":
        return StereoCamera(models[0], models[1], _beside(storage.number("Stereo.b")))
    return StereoCamera(models[0], models[1], _matrix(storage, "Stereo.T_c1_c2", (4, 4)))


def _pinhole(
    storage: CalibrationYaml,
    camera: str,
    image_size: ImageSize | None,
    lens: str = "none",
    values: Sequence[float] = (),
) -> CameraModel:
    intrinsics = [storage.number(f"{camera}.{name}") for name in ("fx", "fy", "cx", "cy")]
    return camera_model(str(storage.path), _image_size(storage, image_size), intrinsics, lens, values, "Camera.type")


def _beside(baseline: float) -> np.ndarray:
    return rigid_motion(np.eye(3), [baseline, 0.0, 0.0])
