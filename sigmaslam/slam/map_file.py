"""Keyframes in a map file, by which a later run finds its place."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np

from sigmaslam.bounded_files import check_columns, load_arrays, shorten
from sigmaslam.errors import InputError
from sigmaslam.estimation.marginalised_poses import PastPoses
from sigmaslam.estimation.state_layout import CALIBRATION_SIZE
from sigmaslam.frontend import Features, StereoView
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.slam.keyframe import Keyframe

_LOGGER = logging.getLogger(__name__)

_PER_FEATURE = ("keypoints", "descriptors", "scores", "sigma")
_ARRAYS = ("poses", "covariance", "timestamps", "images", "counts", *_PER_FEATURE, "disparity", "disparity_sigma")
_PREFIX = "keyframe_"
# Of keyframes K, their features N, descriptors D, the state S, images H x W; the camera has seven numbers.
_SHAPES: dict[str, tuple[str | int, ...]] = {
    _PREFIX + "poses": ("K", 4, 4),
    _PREFIX + "covariance": ("S", "S"),
    _PREFIX + "timestamps": ("K",),
    _PREFIX + "images": ("K", "H", "W"),
    _PREFIX + "counts": ("K",),
    _PREFIX + "keypoints": ("N", 2),
    _PREFIX + "descriptors": ("N", "D"),
    _PREFIX + "scores": ("N",),
    _PREFIX + "sigma": ("N",),
    _PREFIX + "disparity": ("N",),
    _PREFIX + "disparity_sigma": ("N",),
    "frontend": (),
    "intrinsics": (7,),
}
_KINDS = {_PREFIX + "images": "u", _PREFIX + "counts": "iu", "frontend": "U"}
_MEND = "map the place again with `sigmaslam track`"
# Round-off leaves rotations, and covariances relative to their variances, better than this.
_ORTHONORMAL, _SYMMETRY = 1e-6, 1e-3


def pack_keyframes(
    keyframes: list[Keyframe], past: PastPoses, frontend: str, camera: RectifiedStereo
) -> dict[str, Any]:
    """Arrays of a map file by name; `past` holds the keyframes' poses."""
    if not keyframes:
        return {}
    views = [keyframe.view for keyframe in keyframes]
    arrays: dict[str, Any] = {
        "poses": past.poses,
        "covariance": past.whole_covariance,
        "timestamps": np.array([keyframe.timestamp for keyframe in keyframes]),
        "images": np.stack([view.left for view in views]),
        "counts": np.array([len(view.disparity) for view in views]),
        "disparity": np.concatenate([view.disparity for view in views]),
        "disparity_sigma": np.concatenate([view.disparity_sigma for view in views]),
        **{name: np.concatenate([getattr(view.features, name) for view in views]) for name in _PER_FEATURE},
    }
    packed = {_PREFIX + name: value for name, value in arrays.items()}
    return {**packed, "frontend": np.array(frontend), "intrinsics": _intrinsics(camera)}


def read_keyframes(path: Path, frontend: str, camera: RectifiedStereo) -> tuple[list[Keyframe], PastPoses]:
    """Keyframes of a map file.

    Args:
        path: map.npz of a run.
        frontend: that is going to match them.
        camera: the rectified pair that is going to see them.
    Returns:
        The keyframes, and their poses together.
    Raises:
        InputError: the file is missing, broken, inconsistent, without keyframes, or of another front-end or camera.
    """
    arrays = load_arrays(path, "give map.npz of a run of `sigmaslam track`, or track the sequence again")
    missing = [name for name in (*(_PREFIX + name for name in _ARRAYS), "frontend", "intrinsics") if name not in arrays]
    if missing:
        raise InputError(
            f"{path}: a map without keyframes to find ({missing[0]} is missing); make it by a run of several keyframes"
        )
    check_columns(path, arrays, _SHAPES, _KINDS, _MEND)
    if str(arrays["frontend"]) != frontend:
        other = shorten(str(arrays["frontend"]))
        raise InputError(
            f"{path}: made with the front-end {other}, not {frontend}; give --frontend {other}, or map again"
        )
    expected = _intrinsics(camera)
    if not np.allclose(arrays["intrinsics"], expected, rtol=1e-4):
        raise InputError(
            f"{path}: its camera has fx, fy, cx, cy, baseline, width, height of {arrays['intrinsics'].tolist()}, this "
            f"one {expected.tolist()}; a map serves the camera that made it"
        )
    _check(path, arrays)
    if not arrays[_PREFIX + "descriptors"].shape[1]:
        _LOGGER.warning(
            "%s: maps of the front-end %s have no descriptors: a view is looked for near the last keyframes alone; map "
            "with --frontend learned to be found anywhere",
            *(path, frontend),
        )
    ends = np.cumsum(arrays[_PREFIX + "counts"].astype(np.int64))
    keyframes = []
    for k, (begin, end) in enumerate(zip(np.r_[0, ends[:-1]], ends, strict=True)):
        columns = {name: arrays[_PREFIX + name][begin:end] for name in (*_PER_FEATURE, "disparity", "disparity_sigma")}
        view = StereoView(
            arrays[_PREFIX + "images"][k],
            np.zeros((0, 0), np.uint8),
            Features(*(columns[name] for name in _PER_FEATURE)),
            columns["disparity"],
            columns["disparity_sigma"],
        )
        keyframes.append(Keyframe(k, float(arrays[_PREFIX + "timestamps"][k]), view))
    joint = arrays[_PREFIX + "covariance"]
    none = np.zeros((len(joint), CALIBRATION_SIZE))
    return keyframes, PastPoses(arrays[_PREFIX + "poses"], joint, none, none)


def _check(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Values of the arrays that `read_keyframes` takes, whose shapes go together."""

    def refuse(wrong: bool, name: str, what: str) -> None:
        if wrong:
            raise InputError(f"{path}: {_PREFIX}{name} {what}; {_MEND}")

    array = {name: arrays[_PREFIX + name] for name in _ARRAYS}
    counts, poses, covariance = array["counts"], array["poses"], array["covariance"]
    width, height = arrays["intrinsics"][5:7]
    count = len(counts)
    refuse(array["images"].dtype != np.uint8, "images", f"are {array['images'].dtype}, not uint8")
    refuse(count == 0, "counts", "has no keyframe")
    refuse(
        bool((counts < 0).any()) or int(counts.sum(dtype=object)) != len(array["disparity"]),
        "counts",
        f"are not of the {len(array['disparity'])} keypoints of the other arrays",
    )
    size = array["images"].shape[1:]
    refuse(size != (height, width), "images", f"have {size[1]}x{size[0]} pixels, the camera {width:g}x{height:g}")
    refuse(len(covariance) != 6 * count, "covariance", f"is {covariance.shape} for {count} poses of 6")
    for name in ("poses", "covariance", "timestamps", "keypoints", "descriptors", "scores", "sigma"):
        refuse(not np.isfinite(array[name]).all(), name, "has a value that is not finite")
    refuse(bool(np.isinf(array["disparity"]).any()), "disparity", "has an infinite value")
    rotation = poses[:, :3, :3]
    defect = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max()
    rigid = defect < _ORTHONORMAL and bool((np.linalg.det(rotation) > 0).all())
    refuse(not rigid or not np.array_equal(poses[:, 3], np.tile([0.0, 0, 0, 1], (count, 1))), "poses", "are not rigid")
    scale = np.sqrt(np.abs(np.diagonal(covariance)))
    lopsided = np.abs(covariance - covariance.T) > _SYMMETRY * np.outer(scale, scale)
    refuse(bool((np.diagonal(covariance) < 0).any() or lopsided.any()), "covariance", "is no covariance")


def _intrinsics(camera: RectifiedStereo) -> np.ndarray:
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, camera.baseline, camera.width, camera.height], float)
