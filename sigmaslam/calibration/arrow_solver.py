"""Least squares over a chain of states that share some unknowns: block elimination, and the covariances that are used.

The normal equations are block tridiagonal with a border (an arrow), so that they are solved in a time that grows with
the number of states (T. Barfoot: State Estimation for Robotics, sections 3.2 and 9.2).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class Factor:
    """What is known of one state, or of it and the next.

    Attributes:
        state: number of the first state.
        residual: (m,) whitened.
        own, following: (m, n) its derivatives by the state and by the next; None: it is not concerned.
        border: (m, b) by what all share; None: it is not concerned.
        groups: numbers of variance components, with their rows.
    """

    state: int
    residual: np.ndarray
    own: np.ndarray
    following: np.ndarray | None
    border: np.ndarray | None
    groups: tuple[tuple[int, slice], ...]

    def after(self, steps: np.ndarray, shared: np.ndarray) -> np.ndarray:
        """(m,) the residual after steps (N, n) of the states and (b,) of what they share."""
        residual = self.residual + self.own @ steps[self.state]
        if self.following is not None:
            residual = residual + self.following @ steps[self.state + 1]
        return np.asarray(residual if self.border is None else residual + self.border @ shared)


class ArrowSystem:
    """The normal equations of factors.

    Args:
        count: number N of states.
        size: n unknowns of each.
        shared: b unknowns of all.
    """

    def __init__(self, factors: Sequence[Factor], count: int, size: int, shared: int) -> None:
        self._factors, self._size = factors, size
        diagonal, across = np.zeros((count, size, size)), np.zeros((count - 1, size, size))
        # The last column is the right side.
        border, corner = np.zeros((count, size, shared + 1)), np.zeros((shared, shared + 1))
        for each in factors:
            rest = np.zeros((len(each.residual), shared + 1))
            rest[:, -1] = -each.residual
            if each.border is not None:
                rest[:, :-1] = each.border
            k = each.state
            diagonal[k] += each.own.T @ each.own
            border[k] += each.own.T @ rest
            corner += rest[:, :-1].T @ rest
            if each.following is not None:
                diagonal[k + 1] += each.following.T @ each.following
                across[k] += each.own.T @ each.following
                border[k + 1] += each.following.T @ rest
        self._gains = np.empty_like(across)
        self._inverses = np.empty_like(diagonal)
        for k in range(count):
            self._inverses[k] = np.linalg.inv(diagonal[k])
            forward = self._inverses[k] @ border[k]
            corner = corner - border[k][:, :-1].T @ forward
            if k + 1 < count:
                self._gains[k] = self._inverses[k] @ across[k]
                diagonal[k + 1] -= across[k].T @ self._gains[k]
                border[k + 1] -= across[k].T @ forward
            border[k] = forward
        for k in reversed(range(count - 1)):
            border[k] -= self._gains[k] @ border[k + 1]
        # State = by_shared[:, -1] - by_shared[:, :-1] shared.
        self._by_shared = border
        self.shared_covariance = np.linalg.inv(corner[:, :-1])
        self._shared = self.shared_covariance @ corner[:, -1]

    def solve(self) -> tuple[np.ndarray, np.ndarray]:
        """Steps (N, n) of the states, and (b,) of what they share."""
        return self._by_shared[..., -1] - self._by_shared[..., :-1] @ self._shared, self._shared

    def last_covariance(self) -> tuple[np.ndarray, np.ndarray]:
        """Covariances (n, n) of the last state, and (b, b) of what all share."""
        Z = self._by_shared[-1][:, :-1]
        return self._inverses[-1] + Z @ self.shared_covariance @ Z.T, self.shared_covariance

    def spreads(self) -> Iterator[np.ndarray]:
        """For each factor, (m,) the variances that the estimates leave in its residuals."""
        count, n = len(self._inverses), self._size
        conditional = self._inverses.copy()
        for k in reversed(range(count - 1)):
            conditional[k] += self._gains[k] @ conditional[k + 1] @ self._gains[k].T
        for each in self._factors:
            k, J = each.state, each.own
            covariance, Z = conditional[k], self._by_shared[k][:, :-1]
            if each.following is not None:
                J = np.concatenate([J, each.following], axis=1)
                cross = -self._gains[k] @ conditional[k + 1]
                covariance = np.block([[covariance, cross], [cross.T, conditional[k + 1]]])
                Z = self._by_shared[k : k + 2, :, :-1].reshape(2 * n, -1)
            rest = -J @ Z if each.border is None else each.border - J @ Z
            yield np.einsum("ij,jk,ik->i", J, covariance, J) + np.einsum(
                "ij,jk,ik->i", rest, self.shared_covariance, rest
            )
