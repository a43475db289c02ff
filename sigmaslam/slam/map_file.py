"""Keyframes in a map file, by which a later run finds its place."""

import logging
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sigmaslam.bounded_files import check_columns, load_arrays, shorten
from sigmaslam.errors import InputError
from sigmaslam.estimation.marginalised_poses import PastPoses
from sigmaslam.estimation.state_layout import CALIBRATION_SIZE
from sigmaslam.frontend import Features
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.se3 import se3_inverse
from sigmaslam.slam.keyframe import HangingKeyframe, Keyframe, KnownKeyframe
from sigmaslam.slam.packed_view import PackedView

_LOGGER = logging.getLogger(__name__)

_PER_FEATURE = ("keypoints", "descriptors", "scores", "sigma")
_PREFIX = "keyframe_"
# Of keyframes V, of which the first K have poses in the joint state S and H hang at these, their features N,
# descriptors D, the bytes B of all images; the camera has seven numbers.
_SHAPES: dict[str, tuple[str | int, ...]] = {
    **{_PREFIX + "poses": ("V", 4, 4), _PREFIX + "covariance": ("S", "S"), _PREFIX + "hanging_covariance": ("H", 6, 6)},
    **{_PREFIX + name: ("V",) for name in ("origins", "timestamps", "image_bytes", "counts")},
    **{_PREFIX + "images": ("B",), _PREFIX + "keypoints": ("N", 2), _PREFIX + "descriptors": ("N", "D")},
    **{_PREFIX + name: ("N",) for name in ("scores", "sigma", "disparity", "disparity_sigma")},
    **{"frontend": (), "intrinsics": (7,)},
}
_KINDS = {
    **{_PREFIX + name: "iu" for name in ("origins", "image_bytes", "counts")},
    **{_PREFIX + "images": "u", _PREFIX + "descriptors": "i", "frontend": "U"},
}
_FINITE = (*_PER_FEATURE, "disparity", "disparity_sigma")
# Takes points of the left camera into the rectified one, whose world keyframes are in.
TURN = "T_rectified_left"
MEND = "map the place again with `sigmaslam track`"
# Round-off leaves rotations, and covariances relative to their variances, better than this.
_ORTHONORMAL, _SYMMETRY = 1e-6, 1e-3


def pack_keyframes(
    keyframes: list[Keyframe],
    past: PastPoses,
    frontend: str,
    camera: RectifiedStereo,
    hanging: Iterable[HangingKeyframe] = (),
) -> dict[str, Any]:
    """Arrays of a map file by name; `past` holds the keyframes' poses, at which others may hang."""
    if not keyframes:
        return {}
    hanging = list(hanging)
    known: list[KnownKeyframe] = [*keyframes, *hanging]
    row = {keyframe.id: k for k, keyframe in enumerate(keyframes)}
    origins = np.array([row[keyframe.origin] for keyframe in known])
    views = [*(PackedView.of(keyframe.view) for keyframe in keyframes), *(keyframe.packed for keyframe in hanging)]
    arrays: dict[str, Any] = {
        "poses": past.poses[origins] @ np.array([keyframe.step for keyframe in known]),
        "origins": origins,
        "covariance": past.whole_covariance,
        "hanging_covariance": np.array([each.covariance for each in hanging]).reshape(-1, 6, 6),
        "timestamps": np.array([keyframe.timestamp for keyframe in known]),
        "image_bytes": np.array([len(view.jpeg) for view in views]),
        "images": np.concatenate([view.jpeg for view in views]),
        "counts": np.array([len(view.disparity) for view in views]),
        "disparity": np.concatenate([view.disparity for view in views]),
        "disparity_sigma": np.concatenate([view.disparity_sigma for view in views]),
        **Features.concatenate([view.features for view in views]).arrays(),
    }
    packed = {_PREFIX + name: value for name, value in arrays.items()}
    return {**packed, "frontend": np.array(frontend), "intrinsics": _intrinsics(camera)}


def read_keyframes(
    path: Path, frontend: str | None = None, camera: RectifiedStereo | None = None
) -> tuple[list[Keyframe], PastPoses, list[HangingKeyframe]]:
    """Keyframes of a map file.

    Args:
        path: map.npz of a run, or its folder.
        frontend: that is going to match them; None: its own.
        camera: the rectified pair that is going to see them; None: its own.
    Returns:
        The keyframes, numbered from zero, their poses together, and keyframes that hang at them.
    Raises:
        InputError: the file is missing, broken, inconsistent, without keyframes, or of another front-end or camera.
    """
    path = path / "map.npz" if path.is_dir() else path
    arrays = load_arrays(path, "give map.npz of a run of `sigmaslam track`, or track the sequence again")
    missing = [name for name in _SHAPES if name not in arrays]
    if missing:
        raise InputError(
            f"{path}: a map without keyframes to find ({missing[0]} is missing); make it by a run of several keyframes"
        )
    check_columns(path, arrays, _SHAPES, _KINDS, MEND)
    if frontend is not None and str(arrays["frontend"]) != frontend:
        other = shorten(str(arrays["frontend"]))
        raise InputError(
            f"{path}: made with the front-end {other}, not {frontend}; give --frontend {other}, or map again"
        )
    expected = arrays["intrinsics"] if camera is None else _intrinsics(camera)
    if not np.allclose(arrays["intrinsics"], expected, rtol=1e-4):
        raise InputError(
            f"{path}: its camera has fx, fy, cx, cy, baseline, width, height of {arrays['intrinsics'].tolist()}, this "
            f"one {expected.tolist()}; a map serves the camera that made it (rows corrected: of --save-calibration)"
        )
    _check(path, arrays)
    if not arrays[_PREFIX + "descriptors"].shape[1]:
        _LOGGER.warning(
            "%s: maps of the front-end %s have no descriptors: a view is looked for near the last keyframes alone; map "
            "with --frontend learned to be found anywhere",
            *(path, frontend),
        )
    array = {name.removeprefix(_PREFIX): arrays[name] for name in _SHAPES}  # points have time stamps, too
    features = Features(*(array[name] for name in _PER_FEATURE))
    ends, image_ends = (np.cumsum(array[name].astype(np.int64)) for name in ("counts", "image_bytes"))
    keyframes: list[Keyframe] = []
    hanging: list[HangingKeyframe] = []
    poses, joint = array["poses"], array["covariance"]
    for id, timestamp in enumerate(array["timestamps"].tolist()):
        rows = np.arange(ends[id] - array["counts"][id], ends[id])
        jpeg = array["images"][image_ends[id] - array["image_bytes"][id] : image_ends[id]]
        packed = PackedView(jpeg, features.select(rows), array["disparity"][rows], array["disparity_sigma"][rows])
        if id < len(joint) // 6:
            keyframes.append(Keyframe(id, timestamp, packed.unpack()))
        else:
            origin = int(array["origins"][id])
            covariance = array["hanging_covariance"][id - len(keyframes)]
            step = se3_inverse(poses[origin]) @ poses[id]
            hanging.append(HangingKeyframe(id, timestamp, packed, origin, step, covariance))
    none = np.zeros((len(joint), CALIBRATION_SIZE))
    return keyframes, PastPoses(poses[: len(keyframes)], joint, none, none), hanging


def _check(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Values of the arrays that `read_keyframes` takes, whose shapes go together."""

    def refuse(wrong: bool, name: str, what: str) -> None:
        if wrong:
            raise InputError(f"{path}: {_PREFIX}{name} {what}; {MEND}")

    array = {name.removeprefix(_PREFIX): arrays[name] for name in _SHAPES}  # points have time stamps, too
    poses, covariance, origins = array["poses"], array["covariance"], array["origins"]
    count, joint = len(poses), len(covariance) // 6
    refuse(array["images"].dtype != np.uint8, "images", f"are {array['images'].dtype}, not uint8")
    refuse(array["descriptors"].dtype != np.int8, "descriptors", f"are {array['descriptors'].dtype}, not int8")
    refuse(count == 0, "poses", "has no keyframe")
    for name, of, what in (("counts", "disparity", "keypoints"), ("image_bytes", "images", "bytes of images")):
        each, total = array[name], len(array[of])
        wrong = bool((each < 0).any()) or int(each.sum(dtype=object)) != total
        refuse(wrong, name, f"are not of the {total} {what} of the other arrays")
    refuse(
        len(covariance) != 6 * joint or joint + len(array["hanging_covariance"]) != count,
        "covariance",
        f"is {covariance.shape} for {count - len(array['hanging_covariance'])} poses of 6",
    )
    wrong = not np.array_equal(origins[:joint], range(joint)) or bool(((origins < 0) | (origins >= joint)).any())
    refuse(wrong, "origins", f"are not the first {joint} keyframes, and of others one of these")
    for name in ("poses", "covariance", "hanging_covariance", "timestamps", *_FINITE):
        refuse(not np.isfinite(array[name]).all(), name, "has a value that is not finite")
    rotation = poses[:, :3, :3]
    defect = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max()
    rigid = defect < _ORTHONORMAL and bool((np.linalg.det(rotation) > 0).all())
    refuse(not rigid or not np.array_equal(poses[:, 3], np.tile([0.0, 0, 0, 1], (count, 1))), "poses", "are not rigid")
    for name, blocks in (("covariance", covariance[None]), ("hanging_covariance", array["hanging_covariance"])):
        diagonal = np.diagonal(blocks, axis1=1, axis2=2)
        scale = np.sqrt(np.abs(diagonal))
        lopsided = np.abs(blocks - blocks.transpose(0, 2, 1)) > _SYMMETRY * scale[:, :, None] * scale[:, None]
        refuse(bool((diagonal < 0).any() or lopsided.any()), name, "is no covariance")
    # An eighth of the size is decoded in a fraction of the time.
    width, height = (math.ceil(side / 8) for side in arrays["intrinsics"][5:7])
    for jpeg in np.split(array["images"], np.cumsum(array["image_bytes"])[:-1]):
        refuse(_size_of_eighth(jpeg) != (height, width), "images", "are not all images of the camera's size")


def _size_of_eighth(jpeg: np.ndarray) -> tuple[int, ...]:
    """Height and width of an image in an eighth of its size; none of what is no image."""
    try:
        image = cv2.imdecode(jpeg, cv2.IMREAD_REDUCED_GRAYSCALE_8)
    except cv2.error:
        return ()
    return () if image is None else image.shape


def _intrinsics(camera: RectifiedStereo) -> np.ndarray:
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, camera.baseline, camera.width, camera.height], float)
