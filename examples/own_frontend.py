"""The tracker with features of one's own: corners, described by the grey values around them.

    python examples/own_frontend.py synthetic/sigmaslam_synthetic/demo

A detector is a function of an image. `DescriptorFrontend` makes a front-end of it: matching, alignment, probability and
covariance are the same as for the learned features. A front-end without descriptors has the methods of
`sigmaslam.frontend.types.Frontend`; `sigmaslam/frontend/klt.py` is the shortest one.
"""

import sys
from pathlib import Path

import cv2
import numpy as np

import sigmaslam
from sigmaslam.frontend.descriptor import DescriptorFrontend
from sigmaslam.frontend.match_confidence import ConfidenceEstimator
from sigmaslam.frontend.types import Features

RADIUS, STEP = 6, 2  # of the samples around a corner, pixels


def detect(image: np.ndarray) -> Features:
    """Shi-Tomasi corners of an (H, W) uint8 image, strongest first, each with 49 smoothed grey values."""
    corners = cv2.goodFeaturesToTrack(image, 600, 0.003, 6.0)
    places = np.zeros((0, 2), np.float32) if corners is None else corners.reshape(-1, 2)
    offsets = np.arange(-RADIUS, RADIUS + 1, STEP, dtype=np.float32)
    v, u = (grid.ravel() for grid in np.meshgrid(offsets, offsets, indexing="ij"))
    smooth = cv2.GaussianBlur(image, (0, 0), 2.0).astype(np.float32)
    grey = cv2.remap(smooth, places[:, :1] + u, places[:, 1:] + v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    # Zero mean and unit length: the dot product of two descriptors is their correlation.
    grey -= grey.mean(axis=1, keepdims=True)
    descriptors = grey / np.maximum(np.linalg.norm(grey, axis=1, keepdims=True), 1e-6)
    scores = np.linspace(1.0, 0.0, len(places), dtype=np.float32)
    return Features(places, descriptors, scores, sigma=np.full(len(places), 0.5, np.float32))


def run(source: Path) -> list[sigmaslam.Estimate]:
    """The estimates of a recording."""
    sequence = sigmaslam.open_sequence(source)
    frontend = DescriptorFrontend("corners", detect, ConfidenceEstimator())
    tracker = sigmaslam.StereoTracker(sequence.camera, frontend)
    return [tracker.step(frame.left, frame.right, frame.timestamp) for frame in sequence.frames()]


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    estimates = run(Path(sys.argv[1]))
    tracked = [each for each in estimates if each.status == "tracking"]
    print(
        f"{len(tracked)} of {len(estimates)} frames are tracked, {np.median([e.inliers for e in tracked]):.0f} inliers"
    )
    print("last position", tracked[-1].T_world_camera[:3, 3].round(4), "m")
