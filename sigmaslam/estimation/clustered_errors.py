"""By how much errors that neighbours have in common spoil a pose: a cluster-robust covariance."""

from __future__ import annotations

import numpy as np

from sigmaslam.estimation.acceptance import ACCEPTANCE
from sigmaslam.geometry.image_cells import CELLS, image_cells


def clustering(places: np.ndarray, size: tuple[int, int], scores: np.ndarray, information: np.ndarray) -> float:
    """Factor by which a pose's variances are too small because errors of neighbouring views are alike; 1 where usual.

    What the views of each cell of the image say together, their scores summed, is compared with what they say one by
    one (Liang and Zeger 1986, with the small-sample factor). A body that moves on its own makes whole cells
    disagree, and so does a blur that misplaces patches of one depth alike.

    Args:
        places: (M, 2) of the views, pixels.
        size: of the image, width and height.
        scores: (M, p) slopes of each view's log-likelihood by the pose, at the estimate; zero for those not used.
        information: (p, p) of the views.
    """
    cell = image_cells(places, *size)
    sums = np.zeros((CELLS, scores.shape[1]))
    np.add.at(sums, cell, scores)
    used = len(np.unique(cell[(scores != 0.0).any(axis=1)]))
    alone, together = (float(np.trace(np.linalg.solve(information, each.T @ each))) for each in (scores, sums))
    if used < 2 or alone <= 0.0:
        return 1.0
    factor = together / alone * used / (used - 1)
    return factor if factor > ACCEPTANCE.usual_clustering else 1.0
