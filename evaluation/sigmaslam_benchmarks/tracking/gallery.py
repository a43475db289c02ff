"""Pictures of docs/synthetic.md: every preset, with its truth, as one sheet each.

`python -m sigmaslam_benchmarks.tracking.gallery --out docs/synthetic`
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from sigmaslam_synthetic.presets import PRESETS
from sigmaslam_synthetic.simulation import Frame, Recipe, Studio, simulate

_SEED = 2
_FRAMES = 40
_SHOWN = 12  # number of the frame on the sheet
_WIDTH = 400  # of one picture on the sheet, pixels
_MOVERS = {"street": 0.15, "room": 0.1, "drone": 0.15, "organ": 0.15}


def write_gallery(out: Path) -> list[Path]:
    """Renders one frame of every preset and writes its sheet, `<preset>.jpg`, into a folder."""
    out.mkdir(parents=True, exist_ok=True)
    written = []
    for name in PRESETS:
        recipe = Recipe(name, _FRAMES, seed=_SEED, movers=_MOVERS.get(name, 0.0))
        frame = Studio(simulate(recipe)).frames(np.array([_SHOWN]))[0]
        path = out / f"{name}.jpg"
        cv2.imwrite(str(path), sheet(frame), [cv2.IMWRITE_JPEG_QUALITY, 82])
        written.append(path)
    return written


def sheet(frame: Frame) -> np.ndarray:
    """Left, right, depth; flow, instance ids, occlusion: (H, W, 3) uint8."""
    left = cv2.cvtColor(frame.left, cv2.COLOR_GRAY2BGR)
    # Red: hidden or out of sight in the next left image; blue: in the right image; violet: in both.
    hidden = left // 2
    valid = np.isfinite(frame.depth)
    hidden[valid & ~frame.flow_visible, 2] = 230
    hidden[valid & ~frame.stereo_visible, 0] = 230
    pictures = [
        (left, "left"),
        (cv2.cvtColor(frame.right, cv2.COLOR_GRAY2BGR), "right"),
        (_depth(frame.depth), "depth"),
        (_flow(frame.flow), "flow to the next left image"),
        (_ids(frame.body), "instance ids"),
        (hidden, "unseen: red in the next image, blue in the right one"),
    ]
    scale = _WIDTH / frame.left.shape[1]
    small = []
    for picture, label in pictures:
        shrunk = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        for colour, thickness in ((0, 3), (255, 1)):
            cv2.putText(shrunk, label, (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (colour,) * 3, thickness, cv2.LINE_AA)
        small.append(shrunk)
    return np.vstack([np.hstack(small[:3]), np.hstack(small[3:])])


def _depth(depth: np.ndarray) -> np.ndarray:
    """Inverse depth in colour, near is bright; black where there is nothing."""
    valid = np.isfinite(depth)
    inverse = np.where(valid, 1.0 / np.where(valid, depth, 1.0), 0.0)
    low, high = np.percentile(inverse[valid], [1, 99])
    grey = np.clip((inverse - low) / max(high - low, 1e-9), 0, 1)
    return np.where(valid[..., None], cv2.applyColorMap((255 * grey).astype(np.uint8), cv2.COLORMAP_INFERNO), 0)


def _flow(flow: np.ndarray) -> np.ndarray:
    """Direction as hue, length as saturation up to its 95 % quantile."""
    valid = np.isfinite(flow).all(axis=-1)
    u, v = np.moveaxis(np.where(valid[..., None], flow, 0.0).astype(np.float32), -1, 0)
    length, angle = cv2.cartToPolar(u, v, angleInDegrees=True)
    reach = max(float(np.percentile(length[valid], 95)), 1e-6)
    share = np.clip(length / reach, 0, 1)
    hsv = np.stack([angle / 2, 255 * share, np.where(valid, 255, 0)], axis=-1).astype(np.uint8)
    return np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2BGR))


def _ids(body: np.ndarray) -> np.ndarray:
    """Every body in a colour of its own; black where there is nothing."""
    colours = np.random.default_rng(0).integers(40, 256, (int(body.max()) + 2, 3), dtype=np.uint8)
    colours[-1] = 0
    return np.asarray(colours[body])


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m sigmaslam_benchmarks.tracking.gallery", description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder of the sheets")
    for path in write_gallery(parser.parse_args(arguments).out):
        print(path)


if __name__ == "__main__":
    main()
