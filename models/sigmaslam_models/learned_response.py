"""A learned response of the detector: blobs and saddles of the Hessian, each weighed by a small head of the network."""

import torch
from torch import Tensor, nn
from torch.nn import functional

from sigmaslam_models.detector import CELL, MIN_RESPONSE, hessian_response, surroundings

_WIDTH = 16
_KINDS = 2
# Saddles begin with so little, in logarithm, that blobs alone are found, and no weight leaves e^4 to either side.
_SADDLES, _MOST = -2.0, 4.0


class LearnedResponse(nn.Module):
    """How well each pixel would serve as a keypoint; before it is trained, nearly what the Hessian says.

    The Hessian was chosen on warped planes. Between wide views of relief other places repeat, corners among them, which
    are saddles beside blobs. Weights change smoothly from cell to cell: a gain of each pixel's own locks keypoints to
    the grid of cells, and they do not repeat (docs/notebook, features).

    Args:
        features: channels of the network's finest map.

    Shapes:
        cells (B, 16, H/4, W/4), features (B, C, H/4, W/4) -> response (B, 16, H/4, W/4), in cells; not negative, zero
        where the image is flat.
    """

    def __init__(self, features: int) -> None:
        super().__init__()
        self.see_features = nn.Conv2d(features, _WIDTH, 1)
        self.decide = nn.Conv2d(_WIDTH, _KINDS, 3, padding=1)
        nn.init.zeros_(self.decide.weight)
        assert self.decide.bias is not None
        nn.init.zeros_(self.decide.bias)

    def forward(self, cells: Tensor, features: Tensor) -> Tensor:
        """Responses of all pixels."""
        determinant = hessian_response(cells)
        level = surroundings(determinant)
        seen = functional.relu(self.see_features(features))
        first = torch.tensor([0.0, _SADDLES], dtype=seen.dtype, device=seen.device).view(1, _KINDS, 1, 1)
        weights = (_MOST * (self.decide(seen) / _MOST).tanh() + first).exp()
        blob, saddle = _at_pixels(weights / level).split(CELL * CELL, dim=1)
        # What is flat stays zero: round-off is of neither kind.
        return (
            functional.relu(determinant - MIN_RESPONSE) * blob + functional.relu(-determinant - MIN_RESPONSE) * saddle
        )


def _at_pixels(values: Tensor) -> Tensor:
    """Values of cells (B, 2, h, w), bilinear at their pixels: (B, 32, h, w)."""
    places = (torch.arange(CELL, dtype=values.dtype, device=values.device) - 0.5 * (CELL - 1)) / CELL
    # Of the cell before, the cell itself and the next one.
    taps = torch.stack([(-places).clamp_min(0.0), 1.0 - places.abs(), places.clamp_min(0.0)], dim=1)
    kernel = torch.einsum("ia,jb->ijab", taps, taps).reshape(CELL * CELL, 1, 3, 3)
    padded = functional.pad(values, (1, 1, 1, 1), mode="replicate")
    # Zeros of a dense kernel cost ONNX Runtime less than groups do.
    dense = torch.einsum("kc,pab->kpcab", torch.eye(_KINDS).to(kernel), kernel[:, 0]).flatten(0, 1)
    return functional.conv2d(padded, dense)
