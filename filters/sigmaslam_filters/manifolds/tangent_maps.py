"""First derivatives of a space's two functions along tangents: closed forms of its own, or by differentiation."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import torch
from torch import Tensor

from sigmaslam_filters.core.transforms import push_forward

if TYPE_CHECKING:
    from sigmaslam_filters.manifolds.spaces import Space


@runtime_checkable
class TangentMaps(Protocol):
    """What a filter with derivatives asks of a space beside `Space`; points and tangents broadcast.

    The manifolds of this package have it in closed form. A space without it is differentiated.
    """

    def push_retract(self, point: Tensor, change: Tensor) -> Tensor:
        """Derivative of v -> point [+] v at v = 0 along tangents: (..., p), (..., n) -> (..., p)."""
        ...

    def push_local(self, point: Tensor, change: Tensor) -> Tensor:
        """Derivative of y -> y [-] point at y = point along changes of the point: (..., p), (..., p) -> (..., n)."""
        ...

    def transport(self, point: Tensor, tangent: Tensor, change: Tensor) -> Tensor:
        """Derivative of u -> (point [+] (v + u)) [-] (point [+] v) at u = 0 along tangents, v the tangent."""
        ...

    def transport_back(self, point: Tensor, tangent: Tensor, change: Tensor) -> Tensor:
        """Inverse of `transport`: derivative of u -> ((point [+] v) [+] u) [-] point, for v of half a turn at most."""
        ...


def tangent_maps(space: "Space") -> TangentMaps:
    """The space's own closed forms, or its derivatives."""
    return space if isinstance(space, TangentMaps) else Differentiated(space)


@dataclass(frozen=True, slots=True)
class Differentiated:
    """`TangentMaps` of any space, by forward differentiation.

    Attributes:
        space: its two functions must be differentiable.
    """

    space: "Space"

    def push_retract(self, point: Tensor, change: Tensor) -> Tensor:
        """See `TangentMaps`."""
        return push_forward(lambda v: self.space.retract(point, v), [torch.zeros_like(change)], [change])[1]

    def push_local(self, point: Tensor, change: Tensor) -> Tensor:
        """See `TangentMaps`."""
        return push_forward(lambda y: self.space.local(point, y), [point + torch.zeros_like(change)], [change])[1]

    def transport(self, point: Tensor, tangent: Tensor, change: Tensor) -> Tensor:
        """See `TangentMaps`."""
        moved = self.space.retract(point, tangent)
        return push_forward(
            lambda u: self.space.local(moved, self.space.retract(point, tangent + u)),
            [torch.zeros_like(change)],
            [change],
        )[1]

    def transport_back(self, point: Tensor, tangent: Tensor, change: Tensor) -> Tensor:
        """See `TangentMaps`."""
        moved = self.space.retract(point, tangent)
        return push_forward(
            lambda u: self.space.local(point, self.space.retract(moved, u)), [torch.zeros_like(change)], [change]
        )[1]
