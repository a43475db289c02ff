"""By how much errors that neighbours have in common spoil a pose: a cluster-robust covariance."""

from dataclasses import replace

import numpy as np

from sigmaslam.estimation.acceptance import ACCEPTANCE
from sigmaslam.estimation.frame_fit import FrameFit
from sigmaslam.geometry.image_cells import CELLS, image_cells

# Part of one frame in the average: one frame's cells are too few to tell (docs/notebook, noise).
_GAIN = 0.1
# What one cell alone knows tells nothing of its errors: they are taken for twice as large as what is left, no more.
_LEAST_LEFT = 0.25
# Of what the views say together; so few say nothing of each other.
_MAX_CONDITION = 1e12


def clustering(places: np.ndarray, size: tuple[int, int], scores: np.ndarray, information: np.ndarray) -> float:
    """Factor by which a pose's variances are too small because errors of neighbouring views are alike; about 1 if not.

    What the views of each cell of the image say together, their scores summed, is compared with what they say one by
    one (Liang and Zeger 1986). The pose follows each cell by the cell's share in what is known of it, and what is left
    of the cell's errors is taken for so much more (CR2 of Bell and McCaffrey 2002). A body that moves on its own makes
    whole cells disagree, and so do a blur that misplaces patches of one depth alike, and shelves full of edges.

    Args:
        places: (M, 2) of the views, pixels.
        size: of the image, width and height.
        scores: (M, n) slopes of each view's log-likelihood by the pose, at the estimate; zero for those not used.
        information: (n, n) of the views; n is 6, without scale 5.
    """
    cell, freedom = image_cells(places, *size), scores.shape[1]
    one_by_one = scores.T @ scores
    if not np.trace(one_by_one) > 0.0 or np.linalg.cond(one_by_one) > _MAX_CONDITION:
        return 1.0
    # In units of what the views say one by one, which is the identity then.
    root = np.linalg.cholesky(one_by_one)
    scores = np.linalg.solve(root, scores.T).T
    members = (cell == np.arange(CELLS)[:, None]).astype(float)
    sums, products = members @ scores, (scores[:, :, None] * scores[:, None, :]).reshape(len(cell), -1)
    share = (members @ products).reshape(CELLS, freedom, freedom)
    left, along = np.linalg.eigh(np.eye(freedom) - share)
    scale = 1.0 / np.sqrt(np.maximum(left, _LEAST_LEFT))
    sums = (along @ (scale[..., None] * (along.transpose(0, 2, 1) @ sums[..., None])))[..., 0]
    by_pose = root.T @ np.linalg.solve(information, root)
    return float(np.einsum("ia,ab,ib->", sums, by_pose, sums) / np.trace(by_pose))


class SharedErrors:
    """How alike errors of neighbouring views are in the scene at hand: an average over frames."""

    def __init__(self) -> None:
        self._average, self._count = 1.0, 1

    def averaged(self, fit: FrameFit) -> FrameFit:
        """One more frame, with a `clustering` by which to multiply its variances, 1 or more, in place of its own."""
        self._count += 1
        self._average += max(1.0 / self._count, _GAIN) * (fit.clustering - self._average)
        # A body that comes into view is news.
        alone = fit.clustering if fit.clustering > ACCEPTANCE.usual_clustering else 1.0
        return replace(fit, clustering=max(self._average, 1.0, alone))
