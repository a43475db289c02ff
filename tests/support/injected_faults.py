"""Mistakes that users make with a stereo rig, put into a sequence that has none."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from sigmaslam.geometry.camera import CameraModel, StereoCamera
from sigmaslam.readers import StereoFrame, StereoSequence
from sigmaslam.readers.images import ListedPairs

Frames = list[StereoFrame]
EUROC_LENS = (-0.283, 0.0740, 0.0002, 0.00002)


def sequence_of(frames: Frames, camera: StereoCamera) -> StereoSequence:
    """A sequence in memory."""
    pairs = [(frame.left, frame.right, frame.timestamp) for frame in frames]
    return StereoSequence(ListedPairs(pairs), camera, "memory", "memory")


@dataclass(frozen=True)
class Fault:
    """A mistake, and the check that names it.

    Attributes:
        finding: name of the check.
        word: that its message has.
        frames: changes frames (and knows the camera), or leaves them.
        camera: changes the calibration, or leaves it.
    """

    finding: str
    word: str
    frames: Callable[[Frames, StereoCamera], Frames] = lambda frames, camera: frames
    camera: Callable[[StereoCamera], StereoCamera] = lambda camera: camera

    def inject(self, frames: Frames, camera: StereoCamera) -> StereoSequence:
        """The sequence with the fault."""
        return sequence_of(self.frames(frames, camera), self.camera(camera))


def of_images(change: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]) -> Callable[..., Frames]:
    def apply(frames: Frames, camera: StereoCamera) -> Frames:
        changed = [change(frame.left, frame.right) for frame in frames]
        return [
            replace(frame, left=np.ascontiguousarray(left), right=np.ascontiguousarray(right))
            for frame, (left, right) in zip(frames, changed, strict=True)
        ]

    return apply


def _from_a_third_on(change: Callable[..., Frames]) -> Callable[..., Frames]:
    def apply(frames: Frames, camera: StereoCamera) -> Frames:
        third = len(frames) // 3
        return frames[:third] + change(frames[third:], camera)

    return apply


def _turned(degrees: float, axis: tuple[float, float, float]) -> Callable[..., Frames]:
    """The right camera turned against its calibration."""

    def apply(frames: Frames, camera: StereoCamera) -> Frames:
        K = camera.right.matrix
        H = K @ cv2.Rodrigues(np.radians(degrees) * np.array(axis))[0] @ np.linalg.inv(K)
        return of_images(lambda left, right: (left, cv2.warpPerspective(right, H, right.shape[::-1])))(frames, camera)

    return apply


def _moved(M: list[list[float]]) -> Callable[..., Frames]:
    return of_images(lambda left, right: (left, cv2.warpAffine(right, np.array(M), right.shape[::-1])))


def _zoomed(factor: float) -> Callable[..., Frames]:
    def apply(frames: Frames, camera: StereoCamera) -> Frames:
        cx, cy = camera.right.cx, camera.right.cy
        return _moved([[factor, 0, (1 - factor) * cx], [0, factor, (1 - factor) * cy]])(frames, camera)

    return apply


def _delayed(count: int) -> Callable[..., Frames]:
    """Right images of `count` frames later."""

    def apply(frames: Frames, camera: StereoCamera) -> Frames:
        moved = range(max(0, -count), len(frames) - max(0, count))
        return [replace(frames[k], right=frames[k + count].right) for k in moved]

    return apply


def _upright(frames: Frames, camera: StereoCamera) -> Frames:
    return of_images(lambda left, right: (np.rot90(left), np.rot90(right)))(frames, camera)


def _turn_camera(camera: StereoCamera) -> StereoCamera:
    """A horizontal rig of upright images."""
    left = camera.left
    model = CameraModel(left.height, left.width, left.fy, left.fx, left.cy, left.width - 1 - left.cx)
    return replace(camera, left=model, right=model)


def of_both(change: Callable[[CameraModel], dict[str, Any]]) -> Callable[[StereoCamera], StereoCamera]:
    def apply(camera: StereoCamera) -> StereoCamera:
        left, right = (replace(model, **change(model)) for model in (camera.left, camera.right))
        return replace(camera, left=left, right=right)

    return apply


def scaled_baseline(factor: float) -> Callable[[StereoCamera], StereoCamera]:
    def apply(camera: StereoCamera) -> StereoCamera:
        T = camera.T_left_right.copy()
        T[:3, 3] *= factor
        return replace(camera, T_left_right=T)

    return apply


def _stamps(factor: float) -> Callable[..., Frames]:
    return lambda frames, camera: [replace(frame, timestamp=factor * frame.timestamp) for frame in frames]


def _another_place(frames: Frames, camera: StereoCamera) -> Frames:
    """The right eye sees waves, whatever the left one sees."""
    height, width = frames[0].right.shape
    v, u = np.mgrid[:height, :width]
    noise = np.random.default_rng(0).normal(size=(height, width)).astype(np.float32)
    waves = 60 * np.sin(u / 17.0) * np.cos(v / 11.0) + 400 * cv2.GaussianBlur(noise, (0, 0), 3)
    image = np.clip(128 + waves, 0, 255).astype(np.uint8)
    return [replace(frame, right=image) for frame in frames]


def _sizes(factor: float) -> Callable[[StereoCamera], StereoCamera]:
    names = ("fx", "fy", "cx", "cy")
    return of_both(lambda model: {name: factor * getattr(model, name) for name in names})


# Of any pair.
FAULTS = {
    "eyes exchanged": Fault("eyes", "swap the two", of_images(lambda left, right: (right, left))),
    "both eyes mirrored": Fault(
        "eyes", "do not mirror", of_images(lambda left, right: (left[:, ::-1], right[:, ::-1]))
    ),
    "eyes exchanged in mid-run": Fault(
        "eyes", "exchanged in", _from_a_third_on(of_images(lambda left, right: (right, left)))
    ),
    "right eye at a third of its light": Fault(
        "light", "the right eye is", of_images(lambda left, right: (left, right // 3))
    ),
    "left eye dark in mid-run": Fault(
        "light", "the left eye is", _from_a_third_on(of_images(lambda left, right: (left // 3, right)))
    ),
    "one image for both eyes": Fault("same image", "both cameras", of_images(lambda left, right: (left, left))),
    "rows off by 3": Fault("rows", "+", _moved([[1, 0, 0], [0, 1, 3.0]])),
    "rows off by -3": Fault("rows", "-", _moved([[1, 0, 0], [0, 1, -3.0]])),
    "turned by yaw 5": Fault("rotation", "about the vertical", _turned(5, (0, 1, 0))),
    "turned by yaw -5": Fault("rotation", "about the vertical", _turned(-5, (0, 1, 0))),
    "turned by roll 1": Fault("rotation", "about its axis", _turned(1, (0, 0, 1))),
    "turned by pitch 2": Fault("rows", "correct cy", _turned(2, (1, 0, 0))),
    "zoomed by 3 %": Fault("scale", "+", _zoomed(1.03)),
    "right eye mirrored": Fault("mirrored", "left to right", of_images(lambda left, right: (left, right[:, ::-1]))),
    "left eye mirrored": Fault("mirrored", "left to right", of_images(lambda left, right: (left[:, ::-1], right))),
    "right eye upside down": Fault("mirrored", "180", of_images(lambda left, right: (left, right[::-1, ::-1]))),
    "no overlap": Fault("overlap", "see the same", _another_place),
    "left eye black": Fault("exposure", "lens cap", of_images(lambda left, right: (0 * left, right))),
    "grey": Fault("exposure", "nothing can be seen", of_images(lambda left, right: (0 * left + 90, 0 * right + 90))),
    "over-exposed": Fault(
        "exposure", "shorter", of_images(lambda left, right: (left, cv2.convertScaleAbs(right, alpha=20, beta=200)))
    ),
    "right eye blurred": Fault(
        "sharpness", "focus", of_images(lambda left, right: (left, cv2.GaussianBlur(right, (0, 0), 6)))
    ),
    "right eye late": Fault("synchronisation", "later", _delayed(1)),
    "right eye early": Fault("synchronisation", "earlier", _delayed(-1)),
    "baseline in mm": Fault("baseline", "millimetres", camera=scaled_baseline(1e3)),
    "baseline in cm": Fault("baseline", "centimetres", camera=scaled_baseline(1e2)),
    "baseline of a micrometre": Fault("baseline", "metres", camera=scaled_baseline(1e-6)),
    "intrinsics of twice the size": Fault("principal point", "multiply fx, fy, cx, cy by 0.5", camera=_sizes(2.0)),
    "intrinsics of half the size": Fault("principal point", "by 2", camera=_sizes(0.5)),
    "focal length in mm": Fault("focal length", "in pixels", camera=of_both(lambda model: {"fx": 4.0, "fy": 4.0})),
    "times in ms": Fault("time stamps", "milliseconds", _stamps(1e3)),
    "times in us": Fault("time stamps", "microseconds", _stamps(1e6)),
    "times in ns": Fault("time stamps", "nanoseconds", _stamps(1e9)),
}
# Of wide images, where the two differ enough.
WIDE_FAULTS = {
    "cx and cy exchanged": Fault(
        "principal point", "exchange", camera=of_both(lambda model: {"cx": model.cy, "cy": model.cx})
    ),
}
# Of rectified images.
RECTIFIED_FAULTS = {
    "vertical rig": Fault("rig", "above the other", _upright, _turn_camera),
    "distortion of rectified images": Fault(
        "distortion",
        "no distortion",
        camera=of_both(lambda model: {"distortion_model": "radtan", "distortion": EUROC_LENS}),
    ),
}
