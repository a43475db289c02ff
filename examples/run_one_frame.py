"""One frame by the graphs that ship, in numpy and onnxruntime: from two stereo pairs to a pose and its covariance.

    python examples/run_one_frame.py models/sigmaslam_weights synthetic/sigmaslam_synthetic/demo 4

The pairs are images 0 and 4 of a folder in KITTI's layout; OpenCV only reads them. docs/onnx.md says what each graph
takes. The tracker does more: it follows keypoints from image to image, and keeps a window of keyframes and a map.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
import onnxruntime

KEYPOINTS = 400
# The tracker's: the graph's float64 products lose digits by this fusion.
DISABLED = ["MatMulScaleFusion"]
FREEDOM = 2.0  # of the Student-t that errors are taken for, as the tracker's
OUTPUTS = ["agree", "count", "usable", "squared", "noise_scale_found", "offset_after", "spread_after", "moved_after"]


def load(weights: Path, name: str) -> onnxruntime.InferenceSession:
    """A graph of the folder, on the CPU."""
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3  # of errors alone
    path, providers = weights / f"{name}.onnx", ["CPUExecutionProvider"]
    return onnxruntime.InferenceSession(path, options, providers=providers, disabled_optimizers=DISABLED)


def detect(features: onnxruntime.InferenceSession, path: Path) -> list[np.ndarray]:
    """Keypoints (N, 2) pixels, scores (N,), descriptors (N, C) and sigmas (N,) pixels of an image."""
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    height, width = (32 * -(-side // 32) for side in image.shape)
    padded = np.pad(image, ((0, height - image.shape[0]), (0, width - image.shape[1])), mode="edge")
    feed = {"image": padded[None, None].astype(np.float32) / 255.0, "count": np.array(KEYPOINTS)}
    found = features.run(None, feed)
    inside = (found[1] > 0) & (found[0] < image.shape[::-1]).all(axis=1)
    return [each[inside] for each in found]


def match(first: list[np.ndarray], second: list[np.ndarray], allowed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of both (M,) that are each other's most similar among the allowed pairs (N, K)."""
    similarity = np.where(allowed, first[2] @ second[2].T, -1.0)
    best = similarity.argmax(axis=1)
    mutual = (similarity.argmax(axis=0)[best] == np.arange(len(best))) & (similarity.max(axis=1) > 0.5)
    return np.flatnonzero(mutual), best[mutual]


def stereo(features: onnxruntime.InferenceSession, folder: Path, index: int) -> tuple[np.ndarray, ...]:
    """(u, v, disparity) (M, 3), its covariance (M, 3, 3), and descriptors (M, C) of an image pair."""
    left, right = (detect(features, folder / f"image_{eye}" / f"{index:06d}.png") for eye in (0, 1))
    shift = left[0][:, None] - right[0][None]
    rows, others = match(left, right, (np.abs(shift[..., 1]) < 2.0) & (shift[..., 0] > 0.5))
    measured = np.column_stack([left[0][rows], left[0][rows, 0] - right[0][others, 0]])
    u, both = left[3][rows] ** 2, left[3][rows] ** 2 + right[3][others] ** 2
    covariance = np.zeros((len(rows), 3, 3))
    covariance[:, 0, 0] = covariance[:, 1, 1] = covariance[:, 0, 2] = covariance[:, 2, 0] = u
    covariance[:, 2, 2] = both
    return measured.astype(np.float64), covariance, left[2][rows]


def run(weights: Path, folder: Path, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Pose T_0_index (4, 4) in metres, and its covariance (6, 6), perturbed from the left: translation, rotation."""
    names = ("features", "pose_predict", "frame_robust", "frame_gated")
    features, predict, robust, gated = (load(weights, name) for name in names)
    lines = (folder / "calib.txt").read_text().splitlines()
    P = [np.array(line.split()[1:], dtype=float).reshape(3, 4) for line in lines[:2]]
    intrinsics = np.array([P[0][0, 0], P[0][1, 1], P[0][0, 2], P[0][1, 2], P[0][0, 3] - P[1][0, 3]])
    times = np.loadtxt(folder / "times.txt")

    # Predict: at rest in the first image, of a speed that is known to 0.5 m/s and 0.5 rad/s.
    prior = np.diag([1e-12] * 6 + [0.25] * 6)
    at_rest = {"pose": np.eye(4), "twist": np.zeros(6), "covariance": prior, "densities": np.array([0.1, 0.1])}
    pose, covariance = predict.run(None, {**at_rest, "step": np.array(times[index] - times[0])})

    # Measure: landmarks of the first pair, found again in the second.
    (hosted, hosted_covariance, hosted_look), (seen, noise, look) = (stereo(features, folder, k) for k in (0, index))
    near = np.linalg.norm(hosted[:, None, :2] - seen[None, :, :2], axis=2) < 60.0
    rows, others = match([hosted, hosted, hosted_look], [seen, seen, look], near)
    count = len(rows)
    landmark_covariance = np.zeros((count, 6, 6))
    landmark_covariance[:, :3, :3] = hosted_covariance[rows]

    # Update: the state is 15 errors of calibration and views, the first pose, all known here, and the frame's pose.
    size = 15 + 6 + 6
    factor = np.zeros((size, 6))
    factor[-6:] = np.linalg.cholesky(covariance[:6, :6])
    known = {
        "intrinsics": intrinsics,
        "depth": np.array(np.median(intrinsics[4] / hosted[rows, 2])),
        "unscented": np.array(1.0),
        "anchors": np.array([0]),
        "views": np.array([1]),
        "pair": np.zeros(count, dtype=np.int64),
        "common": np.zeros((count, 3, 2)),
        "covariance": landmark_covariance,
        "estimate": np.column_stack([hosted[rows], np.zeros((count, 3))]),
        "dependence": np.zeros((count, 6, size)),
        "poses": np.stack([np.eye(4), pose]),
        "calibration": np.zeros(15),
        "factor": factor,
        "measurement": seen[others],
        "noise": noise[others],
        "scale": np.array(1.0),
    }
    offset, spread, moved = np.zeros(size), factor @ factor.T, np.zeros((count, 6))
    for first in (1.0, 0.0):
        at = {"offset": offset, "spread": spread, "moved": moved, "gated": np.array(first)}
        offset, spread, moved, _ = robust.run(None, {**known, **at})
    noise_scale, student = np.array(0.0), {"freedom": np.array(FREEDOM), "prior": np.zeros((size, 15))}
    for _ in range(2):
        at = {"offset": offset, "spread": spread, "moved": moved, "noise_scale": noise_scale}
        found = dict(zip(OUTPUTS, gated.run(None, {**known, **student, **at})[: len(OUTPUTS)], strict=True))
        offset, spread, moved = found["offset_after"], found["spread_after"], found["moved_after"]
        noise_scale = found["noise_scale_found"]
    print(f"{count} landmarks, {int(found['count'])} of them agree")
    return exponential(offset[-6:]) @ pose, spread[-6:, -6:]


def exponential(twist: np.ndarray) -> np.ndarray:
    """Rigid motion (4, 4) of a twist (6,): translation, rotation."""
    x, y, z = twist[3:]
    matrix = np.zeros((4, 4))
    matrix[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    matrix[:3, 3] = twist[:3]
    term, total = np.eye(4), np.eye(4)
    for k in range(1, 20):
        term = term @ matrix / k
        total = total + term
    return total


if __name__ == "__main__":
    if len(sys.argv) < 4:
        sys.exit(__doc__)
    given_weights, given_folder, given_index = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])
    found, covariance_found = run(given_weights, given_folder, given_index)
    truth = np.vstack([np.loadtxt(given_folder / "poses.txt")[given_index].reshape(3, 4), [0, 0, 0, 1]])
    error = np.linalg.inv(truth) @ found
    turned = np.degrees(np.arccos(np.clip((np.trace(error[:3, :3]) - 1.0) / 2.0, -1.0, 1.0)))
    moved, off = np.linalg.norm(truth[:3, 3]), np.linalg.norm(error[:3, 3])
    print(f"moved {moved:.3f} m; off by {off:.4f} m and {turned:.3f} degrees")
    print("sigmas, metres and radians:", np.sqrt(np.diagonal(covariance_found)).round(4))
