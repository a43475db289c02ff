"""Matches between two images, each with a probability and a covariance.

    demo=synthetic/sigmaslam_synthetic/demo
    python examples/match_two_images.py $demo/image_0/000000.png $demo/image_1/000000.png

The images may have any sizes. `min_probability` leaves out what is more likely wrong than that.
"""

import sys
from pathlib import Path

import cv2
import numpy as np

import sigmaslam


def run(first: Path, second: Path) -> sigmaslam.Matches:
    """The matches of two image files, the most probable first."""
    image0, image1 = (cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in (first, second))
    for path, image in ((first, image0), (second, image1)):
        if image is None:
            raise SystemExit(f"{path}: no image; give two PNG or JPEG files")
    return sigmaslam.match_images(image0, image1, min_probability=0.5)


if __name__ == "__main__":
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    matches = run(Path(sys.argv[1]), Path(sys.argv[2]))
    sigma = np.sqrt(np.linalg.eigvalsh(matches.covariance)[:, -1])  # along the longer axis of each ellipse, pixels
    print(f"{len(sigma)} matches; expected to be right: {matches.probability.sum():.0f}")
    for k in range(min(10, len(sigma))):
        (u0, v0), (u1, v1) = matches.keypoints0[k], matches.keypoints1[k]
        print(
            f"({u0:6.1f}, {v0:6.1f}) -> ({u1:6.1f}, {v1:6.1f}) px, sigma {sigma[k]:.2f}, {matches.probability[k]:.0%}"
        )
