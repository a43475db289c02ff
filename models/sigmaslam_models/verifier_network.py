"""The match verifier: probability and covariance of a match from what its refined patches look like."""

import torch
from torch import Tensor, nn

VERIFIER_COLUMNS, PLACE_COLUMNS = 14, 12
"""Of `sigmaslam.frontend.verifier_inputs`: `describe_matches`, `describe_places`."""
_WIDTH = 48
# Of log sigma, pixels.
_MIN_LOG_SIGMA, _MAX_LOG_SIGMA = -4.0, 2.5


class MatchVerifier(nn.Module):
    """A small network on each match alone.

    It learns by how much the error exceeds what theory says of an alignment: variance of the difference of the patches
    over their squared gradient, along each of the patch's axes.

    Args:
        columns: that describe a match: `VERIFIER_COLUMNS` or `PLACE_COLUMNS`; the first six mean the same in both.
    """

    mean: Tensor
    spread: Tensor
    logit_scale: Tensor
    logit_shift: Tensor
    sigma_scale: Tensor

    def __init__(self, columns: int = VERIFIER_COLUMNS) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(columns))
        self.register_buffer("spread", torch.ones(columns))
        # Fitted after training, on held-out renders.
        self.register_buffer("logit_scale", torch.ones(()))
        self.register_buffer("logit_shift", torch.zeros(()))
        self.register_buffer("sigma_scale", torch.ones(()))
        self.layers = nn.Sequential(
            nn.Linear(columns, _WIDTH), nn.ReLU(), nn.Linear(_WIDTH, _WIDTH), nn.ReLU(), nn.Linear(_WIDTH, 3)
        )

    def forward(self, columns: Tensor) -> tuple[Tensor, Tensor]:
        """Logit that the match is right, (M,), and log sigma along the patch's axes, (M, 2), pixels of image 1.

        Args:
            columns: (M, C) of `sigmaslam.frontend.verifier_inputs`.
        """
        outputs = self.layers((columns - self.mean) / self.spread)
        theory = 0.5 * (columns[:, 1:2] - columns[:, 4:6])
        log_sigma = (outputs[:, 1:] + theory).clamp(_MIN_LOG_SIGMA, _MAX_LOG_SIGMA)
        return self.logit_scale * outputs[:, 0] + self.logit_shift, log_sigma + torch.log(self.sigma_scale)


class MatchCovariance(nn.Module):
    """The verifier as its graph is called."""

    def __init__(self, verifier: MatchVerifier) -> None:
        super().__init__()
        self.verifier = verifier

    def forward(self, columns: Tensor, axes: Tensor) -> tuple[Tensor, Tensor]:
        """Probability (M,) and covariance (M, 2, 2) in pixels squared, from (M, C) columns and (M, 2, 2) axes."""
        logit, log_sigma = self.verifier(columns)
        variance = torch.exp(2.0 * log_sigma)
        covariance = (axes * variance.unsqueeze(1)) @ axes.transpose(1, 2)
        # The product rounds both off-diagonals on its own.
        return torch.sigmoid(logit), 0.5 * (covariance + covariance.transpose(1, 2))
