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

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from sigmaslam_filters.core.sigma_points import cubature, odd_and_even
from sigmaslam_filters.manifolds.se3_matrices import exp_se3

POSE = slice(0, 6)
CALIBRATION = slice(6, 9)
LANDMARK = slice(9, 13)
SIZE = 13
_SPREAD = cubature().spread(SIZE)

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
        root = torch.sqrt(torch.tensor(_SPREAD, dtype=relative.dtype, device=relative.device))
        steps = root * spread.movedim(-1, 0)
        six, nine = CALIBRATION.start, LANDMARK.start
        # The last three columns of a lower factor do not move the pose.
        moving, biasing = steps[:six], steps[six:, :, CALIBRATION]
        moving, biasing = torch.cat([moving, -moving]), torch.cat([biasing, -biasing])
        moved = torch.cat([exp_se3(moving[..., POSE]) @ relative, relative[None]])[..., :3, :]
        biased = torch.cat([moving[..., CALIBRATION], biasing]) + calibration
        # A product with zeros and ones takes each measurement's pair out, entry by entry, and is faster than indexing.
        entries = torch.cat([moved.permute(2, 3, 0, 1).flatten(0, 2), biased.permute(2, 0, 1).flatten(0, 1)])
        pairs = torch.arange(relative.shape[0], device=relative.device)
        each = entries @ (pairs[:, None] == pair).to(relative.dtype)
        poses = each[: 12 * (2 * six + 1)].unflatten(0, (12, -1)).unbind(0)
        biases = each[12 * (2 * six + 1) :].unflatten(0, (3, -1))
        own = landmarks.mT
        by_pose, _ = _project(
            [entry[:-1] for entry in poses], biases[:, : 2 * six].unbind(0), intrinsics, own.unbind(0)
        )
        # At the pose itself: other calibrations, the landmark and calibration themselves, and other landmarks.
        steps = root * landmark_spread.permute(1, 2, 0)
        count = 2 * (nine - six) + 1
        own = own[:, None]
        around = torch.cat([own.expand(-1, count, -1), own + steps, own - steps], dim=1)
        constant = calibration[:, None, None].expand(-1, 1 + 2 * (SIZE - nine), landmarks.shape[0])
        biases = torch.cat([biases[:, 2 * six :], constant], dim=1)
        others, depth = _project([entry[-1] for entry in poses], biases.unbind(0), intrinsics, around.unbind(0))
        three, four = nine - six, SIZE - nine
        plus = torch.cat([by_pose[:, :six], others[:, :three], others[:, count : count + four]], dim=1)
        minus = torch.cat([by_pose[:, six:], others[:, three : count - 1], others[:, count + four :]], dim=1)
        mean = (plus + minus).sum(dim=1) / (2.0 * _SPREAD)
        odd, even = ((half / (2.0 * root)).permute(2, 0, 1) for half in odd_and_even(plus, minus, mean[:, None]))
        return mean.mT, odd, even @ even.mT, (depth[count - 1] > _NEAREST).to(mean.dtype)


def _project(
    pose: Sequence[Tensor], calibration: Sequence[Tensor], intrinsics: Tensor, landmark: Sequence[Tensor]
) -> tuple[Tensor, Tensor]:
    """What is seen of landmarks, component by component.

    Args:
        pose: the upper twelve entries of T_view_host, row by row, (k, m) or (m,) each.
        calibration, intrinsics: as of `StereoTransfer`.
        landmark: u, v, disparity and its own error, (k, m) or (m,) each.
    Returns:
        (u, v, disparity) (3, k, m) in the view, and the depth there as a share of that in the host (k, m).
    """
    fx, fy, cx, cy, focal_baseline = intrinsics.unbind(0)
    x, y, own = (landmark[0] - cx) / fx, (landmark[1] - cy) / fy, landmark[3]
    true = landmark[2] - own - _bias(calibration, x - landmark[2] / fx, y)
    inverse_depth = true / focal_baseline
    # Written out, because millions of tiny matrix products are slow.
    across, down, ahead = (
        pose[4 * i] * x + pose[4 * i + 1] * y + pose[4 * i + 2] + pose[4 * i + 3] * inverse_depth for i in range(3)
    )
    share = 1.0 / ahead.clamp_min(0.5 * _NEAREST)
    u, v, true_disparity = across * share, down * share, true * share
    disparity = true_disparity + own + _bias(calibration, u - true_disparity / fx, v)
    return torch.stack([fx * u + cx, fy * v + cy, disparity]), ahead


def _bias(calibration: Sequence[Tensor], x: Tensor, y: Tensor) -> Tensor:
    """Measured minus true disparity at normalised coordinates of the right image, to first order in the angles."""
    constant, yaw, pitch = calibration
    return constant + (yaw * x + pitch * y) * x
