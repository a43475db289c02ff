"""Keyframes that left the window, remembered to find the way back to them: in this run, or in a later one by a map."""

from __future__ import annotations

import zipfile
import zlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sigmaslam.camera import RectifiedStereo
from sigmaslam.errors import InputError
from sigmaslam.frontend import Features, StereoView
from sigmaslam.past import PastPoses, past_slice

# Descriptors of a keyframe and of a view that vote on whether they show the same place.
_VOTERS = 300
_PER_FEATURE = ("keypoints", "descriptors", "scores", "sigma")
_ARRAYS = ("poses", "covariance", "timestamps", "images", "counts", *_PER_FEATURE, "disparity", "disparity_sigma")
_PREFIX = "keyframe_"


@dataclass(frozen=True, slots=True)
class RememberedKeyframe:
    """A keyframe as it was when it left the window.

    Attributes:
        view: its left image and features; the right image is not kept.
        pose: (4, 4) T_world_keyframe of the rectified camera.
        covariance: (6, 6) of that, perturbed from the left in the world.
        timestamp: seconds.
    """

    view: StereoView
    pose: np.ndarray
    covariance: np.ndarray
    timestamp: float


class KeyframeMemory:
    """A bounded number of keyframes, spread over the places that were visited.

    Args:
        capacity: more are not kept.
    """

    def __init__(self, capacity: int) -> None:
        self._capacity = max(capacity, 1)
        self.keyframes: list[RememberedKeyframe] = []

    def add(self, keyframe: RememberedKeyframe, spare: float | None = None) -> int | None:
        """Remembers a keyframe; when there are too many, one of the two that are closest to each other goes.

        Args:
            keyframe: what is remembered.
            spare: time stamp of one that must not go.
        Returns:
            Which one goes, if one does.
        """
        nothing = np.zeros((0, 0), np.uint8)
        self.keyframes.append(replace(keyframe, view=replace(keyframe.view, right=nothing)))
        if len(self.keyframes) <= self._capacity:
            return None
        places = np.array([each.pose[:3, 3] for each in self.keyframes])
        looks = np.array([each.pose[:3, 2] for each in self.keyframes])
        apart = np.linalg.norm(places[:, None] - places[None], axis=2)
        spread = max(float(np.median(apart)), 1e-12)
        apart = apart / spread + np.linalg.norm(looks[:, None] - looks[None], axis=2)
        np.fill_diagonal(apart, np.inf)
        one, other = (int(k) for k in np.unravel_index(np.argmin(apart), apart.shape))
        dropped = min(one, other) if self.keyframes[max(one, other)].timestamp == spare else max(one, other)
        del self.keyframes[dropped]
        return dropped

    def index(self, timestamp: float) -> int:
        """Where the keyframe of that time stamp stands."""
        return next(k for k, keyframe in enumerate(self.keyframes) if keyframe.timestamp == timestamp)

    def refresh(self, past: PastPoses) -> None:
        """Takes over what is known of the poses now."""
        for k, keyframe in enumerate(self.keyframes):
            place = past_slice(k)
            self.keyframes[k] = replace(keyframe, pose=past.poses[k], covariance=past.covariance[place, place])

    def similar(
        self, view: StereoView, count: int, among: list[RememberedKeyframe] | None = None
    ) -> list[RememberedKeyframe]:
        """Up to `count` keyframes that look most like the view, by mutual nearest descriptors, best first.

        Args:
            view: what they should look like.
            count: most of them.
            among: which are asked; all by default.
        """
        among = self.keyframes if among is None else among
        wanted = view.features.descriptors[:_VOTERS]
        if not wanted.shape[1]:
            return among[-count:][::-1]
        votes = []
        for keyframe in among:
            similarity = keyframe.view.features.descriptors[:_VOTERS] @ wanted.T
            if not similarity.size:
                votes.append(0)
                continue
            forward, back = similarity.argmax(axis=1), similarity.argmax(axis=0)
            votes.append(int((back[forward] == np.arange(len(forward))).sum()))
        order = np.argsort(-np.array(votes, np.int64), kind="stable")[:count]
        return [among[k] for k in order]


def pack_keyframes(
    keyframes: list[RememberedKeyframe], joint: np.ndarray, frontend: str, camera: RectifiedStereo
) -> dict[str, Any]:
    """Arrays of a map file by name; joint (6 K, 6 K) is the covariance of all poses together."""
    if not keyframes:
        return {}
    views = [keyframe.view for keyframe in keyframes]
    arrays: dict[str, Any] = {
        "poses": np.stack([keyframe.pose for keyframe in keyframes]),
        "covariance": joint,
        "timestamps": np.array([keyframe.timestamp for keyframe in keyframes]),
        "images": np.stack([view.left for view in views]),
        "counts": np.array([len(view.disparity) for view in views]),
        "disparity": np.concatenate([view.disparity for view in views]),
        "disparity_sigma": np.concatenate([view.disparity_sigma for view in views]),
        **{name: np.concatenate([getattr(view.features, name) for view in views]) for name in _PER_FEATURE},
    }
    packed = {_PREFIX + name: value for name, value in arrays.items()}
    return {**packed, "frontend": np.array(frontend), "intrinsics": _intrinsics(camera)}


def read_keyframes(path: Path, frontend: str, camera: RectifiedStereo) -> tuple[list[RememberedKeyframe], np.ndarray]:
    """Keyframes of a map file.

    Args:
        path: map.npz of a run.
        frontend: that is going to match them.
        camera: the rectified pair that is going to see them.
    Returns:
        The keyframes, and the covariance (6 K, 6 K) of all their poses together.
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
    keyframes, joint = [], arrays[_PREFIX + "covariance"]
    for k, (begin, end) in enumerate(zip(np.r_[0, ends[:-1]], ends, strict=True)):
        own = {name: arrays[_PREFIX + name][begin:end] for name in (*_PER_FEATURE, "disparity", "disparity_sigma")}
        view = StereoView(
            arrays[_PREFIX + "images"][k],
            np.zeros((0, 0), np.uint8),
            Features(*(own[name] for name in _PER_FEATURE)),
            own["disparity"],
            own["disparity_sigma"],
        )
        pose, covariance = arrays[_PREFIX + "poses"][k], joint[past_slice(k), past_slice(k)]
        keyframes.append(RememberedKeyframe(view, pose, covariance, float(arrays[_PREFIX + "timestamps"][k])))
    return keyframes, joint


def _intrinsics(camera: RectifiedStereo) -> np.ndarray:
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, camera.baseline, camera.width, camera.height], float)
