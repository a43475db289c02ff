"""Where the camera is in each stereo pair of a recording, and how sure that is: three sigma.

    python examples/track_folder.py synthetic/sigmaslam_synthetic/demo

Any recording that `sigmaslam track` reads; a folder of plain images needs a calibration file as second argument.
"""

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import sigmaslam


def run(source: Path, calibration: Path | None = None) -> Iterator[sigmaslam.Estimate]:
    """The estimate of each pair, in order."""
    sequence = sigmaslam.open_sequence(source, calibration=calibration)
    tracker = sigmaslam.StereoTracker(sequence.camera)
    for frame in sequence.frames():
        yield tracker.step(frame.left, frame.right, frame.timestamp)


def three_sigma(estimate: sigmaslam.Estimate) -> tuple[np.ndarray, np.ndarray]:
    """Three sigma of the position along the world's axes, metres, and of the rotation about the camera's, degrees."""
    # The covariance is in the camera's own frame, translation before rotation.
    R = estimate.T_world_camera[:3, :3]
    position = R @ estimate.covariance[:3, :3] @ R.T
    return 3.0 * np.sqrt(np.diagonal(position)), np.degrees(3.0 * np.sqrt(np.diagonal(estimate.covariance)[3:]))


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    for estimate in run(Path(sys.argv[1]), Path(sys.argv[2]) if len(sys.argv) > 2 else None):
        if not estimate.has_pose:
            print(f"{estimate.timestamp:9.3f} s  {estimate.status}")
            continue
        position, rotation = three_sigma(estimate)
        xyz = "  ".join(f"{x:+.4f} ± {s:.4f}" for x, s in zip(estimate.T_world_camera[:3, 3], position, strict=True))
        print(f"{estimate.timestamp:9.3f} s  {estimate.status:11s}  {xyz} m, ± {rotation.max():.3f} degrees")
