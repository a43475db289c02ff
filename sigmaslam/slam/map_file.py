"""Keyframes in a map file, by which a later run finds its place."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from sigmaslam.errors import InputError
from sigmaslam.estimation.marginalised_poses import PastPoses
from sigmaslam.estimation.state_layout import CALIBRATION_SIZE
from sigmaslam.frontend import Features, StereoView
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.slam.keyframe import Keyframe

_PER_FEATURE = ("keypoints", "descriptors", "scores", "sigma")
_ARRAYS = ("poses", "covariance", "timestamps", "images", "counts", *_PER_FEATURE, "disparity", "disparity_sigma")
_PREFIX = "keyframe_"


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
        InputError: the file is missing, broken, without keyframes, or of another front-end or camera.
    """
    try:
        with np.load(path, allow_pickle=False) as content:
            arrays = {name: content[name] for name in content.files}
    except FileNotFoundError:
        raise InputError(f"{path}: no such map; give map.npz of a run of `sigmaslam track`") from None
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(f"{path}: not a map that can be read ({error}); track the sequence again") from error
    missing = [name for name in (*(_PREFIX + name for name in _ARRAYS), "frontend", "intrinsics") if name not in arrays]
    if missing:
        raise InputError(
            f"{path}: a map without keyframes to find ({missing[0]} is missing); make it by a run of several keyframes"
        )
    if str(arrays["frontend"]) != frontend:
        raise InputError(
            f"{path}: made with the front-end {arrays['frontend']}, not {frontend}; give --frontend "
            f"{arrays['frontend']}, or map again"
        )
    expected = _intrinsics(camera)
    if not np.allclose(arrays["intrinsics"], expected, rtol=1e-4):
        raise InputError(
            f"{path}: its camera has fx, fy, cx, cy, baseline, width, height of {arrays['intrinsics'].tolist()}, this "
            f"one {expected.tolist()}; a map serves the camera that made it"
        )
    ends = np.cumsum(arrays[_PREFIX + "counts"])
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


def _intrinsics(camera: RectifiedStereo) -> np.ndarray:
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, camera.baseline, camera.width, camera.height], float)
