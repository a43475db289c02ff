"""Faults of camera drivers, made from good frames: stamps, order, light and the rig."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import cv2
import numpy as np

from sigmaslam.geometry.camera import StereoCamera


@dataclass(frozen=True, slots=True)
class DrivenFrame:
    """One pair as a driver delivers it.

    Attributes:
        moment: number of the good frame at whose time the pair counts, which its true pose is looked up by.
        timestamp: as the driver says it, seconds.
        left, right: (H, W) uint8 grey images.
    """

    moment: int
    timestamp: float
    left: np.ndarray
    right: np.ndarray


Frames = list[DrivenFrame]


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault by its name in the table.

    Attributes:
        words: what a reader of the table needs to know.
        spoil: makes the faulty frames of the good ones; images that do not change are shared with them.
        seconds: after `start_of` that a recording must last for the fault to show.
        miscalibrate: the calibration that is given, of the true one.
    """

    words: str
    spoil: Callable[[Frames, np.random.Generator], Frames]
    seconds: float = 0.0
    miscalibrate: Callable[[StereoCamera], StereoCamera] = lambda camera: camera

    def fits(self, frames: Sequence[DrivenFrame]) -> bool:
        """Whether some frames are left after the fault."""
        left = len(frames) - start_of(frames) - round(self.seconds / interval(frames))
        return left >= _FRAMES_AFTER


_FRAMES_AFTER = 5


def interval(frames: Sequence[DrivenFrame]) -> float:
    """Median seconds between two frames."""
    return float(np.median(np.diff([frame.timestamp for frame in frames])))


def start_of(frames: Sequence[DrivenFrame]) -> int:
    """Number of the frame in which a passing fault begins: after a third."""
    return len(frames) // 3


def spoil(name: str, frames: Iterable[DrivenFrame], seed: int) -> Frames:
    """Good frames with a fault of the table; the same seed gives the same frames."""
    return FAULTS[name].spoil(list(frames), np.random.default_rng(seed))


# Time stamps. Shares are of the median interval.


def alternate(share: float, frames: Frames, rng: np.random.Generator) -> Frames:
    """Stamps that are early and late in turn."""
    return _restamp(frames, share * interval(frames) * (-1.0) ** np.arange(len(frames)))


def jitter(share: float, frames: Frames, rng: np.random.Generator) -> Frames:
    """Gaussian jitter, cut off where stamps would change their order."""
    largest = 0.45
    delay = np.clip(rng.normal(0.0, share, len(frames)), -largest, largest)
    return _restamp(frames, interval(frames) * delay)


def deliver_in_bursts(size: int, frames: Frames, rng: np.random.Generator) -> Frames:
    """Stamps of arrival, where frames arrive in groups when the last of the group is ready."""
    number = np.arange(len(frames))
    place = number % size
    return _restamp(frames, interval(frames) * (size - 1 - place + 0.04 * place))


def delay_one(share: float, frames: Frames, rng: np.random.Generator) -> Frames:
    """A single stamp that is late."""
    late = rng.integers(start_of(frames), len(frames) - 1)
    return _restamp(frames, share * interval(frames) * (np.arange(len(frames)) == late))


def duplicate_stamps(frames: Frames, rng: np.random.Generator) -> Frames:
    """Two frames with the stamp of the one before."""
    changed = list(frames)
    for number in rng.choice(np.arange(2, len(frames) - 1, 2), 2, replace=False):
        changed[number] = replace(frames[number], timestamp=frames[number - 1].timestamp)
    return changed


def drift_clock(rate: float, frames: Frames, rng: np.random.Generator) -> Frames:
    """A host clock that is too fast, with jitter of 2 % of the interval."""
    since = np.array([frame.timestamp - frames[0].timestamp for frame in frames])
    noise = np.clip(rng.normal(0.0, 0.02, len(frames)), -0.1, 0.1)
    return _restamp(frames, rate * since + interval(frames) * noise)


def step_clock(intervals: float, frames: Frames, rng: np.random.Generator) -> Frames:
    """A host clock that is set: all stamps from one frame on are later (or earlier) by some intervals."""
    after = np.arange(len(frames)) >= start_of(frames)
    return _restamp(frames, intervals * interval(frames) * after)


# Which image is delivered when.


def freeze(count: int, frames: Frames, rng: np.random.Generator) -> Frames:
    """The same pair for some frames, with stamps that go on."""
    return _show(frames, _frozen(len(frames), start_of(frames), count))


def freeze_anew(count: int, frames: Frames, rng: np.random.Generator) -> Frames:
    """The same, each time compressed by another quality, as a stream that goes on without its camera."""
    still, first = freeze(count, frames, rng), start_of(frames)
    for k in range(first, min(first + count, len(frames))):
        quality = int(rng.integers(60, 90))
        still[k] = replace(
            still[k], left=_compressed(still[k].left, quality), right=_compressed(still[k].right, quality)
        )
    return still


def freeze_right(count: int, frames: Frames, rng: np.random.Generator) -> Frames:
    """The same right image for some frames."""
    return _show(frames, np.arange(len(frames)), _frozen(len(frames), start_of(frames), count))


def drop(share: float, frames: Frames, rng: np.random.Generator) -> Frames:
    """Frames that are missing at random, never the first."""
    kept = rng.random(len(frames)) >= share
    kept[0] = True
    return [frame for frame, keep in zip(frames, kept, strict=True) if keep]


def drop_in_a_row(count: int, frames: Frames, rng: np.random.Generator) -> Frames:
    """A gap."""
    first = start_of(frames)
    return frames[:first] + frames[first + count :]


def drop_uncounted(share: float, frames: Frames, rng: np.random.Generator) -> Frames:
    """Frames that are missing at random, and the third of all, under stamps of a counter that has not counted them."""
    kept = rng.random(len(frames)) >= share
    kept[:4] = True, True, False, True
    left = [frame for frame, keep in zip(frames, kept, strict=True) if keep]
    return [replace(each, timestamp=as_if.timestamp) for each, as_if in zip(left, frames, strict=False)]


def repeat_out_of_order(frames: Frames, rng: np.random.Generator) -> Frames:
    """An old pair under a new stamp, once in ten frames: a ring of buffers that is read too late."""
    shown = np.arange(len(frames))
    shown[5::10] -= 3
    return _show(frames, shown)


def swap_neighbours(frames: Frames, rng: np.random.Generator) -> Frames:
    """Two successive pairs are exchanged under stamps that are in order, once in ten frames."""
    shown = np.arange(len(frames))
    for number in range(5, len(frames) - 1, 10):
        shown[[number, number + 1]] = number + 1, number
    return _show(frames, shown)


def tear(frames: Frames, rng: np.random.Generator) -> Frames:
    """The lower half of both images is of the frame before, once in ten frames."""

    def torn(number: int) -> DrivenFrame:
        old, half = frames[number - 1], frames[number].left.shape[0] // 2
        left, right = frames[number].left.copy(), frames[number].right.copy()
        left[half:], right[half:] = old.left[half:], old.right[half:]
        return replace(frames[number], left=left, right=right)

    return _once_in_ten(frames, torn)


def shift_left(columns: float, frames: Frames, rng: np.random.Generator) -> Frames:
    """The left image lacks the beginning of its lines, once in ten frames."""
    return _once_in_ten(
        frames, lambda number: replace(frames[number], left=shift_image(frames[number].left, 0.0, columns))
    )


def lag_right(frames: Frames, rng: np.random.Generator) -> Frames:
    """The right eye is a frame behind, all along."""
    number = np.arange(len(frames))
    return _show(frames, number, np.maximum(number - 1, 0))


def delay_right(milliseconds: float, frames: Frames, rng: np.random.Generator) -> Frames:
    """The right eye is late: its image is moved along the optical flow to the next one; the last pair is left out."""
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    none = np.zeros((*frames[0].right.shape, 2), np.float32)
    u, v = np.meshgrid(*(np.arange(size, dtype=np.float32) for size in reversed(none.shape[:2])))
    delayed = []
    for frame, following in pairwise(frames):
        share = 1e-3 * milliseconds / (following.timestamp - frame.timestamp)
        moved = np.float32(share) * flow.calc(frame.right, following.right, none.copy())
        places = u - moved[..., 0], v - moved[..., 1]
        right = cv2.remap(frame.right, *places, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        delayed.append(replace(frame, right=right))
    return delayed


# Light.


def step_exposure(factor: float, frames: Frames, rng: np.random.Generator) -> Frames:
    """Both eyes become brighter or darker at half time; what is too bright is white."""
    return _change_second_half(frames, lambda image: scale_light(image, factor), eyes="both")


def step_gain(frames: Frames, rng: np.random.Generator) -> Frames:
    """Each image of the second half has a gain of its own between a half and 1.6: automatic gain that hunts."""
    gains = rng.uniform(0.5, 1.6, (len(frames), 2))
    middle = len(frames) // 2
    return frames[:middle] + [
        replace(frame, left=scale_light(frame.left, gain[0]), right=scale_light(frame.right, gain[1]))
        for frame, gain in zip(frames[middle:], gains[middle:], strict=True)
    ]


def darken_right(factor: float, frames: Frames, rng: np.random.Generator) -> Frames:
    """The right eye has a share of its light from half time on."""
    return _change_second_half(frames, lambda image: scale_light(image, factor))


def cover(seconds: float, frames: Frames, rng: np.random.Generator) -> Frames:
    """A hand over both lenses: black with some noise."""
    return blacken(frames, start_of(frames), round(seconds / interval(frames)), rng)


def blacken(frames: Frames, first: int, count: int, rng: np.random.Generator) -> Frames:
    """So many frames from the first one on are black with some noise."""
    changed = list(frames)
    for number in range(first, min(first + count, len(frames))):
        shape = frames[number].left.shape
        left, right = (np.clip(rng.normal(6.0, 1.5, shape), 0, 255).astype(np.uint8) for _ in range(2))
        changed[number] = replace(frames[number], left=left, right=right)
    return changed


# The rig, from half time on.


def swap_eyes(frames: Frames, rng: np.random.Generator) -> Frames:
    """Left and right are exchanged: drivers enumerate cameras anew."""
    middle = len(frames) // 2
    return frames[:middle] + [replace(frame, left=frame.right, right=frame.left) for frame in frames[middle:]]


def bump(rows: float, columns: float, frames: Frames, rng: np.random.Generator) -> Frames:
    """The right image is moved down and to the right, pixels."""
    return _change_second_half(frames, lambda image: shift_image(image, rows, columns))


def bump_yaw(degrees: float, frames: Frames, rng: np.random.Generator) -> Frames:
    """The right camera is turned about its vertical axis; its focal length counts as the width of its image."""
    return _change_second_half(frames, lambda image: turn_image(image, degrees))


def scale_light(image: np.ndarray, factor: float) -> np.ndarray:
    """An image (H, W) with so many times its light."""
    return np.clip(np.rint(factor * image.astype(np.float64)), 0, 255).astype(np.uint8)


def shift_image(image: np.ndarray, rows: float, columns: float) -> np.ndarray:
    """An image (H, W) moved down and to the right, pixels; its edge is repeated."""
    return _warp(image, np.array([[1.0, 0.0, columns], [0.0, 1.0, rows], [0.0, 0.0, 1.0]]))


def turn_image(image: np.ndarray, degrees: float) -> np.ndarray:
    """An image (H, W) of a pinhole camera, with its width as focal length, that is turned to its right."""
    height, width = image.shape
    matrix = np.array([[width, 0.0, (width - 1) / 2], [0.0, width, (height - 1) / 2], [0.0, 0.0, 1.0]])
    angle = np.deg2rad(degrees)
    turn = np.array([[np.cos(angle), 0.0, -np.sin(angle)], [0.0, 1.0, 0.0], [np.sin(angle), 0.0, np.cos(angle)]])
    return _warp(image, matrix @ turn @ np.linalg.inv(matrix))


def _warp(image: np.ndarray, homography: np.ndarray) -> np.ndarray:
    height, width = image.shape
    return np.asarray(cv2.warpPerspective(image, homography, (width, height), borderMode=cv2.BORDER_REPLICATE))


def _restamp(frames: Frames, later: np.ndarray) -> Frames:
    return [
        replace(frame, timestamp=frame.timestamp + float(delay)) for frame, delay in zip(frames, later, strict=True)
    ]


def _show(frames: Frames, left: np.ndarray, right: np.ndarray | None = None) -> Frames:
    """The frames with the images of others, by their numbers; the right ones go with the left ones unless given."""
    right = left if right is None else right
    return [
        replace(frame, left=frames[a].left, right=frames[b].right)
        for frame, a, b in zip(frames, left, right, strict=True)
    ]


def _once_in_ten(frames: Frames, change: Callable[[int], DrivenFrame]) -> Frames:
    """The frames, some of them changed, by their numbers."""
    return [change(number) if number % 10 == 5 else frame for number, frame in enumerate(frames)]


def _compressed(image: np.ndarray, quality: int) -> np.ndarray:
    return np.asarray(cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], 0))


def _frozen(frames: int, first: int, count: int) -> np.ndarray:
    number = np.arange(frames)
    return np.where((number >= first) & (number < first + count), first - 1, number)


def _change_second_half(frames: Frames, change: Callable[[np.ndarray], np.ndarray], eyes: str = "right") -> Frames:
    middle = len(frames) // 2
    return frames[:middle] + [
        replace(frame, left=change(frame.left) if eyes == "both" else frame.left, right=change(frame.right))
        for frame in frames[middle:]
    ]


NO_FAULT = "none"
FAULTS: dict[str, Fault] = {
    NO_FAULT: Fault("as recorded", lambda frames, rng: frames),
    **{
        f"alternate_{round(100 * share)}": Fault(
            f"stamps early and late in turn by {share:.0%} of the interval", partial(alternate, share)
        )
        for share in (0.1, 0.2, 0.3, 0.4)
    },
    **{
        f"jitter_{round(100 * share)}": Fault(
            f"stamps with Gaussian jitter of {share:.0%} of the interval", partial(jitter, share)
        )
        for share in (0.1, 0.2)
    },
    **{
        f"bursts_{size}": Fault(f"stamps of arrival, {size} frames at a time", partial(deliver_in_bursts, size))
        for size in (2, 3, 5)
    },
    "one_late": Fault("one stamp late by 70 % of the interval", partial(delay_one, 0.7)),
    "duplicates": Fault("two stamps equal to those before", duplicate_stamps),
    "drift": Fault("clock fast by 1 %, with jitter", partial(drift_clock, 0.01)),
    "step_forward": Fault("clock set forward by 5 intervals", partial(step_clock, 5.0)),
    "step_back": Fault("clock set back by 5 intervals", partial(step_clock, -5.0)),
    "frozen_5": Fault("the same pair for 5 frames", partial(freeze, 5)),
    "frozen_10": Fault("the same pair for 10 frames", partial(freeze, 10)),
    "frozen_anew": Fault("the same pair for 10 frames, compressed anew", partial(freeze_anew, 10)),
    "frozen_right": Fault("the same right image for 5 frames", partial(freeze_right, 5)),
    "drop_20": Fault("a fifth of the frames is missing", partial(drop, 0.2)),
    "uncounted": Fault("a tenth is missing, stamps are of a counter without them", partial(drop_uncounted, 0.1)),
    "gap_10": Fault("10 frames in a row are missing", partial(drop_in_a_row, 10)),
    "repeated": Fault("an old pair under a new stamp, once in ten", repeat_out_of_order),
    "out_of_order": Fault("two pairs exchanged, stamps in order, once in ten", swap_neighbours),
    "torn": Fault("lower halves of the frame before, once in ten", tear),
    "left_shifted": Fault("left image 8 px to the right, once in ten", partial(shift_left, 8.0)),
    "right_lags": Fault("the right eye is a frame behind", lag_right),
    "exposure": Fault("2.5 times the light from half time on", partial(step_exposure, 2.5)),
    "gain": Fault("gains hunt from half time on, each eye alone", step_gain),
    "right_dark": Fault("the right eye at a third of its light from half time on", partial(darken_right, 1 / 3)),
    "swapped": Fault("eyes exchanged from half time on", swap_eyes),
    "rows_3": Fault("right image 3 px lower from half time on", partial(bump, 3.0, 0.0)),
    "columns_2": Fault("right image 2 px to the right from half time on", partial(bump, 0.0, 2.0)),
    "yaw": Fault("right camera turned by 0.3° from half time on", partial(bump_yaw, 0.3)),
    **{
        f"covered_{seconds:g}": Fault(f"lenses covered for {seconds:g} s", partial(cover, seconds), seconds)
        for seconds in (0.3, 1.0, 3.0, 5.0)
    },
}
"""By name, in the order of the page; the first has no fault."""
