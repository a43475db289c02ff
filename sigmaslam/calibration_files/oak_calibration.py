"""Calibration of an OAK camera, the JSON that depthai's eepromToJsonFile writes."""

from pathlib import Path
from typing import Any

import numpy as np

from sigmaslam.bounded_files import CALIBRATION_BYTES, read_json
from sigmaslam.calibration_files.lens_models import camera_model, intrinsics_of, naming
from sigmaslam.errors import CalibrationError
from sigmaslam.geometry.camera import CameraModel, StereoCamera
from sigmaslam.geometry.checked_yaml import CalibrationYaml
from sigmaslam.geometry.se3 import rigid_motion

# depthai's numbers of the two eyes, CAM_B and CAM_C, where the file does not name them.
_EYES = {"leftCameraSocket": 1, "rightCameraSocket": 2}
_LENSES = {0: "radtan", 1: "equidistant"}
_CENTIMETRE = 1e-2


def read_oak(path: Path) -> StereoCamera:
    """Stereo camera of the left and right socket, at the full size of the sensors.

    The extrinsics of a camera take its points into the frame of `toCameraSocket`, in centimetres; from camera to
    camera they form a tree, whose paths from both eyes meet.

    Raises:
        CalibrationError: names file, key and what was expected.
    """
    mend = "write it again by depthai's eepromToJsonFile"
    entries = read_json(path, "the calibration", mend, CalibrationError, CALIBRATION_BYTES)
    if not isinstance(entries, dict) or not isinstance(entries.get("cameraData"), list):
        raise CalibrationError(
            f"{path}: no key 'cameraData': of JSON, only what depthai's eepromToJsonFile writes is read"
        )
    cameras = _cameras(path, entries["cameraData"])
    named = entries.get("stereoRectificationData")
    named = named if isinstance(named, dict) else {}
    sockets = [int(named.get(key, socket)) for key, socket in _EYES.items()]
    if min(sockets) < 0:
        sockets = list(_EYES.values())
    left, right = sockets
    models = [_camera_model(_camera(path, cameras, socket)) for socket in sockets]
    to_root = [_chain(path, cameras, socket) for socket in sockets]
    shared = next((socket for socket in to_root[0] if socket in to_root[1]), None)
    if shared is None:
        raise CalibrationError(f"{path}: the extrinsics of sockets {left} and {right} have no camera in common")
    with naming(f"{path}: extrinsics of sockets {left} and {right}"):
        return StereoCamera(models[0], models[1], np.linalg.inv(to_root[0][shared]) @ to_root[1][shared])


def _cameras(path: Path, pairs: list[Any]) -> dict[int, CalibrationYaml]:
    """The cameras by socket."""
    cameras = {}
    for pair in pairs:
        if not (isinstance(pair, list) and len(pair) == 2 and isinstance(pair[0], int) and isinstance(pair[1], dict)):
            raise CalibrationError(f"{path}: key 'cameraData' must be a list of [socket, camera]")
        cameras[pair[0]] = CalibrationYaml(path, pair[1], f"cameraData {pair[0]}.")
    return cameras


def _camera(path: Path, cameras: dict[int, CalibrationYaml], socket: int) -> CalibrationYaml:
    if socket not in cameras:
        raise CalibrationError(f"{path}: key 'cameraData' has no camera of socket {socket}; it has {sorted(cameras)}")
    return cameras[socket]


def _chain(path: Path, cameras: dict[int, CalibrationYaml], socket: int) -> dict[int, np.ndarray]:
    """Transformations (4, 4) of a camera's points into its own frame and those that its extrinsics lead to."""
    transforms = {socket: np.eye(4)}
    T = np.eye(4)
    while True:
        extrinsics = _camera(path, cameras, socket).section("extrinsics")
        target = extrinsics.integer("toCameraSocket")
        if target < 0 or target in transforms:
            return transforms
        R, translation = extrinsics.numbers("rotationMatrix", (3, 3)), extrinsics.section("translation")
        T = rigid_motion(R, [_CENTIMETRE * translation.number(axis) for axis in "xyz"]) @ T
        transforms[target] = T
        socket = target


def _camera_model(camera: CalibrationYaml) -> CameraModel:
    kind = camera.integer("cameraType")
    if kind not in _LENSES:
        raise camera.error(f"cameraType is {kind}; known are 0 (perspective) and 1 (fisheye)")
    coefficients = camera.numbers("distortionCoeff", (None,)).tolist()
    if _LENSES[kind] == "equidistant":
        coefficients = coefficients[:4]
    size, intrinsics = [camera.integer(name) for name in ("width", "height")], camera.numbers("intrinsicMatrix", (3, 3))
    return camera_model(camera.where, size, intrinsics_of(intrinsics), _LENSES[kind], coefficients, "distortionCoeff")
