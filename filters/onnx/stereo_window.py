"""Stereo landmarks of keyframes seen from other poses: the measurement (9.39)-(9.42), statistically linearised.

One function serves the tracker's whole back end: the update of a frame, the joint solution of the window of keyframes,
and the search for matches all need, for every landmark and view, the expected measurement and how it changes with

  relative pose  6  T_view_host, perturbed from the left: translation, rotation
  calibration    3  what the disparity is off by: constant, with x^2 (yaw of the right camera), with x y (its pitch),
                    all in pixels at unit normalised coordinates
  landmark       4  (u, v, disparity) in the keyframe that hosts it, and what its own disparities are off by in all
                    views alike (a slanted or half hidden patch is misplaced in the other eye wherever it is seen from);
                    its inverse depth enters linearly, so far points and points at infinity do no harm

The change is the slope of the regression over sigma points drawn from what is known of these numbers, and what
the slope does not explain is added to the noise (García-Fernández et al. 2015). With a vanishing spread the same
function gives the Jacobian: the extended filter is the limit of the unscented one.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from sigmaslam.filters.onnx.exportable_se3 import exp_se3
from sigmaslam.filters.onnx.unscented import odd_and_even

POSE = slice(0, 6)
CALIBRATION = slice(6, 9)
LANDMARK = slice(9, 13)
SIZE = 13

# A point whose depth along the view's optical axis is below this share of its depth in the host is not used: it is
# behind the camera, or about to be. A power of two is exact in float32, through which the exporter takes scalars.
_NEAREST = 0.0625


class StereoTransfer(nn.Module):
    """Sigma points of relative pose, calibration and landmark through the stereo measurement.

    Shapes:
        relative (p, 4, 4) T_view_host of p pairs of poses, spread (p, 9, 9) lower factor of the covariance of relative
        pose and calibration, pair (m,) int64: which of these each measurement belongs to, calibration (3,) pixels,
        intrinsics (5,) = (fx, fy, cx, cy, fx baseline), landmarks (m, 4), landmark_spread (m, 4, 4) lower factor of
        their covariance -> mean (m, 3) of (u, v, disparity), slope times spread (m, 3, 13), covariance of what the
        slope leaves (m, 3, 3), in_front (m,) 1.0 or 0.0; all float64.
    """

    def forward(
        self,
        relative: Tensor,
        spread: Tensor,
        pair: Tensor,
        calibration: Tensor,
        intrinsics: Tensor,
        landmarks: Tensor,
        landmark_spread: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The unscented transform (steps 4 and 5 of Table 9.2), landmark by landmark."""
        root = torch.sqrt(torch.tensor(float(SIZE), dtype=relative.dtype, device=relative.device))
        steps = root * spread.movedim(-1, 0)
        steps = torch.cat([steps, -steps])
        moved = (exp_se3(steps[..., POSE]) @ relative).index_select(1, pair)
        biased = (calibration + steps[..., CALIBRATION]).index_select(1, pair)
        by_pose, _ = _project(moved, biased, intrinsics, landmarks)
        steps = root * landmark_spread.movedim(-1, 0)
        here = relative.index_select(0, pair)
        by_landmark, _ = _project(here, calibration, intrinsics, landmarks + torch.cat([steps, -steps]))
        nine, four = LANDMARK.start, SIZE - LANDMARK.start
        samples = torch.cat([by_pose[:nine], by_landmark[:four], by_pose[nine:], by_landmark[four:]])
        mean, odd, even = odd_and_even(samples)
        _, depth = _project(here, calibration, intrinsics, landmarks)
        residual_covariance = torch.stack([(even * even[:, i : i + 1]).sum(dim=-1) for i in range(3)], dim=-1)
        return mean, odd, residual_covariance, (depth > _NEAREST).to(mean.dtype)


def _project(relative: Tensor, calibration: Tensor, intrinsics: Tensor, landmarks: Tensor) -> tuple[Tensor, Tensor]:
    """(u, v, disparity) (..., m, 3) in the view, and the depth there as a share of that in the host (..., m)."""
    fx, fy, cx, cy, focal_baseline = (intrinsics[i] for i in range(5))
    x, y = (landmarks[..., 0] - cx) / fx, (landmarks[..., 1] - cy) / fy
    d, landmark_offset = landmarks[..., 2], landmarks[..., 3]
    inverse_depth = (d - landmark_offset - _bias(calibration, x - d / fx, y)) / focal_baseline
    # Written out, because millions of tiny matrix products are slow.
    seen = [
        relative[..., i, 0] * x + relative[..., i, 1] * y + relative[..., i, 2] + relative[..., i, 3] * inverse_depth
        for i in range(3)
    ]
    share = 1.0 / seen[2].clamp_min(0.5 * _NEAREST)
    u, v, true_disparity = seen[0] * share, seen[1] * share, focal_baseline * inverse_depth * share
    disparity = true_disparity + landmark_offset + _bias(calibration, u - true_disparity / fx, v)
    return torch.stack([fx * u + cx, fy * v + cy, disparity], dim=-1), seen[2]


def _bias(calibration: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Measured minus true disparity at normalised coordinates of the right image, to first order in the angles."""
    return calibration[..., 0] + calibration[..., 1] * x * x + calibration[..., 2] * x * y
