"""Beliefs given what was seen later: the smoother of Rauch, Tung and Striebel (1965), over all or with a fixed lag.

All that is not a recursion is done for all steps at once. With x_f the filtered and x_p the predicted mean, gain
G = C P_p^-1 of the cross covariance C, and s the shift of a filtered mean to the smoothed one,

    s_k = G_k (local(x_p, x_f) + A s_{k+1}),    P_k = P_f - G_k P_p G_k^T + G_k A P_{k+1} A^T G_k^T,

where x_f, x_p and the derivative A of local(x_p, retract(x_f, s)) by s, at zero, are those of step k + 1. What is left
out is of the second order in s and the first in the innovation.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from sigmaslam_filters import Gaussian
from sigmaslam_filters.manifolds import Space
from sigmaslam_filters.results import TimeUpdate

# Of central differences, in units of the tangent: metres, radians and shares, all of the order of one.
_STEP = 1e-5


@dataclass(frozen=True, slots=True, eq=False)
class Smoother:
    """One robot's steps, ready for recursions backwards in time.

    Attributes:
        mean: (K + 1, p) filtered.
        covariance: (K + 1, n, n) filtered.
        gain: (K, n, n) G.
        offset: (K, n) local(x_p, x_f) of the step after.
        carried: (K, n, n) A of the step after.
        conditional: (K, n, n) covariance of a state given the next.
    """

    space: Space
    mean: np.ndarray
    covariance: np.ndarray
    gain: np.ndarray
    offset: np.ndarray
    carried: np.ndarray
    conditional: np.ndarray

    @classmethod
    def of(cls, space: Space, filtered: Gaussian, moved: TimeUpdate) -> "list[Smoother]":
        """Of each robot.

        Args:
            filtered: (K + 1, B) beliefs.
            moved: (K, B) what `BayesFilter.predict` makes of all but the last of them.
        """
        odd, _, root = moved.joint_root()
        predicted = moved.belief
        columns = filtered.mean, filtered.covariance, predicted.mean, predicted.covariance, root @ odd.mT
        return [cls._of_one(space, *(each[:, b] for each in columns)) for b in range(filtered.mean.shape[1])]

    @classmethod
    def _of_one(
        cls, space: Space, mean: Tensor, covariance: Tensor, predicted: Tensor, spread: Tensor, cross: Tensor
    ) -> "Smoother":
        # In units of the predicted deviations, as metres and shares differ by orders of magnitude.
        deviation = torch.diagonal(spread, dim1=-2, dim2=-1).sqrt()
        units = deviation[:, :, None] * deviation[:, None, :]
        gain = torch.linalg.solve(spread / units, (cross / deviation[:, None]).mT).mT / deviation[:, None]
        after = mean[1:]
        carried = _derivative(lambda change: space.local(predicted, space.retract(after, change)), spread)
        return cls(
            space,
            mean.numpy(),
            covariance.numpy(),
            gain.numpy(),
            space.local(predicted, after).numpy(),
            carried.numpy(),
            (covariance[:-1] - gain @ spread @ gain.mT).numpy(),
        )

    def smooth(self, seconds: np.ndarray | None = None, lag: float = np.inf) -> tuple[np.ndarray, np.ndarray]:
        """Means (K + 1, p) and covariances (K + 1, n, n) of the tangent, given what was seen later.

        Args:
            seconds: (K + 1,) times of the steps, for a lag.
            lag: seconds. Every `lag` seconds the last two lags are smoothed and the older one of them is published, so
                that each belief knows what was seen until one to two lags later.
        """
        count = len(self.mean)
        shifts, covariances = np.zeros((count, self.gain.shape[-1])), self.covariance.copy()
        first = 0
        if seconds is not None and np.isfinite(lag):
            for tick in np.arange(seconds[0] + 2.0 * lag, seconds[-1], lag).tolist():
                end, last = (int(np.searchsorted(seconds, each, side="right")) - 1 for each in (tick, tick - lag))
                self._backward(first, end, last, shifts, covariances)
                first = last + 1
        self._backward(first, count - 1, count - 1, shifts, covariances)
        mean, change = torch.from_numpy(self.mean), torch.from_numpy(shifts)
        smoothed = self.space.retract(mean, change)
        # From the chart at the filtered mean into that at the smoothed one.
        moves = _derivative(
            lambda more: self.space.local(smoothed, self.space.retract(mean, change + more)),
            torch.from_numpy(covariances),
        ).numpy()
        return smoothed.numpy(), moves @ covariances @ np.swapaxes(moves, -1, -2)

    def _backward(self, first: int, end: int, last: int, shifts: np.ndarray, covariances: np.ndarray) -> None:
        """Smooth the steps from `end` down to `first` by what was seen until `end`; keep those up to `last`."""
        shift, covariance = np.zeros(shifts.shape[1]), self.covariance[end]
        for k in range(end - 1, first - 1, -1):
            by_next = self.gain[k] @ self.carried[k]
            shift = self.gain[k] @ self.offset[k] + by_next @ shift
            covariance = self.conditional[k] + by_next @ covariance @ by_next.T
            if k <= last:
                shifts[k], covariances[k] = shift, covariance


def _derivative(function: Callable[[Tensor], Tensor], like: Tensor) -> Tensor:
    """(K, n, n) derivatives at zero of a function of tangents (K, n), by central differences."""
    steps = _STEP * torch.eye(like.shape[-1], dtype=like.dtype)
    columns = [function(step.expand(like.shape[:-1])) - function(-step.expand(like.shape[:-1])) for step in steps]
    return torch.stack(columns, dim=-1) / (2.0 * _STEP)
