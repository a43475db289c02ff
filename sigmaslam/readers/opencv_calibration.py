"""OpenCV's FileStorage (YAML, XML): files of its stereo calibration, and the settings of ORB-SLAM2 and ORB-SLAM3."""

import logging
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from sigmaslam.errors import CalibrationError
from sigmaslam.geometry.camera import CameraModel, DistortionModel, StereoCamera
from sigmaslam.readers.camera_infos import CameraInfo, stereo_from_infos
from sigmaslam.readers.image_size import ImageSize, need_image_size
from sigmaslam.readers.lens_models import read_lens

logger = logging.getLogger(__name__)

# Names of K, of the coefficients, and of R and P of rectification, for the left and the right eye.
_EYES = (
    (("K1", "K2"), ("D1", "D2"), ("R1", "R2"), ("P1", "P2")),
    (("M1", "M2"), ("D1", "D2"), ("R1", "R2"), ("P1", "P2")),
    (("cameraMatrix1", "cameraMatrix2"), ("distCoeffs1", "distCoeffs2"), ("R1", "R2"), ("P1", "P2")),
    (("LEFT.K", "RIGHT.K"), ("LEFT.D", "RIGHT.D"), ("LEFT.R", "RIGHT.R"), ("LEFT.P", "RIGHT.P")),
)
_SIZES = (("image_width", "image_height"), ("Camera.width", "Camera.height"), ("LEFT.width", "LEFT.height"))
# OpenCV keeps the unit of the chessboard's squares. A longer baseline, in metres, is taken for millimetres.
_LONGEST_BASELINE = 3.0


def is_file_storage(text: str) -> bool:
    """Whether a text is in OpenCV's form: its matrices have a tag that no other YAML has, or it is XML."""
    return "!!opencv-matrix" in text or "<opencv_storage>" in text or text.startswith("%YAML:")


class Storage:
    """Values of one or more files of OpenCV's FileStorage.

    Attributes:
        name: of the files, for messages.

    Raises:
        CalibrationError: a file cannot be read.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        self.name = " and ".join(map(str, paths))
        self._storages = [_open(path) for path in paths]

    def has(self, *keys: str) -> bool:
        """Whether all these keys are there."""
        return all(self._node(key) is not None for key in keys)

    def number(self, key: str) -> float:
        """A finite number.

        Raises:
            CalibrationError: it is missing, or no number.
        """
        node = self._node(key)
        if node is None or not (node.isReal() or node.isInt()) or not np.isfinite(node.real()):
            raise CalibrationError(f"{self.name}: key '{key}' must be a number" + ("; it is missing" * (node is None)))
        return float(node.real())

    def text(self, key: str, default: str) -> str:
        """A word."""
        node = self._node(key)
        return node.string() if node is not None and node.isString() else default

    def matrix(self, key: str, shape: tuple[int, ...] | None = None) -> np.ndarray:
        """A float64 matrix in this shape; None gives its values in one row.

        Raises:
            CalibrationError: it is missing, no matrix, or of another size.
        """
        node = self._node(key)
        try:
            values = None if node is None else node.mat()
        except cv2.error:
            values = None
        expected = "a matrix" if shape is None else f"a matrix of {'x'.join(map(str, shape))} numbers"
        if values is None or not np.all(np.isfinite(values)):
            raise CalibrationError(f"{self.name}: key '{key}' must be {expected} of finite numbers")
        values = np.asarray(values, dtype=np.float64)
        if shape is None:
            return values.ravel()
        if values.size != int(np.prod(shape)):
            raise CalibrationError(f"{self.name}: key '{key}' must be {expected}, it has {values.shape}")
        return values.reshape(shape)

    def image_size(self, given: ImageSize | None) -> ImageSize:
        """(width, height) that the file names; where it names none, the one that is given."""
        for keys in _SIZES:
            if self.has(*keys):
                return int(self.number(keys[0])), int(self.number(keys[1]))
        node = self._node("imageSize")
        if node is not None and node.isSeq() and node.size() == 2:
            return int(node.at(0).real()), int(node.at(1).real())
        return need_image_size(self.name, given)

    def _node(self, key: str) -> cv2.FileNode | None:
        for storage in self._storages:
            node = storage.getNode(key)
            if not node.empty():
                return node
        return None


def _open(path: Path) -> cv2.FileStorage:
    try:
        text = path.read_text(encoding="utf-8")
        return cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    except (OSError, UnicodeDecodeError) as error:
        raise CalibrationError(f"{path}: cannot read the calibration: {error}") from None
    except (cv2.error, SystemError) as error:
        # OpenCV's message has the version and the line of its own source before the reason.
        reason = str(error).rpartition("error: ")[2].strip()
        raise CalibrationError(f"{path}: not a file of OpenCV's FileStorage: {reason}") from None


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
    storage = Storage(paths)
    try:
        for keys in _EYES:
            if storage.has(*keys[0]):
                return _from_matrices(storage, keys, image_size, rectified)
        if storage.has("Camera1.fx"):
            return _from_orb_slam3(storage, image_size)
        if storage.has("Camera.fx", "Camera.bf"):
            eye = _pinhole(storage, "Camera", image_size, "none", ())
            return StereoCamera(eye, eye, _beside(storage.number("Camera.bf") / eye.fx))
    except CalibrationError as error:
        message = str(error)
        raise error if message.startswith(storage.name) else CalibrationError(f"{storage.name}: {message}") from None
    raise CalibrationError(
        f"{storage.name}: no stereo calibration; looked for K1 + K2 (or M1, cameraMatrix1) with D1, D2, R and T, "
        "LEFT.K + RIGHT.K, Camera1.fx + Camera2.fx, and Camera.fx + Camera.bf; two files are given as "
        "intrinsics.yml,extrinsics.yml"
    )


def _from_matrices(
    storage: Storage, keys: tuple[tuple[str, str], ...], image_size: ImageSize | None, rectified: bool
) -> StereoCamera:
    Ks, Ds, Rs, Ps = keys
    size = storage.image_size(image_size)
    if rectified or not storage.has("R", "T"):
        wanted = (*Ps, *(() if rectified else Rs))
        if not storage.has(*wanted):
            missing = ", ".join(key for key in wanted if not storage.has(key))
            instead = "" if rectified else "R and T (from the left camera into the right one), or "
            raise CalibrationError(f"{instead}{missing} missing; extrinsics in another file are given with a comma")
        infos = [
            CameraInfo(
                name=storage.name,
                width=size[0],
                height=size[1],
                lens=storage.text("distortion_model", "radtan"),
                D=() if rectified else storage.matrix(D).tolist(),
                K=storage.matrix(K, (3, 3)),
                R=np.eye(3) if rectified else storage.matrix(R, (3, 3)),
                P=storage.matrix(P, (3, 4)),
            )
            for K, D, R, P in zip(Ks, Ds, Rs, Ps, strict=True)
        ]
        return stereo_from_infos(infos[0], infos[1], rectified)
    models = []
    for key, D in zip(Ks, Ds, strict=True):
        K = storage.matrix(key, (3, 3))
        lens, distortion = _lens(storage, D)
        fx, fy, cx, cy, skew = (float(value) for value in (K[0, 0], K[1, 1], K[0, 2], K[1, 2], K[0, 1]))
        models.append(CameraModel(*size, fx, fy, cx, cy, skew, lens, distortion))
    rotation = storage.matrix("R")
    T_right_left = np.eye(4)
    T_right_left[:3, :3] = cv2.Rodrigues(rotation)[0] if rotation.size == 3 else storage.matrix("R", (3, 3))
    T_right_left[:3, 3] = storage.matrix("T", (3,))
    return _checked_unit(storage, StereoCamera(models[0], models[1], _inverse(storage, "R", T_right_left)))


def _lens(storage: Storage, key: str) -> tuple[DistortionModel, tuple[float, ...]]:
    """Coefficients of a file that need not say whether they are cv2.fisheye's, which are four."""
    coefficients = storage.matrix(key).tolist()
    name = storage.text("distortion_model", "")
    if not name and len(coefficients) == 4 and any(coefficients):
        logger.warning(
            "%s: %s has 4 coefficients, taken as k1 k2 p1 p2; if they are cv2.fisheye's, "
            'write distortion_model: "equidistant" into the file',
            storage.name,
            key,
        )
    return read_lens(name or "radtan", coefficients, f"{storage.name}: {key}")


def _from_orb_slam3(storage: Storage, image_size: ImageSize | None) -> StereoCamera:
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
        if kind.lower() == "rectified" and not storage.has(f"{camera}.fx"):
            camera = "Camera1"
        keys = [f"{camera}.{name}" for name in names[kind.lower()]]
        lens = "equidistant" if kind.lower() == "kannalabrandt8" else "radtan"
        values = [storage.number(key) for key in keys if lens == "equidistant" or storage.has(key)]
        model, distortion = read_lens(lens, values, f"{storage.name}: Camera.type")
        models.append(_pinhole(storage, camera, image_size, model, distortion))
    if kind.lower() == "rectified":
        return StereoCamera(models[0], models[1], _beside(storage.number("Stereo.b")))
    return StereoCamera(models[0], models[1], storage.matrix("Stereo.T_c1_c2", (4, 4)))


def _pinhole(
    storage: Storage,
    camera: str,
    image_size: ImageSize | None,
    model: DistortionModel,
    distortion: tuple[float, ...],
) -> CameraModel:
    fx, fy, cx, cy = (storage.number(f"{camera}.{name}") for name in ("fx", "fy", "cx", "cy"))
    return CameraModel(*storage.image_size(image_size), fx, fy, cx, cy, 0.0, model, distortion)


def _beside(baseline: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = baseline
    return T


def _inverse(storage: Storage, key: str, T: np.ndarray) -> np.ndarray:
    try:
        return np.asarray(np.linalg.inv(T))
    except np.linalg.LinAlgError:
        raise CalibrationError(f"{storage.name}: {key} is no rotation: {T[:3, :3].tolist()}") from None


def _checked_unit(storage: Storage, camera: StereoCamera) -> StereoCamera:
    if camera.baseline > _LONGEST_BASELINE:
        logger.warning(
            "%s: a baseline of %.4g m; T has the unit of the chessboard's squares: if they were in millimetres, "
            "divide T by 1000",
            storage.name,
            camera.baseline,
        )
    return camera
