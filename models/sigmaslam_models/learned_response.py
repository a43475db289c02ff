"""A learned response of the detector: the Hessian's, times what a small head on the network's features makes of it."""

import torch
from torch import Tensor, nn
from torch.nn import functional

from sigmaslam_models.detector import CELL, MIN_RESPONSE, second_derivatives, surroundings

_WIDTH = 16
# Where the Hessian has no blob: a fiftieth of a usual keypoint's response, which the head can raise.
_FLOOR = 0.02
# Largest logarithm of the gain: the floor rises to a usual keypoint's response, and no blob is out of reach.
_MOST = 4.0


class LearnedResponse(nn.Module):
    """How well each pixel would serve as a keypoint; before it is trained, what the Hessian says.

    The Hessian was chosen on warped planes. Between wide views of relief other places repeat, corners among them, and
    other orders of blobs do not reach those (docs/notebook, features): the head also sees the second derivatives.

    Args:
        features: channels of the network's finest map.

    Shapes:
        cells (B, 16, H/4, W/4), features (B, C, H/4, W/4) -> response (B, 16, H/4, W/4), in cells; not negative, zero
        where the image is flat.
    """

    def __init__(self, features: int) -> None:
        super().__init__()
        self.see_features = nn.Conv2d(features, _WIDTH, 1)
        self.see_derivatives = nn.Conv2d(3 * CELL * CELL, _WIDTH, 1, bias=False)
        # A response is as good as any multiple of it: no bias.
        self.decide = nn.Conv2d(_WIDTH, CELL * CELL, 3, padding=1, bias=False)
        nn.init.zeros_(self.decide.weight)

    def forward(self, cells: Tensor, features: Tensor) -> Tensor:
        """Responses of all pixels."""
        derivatives = second_derivatives(cells)
        uu, vv, uv = derivatives.split(CELL * CELL, dim=1)
        determinant = uu * vv - uv * uv
        level = surroundings(determinant)
        seen = self.see_features(features) + self.see_derivatives(derivatives) * level.rsqrt()
        gain = _MOST * (self.decide(functional.relu(seen)) / _MOST).tanh()
        response = (functional.relu(determinant / level) + _FLOOR) * gain.exp()
        return torch.where(determinant.abs() > MIN_RESPONSE, response, torch.zeros_like(response))
