"""Spaces that states and measurements live in: R^n, angles, rotations, rigid motions, and products of them.

A manifold is two functions and two sizes. Points and tangents are flat vectors with any leading dimensions:

| Manifold      | Point (..., p)                                  | Tangent (..., n)                   |
|---------------|-------------------------------------------------|------------------------------------|
| Euclidean(n)  | the vector                                      | the difference                     |
| SO2           | angle in (-pi, pi]                              | angle                              |
| SE2           | x, y, angle in (-pi, pi]                        | x, y, angle                        |
| SO3           | unit quaternion x, y, z, w                      | rotation vector                    |
| SE3           | translation, unit quaternion x, y, z, w         | translation, rotation vector       |
| Product(...)  | the points of its parts, end to end             | their tangents, end to end         |

Functions are differentiable everywhere, and go through torch.func, vmap and torch.compile. Sizes that do not fit raise
ValueError; arguments are never changed.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from sigmaslam_filters.core.layout import concatenate, stack
from sigmaslam_filters.manifolds import lie_groups
from sigmaslam_filters.manifolds.lie_groups import Quaternion, Vector, plus
from sigmaslam_filters.manifolds.tangent_maps import TangentMaps, tangent_maps


class Space(Protocol):
    """What a filter asks of a space: two functions and two sizes. A `Manifold` is one, and so is any such object."""

    @property
    def point_size(self) -> int:
        """Length p of a point."""
        ...

    @property
    def tangent_size(self) -> int:
        """Length n of a tangent."""
        ...

    def retract(self, point: Tensor, tangent: Tensor) -> Tensor:
        """The point that a tangent leads to, point [+] tangent: (..., p), (..., n) -> (..., p)."""
        ...

    def local(self, point: Tensor, other: Tensor) -> Tensor:
        """The shortest tangent that leads to another point, other [-] point: (..., p), (..., p) -> (..., n)."""
        ...


def is_flat(space: Space | None) -> bool:
    """Whether retract is addition and local is subtraction: in R^n, and where a space says so."""
    return space is None or bool(getattr(space, "flat", False))


class Manifold(ABC):
    """A space with a tangent space at each point, whose arguments' sizes are checked.

    Subclasses implement `_retract` and `_local`, which may rely on the sizes of their arguments. With an attribute
    `parallel` that is true a filter carries covariances from one point to another as they are, as invariant ones do.
    """

    @property
    @abstractmethod
    def point_size(self) -> int:
        """Length p of a point."""

    @property
    @abstractmethod
    def tangent_size(self) -> int:
        """Length n of a tangent."""

    @property
    def flat(self) -> bool:
        """Whether retract is addition and local is subtraction."""
        return False

    def retract(self, point: Tensor, tangent: Tensor) -> Tensor:
        """The point that a tangent leads to, point [+] tangent: (..., p), (..., n) -> (..., p)."""
        self._check("point", point, self.point_size)
        self._check("tangent", tangent, self.tangent_size)
        return self._retract(point, tangent)

    def local(self, point: Tensor, other: Tensor) -> Tensor:
        """The shortest tangent that leads to another point, other [-] point: (..., p), (..., p) -> (..., n)."""
        self._check("point", point, self.point_size)
        self._check("other", other, self.point_size)
        return self._local(point, other)

    @abstractmethod
    def _retract(self, point: Tensor, tangent: Tensor) -> Tensor: ...

    @abstractmethod
    def _local(self, point: Tensor, other: Tensor) -> Tensor: ...

    def _check(self, name: str, vector: Tensor, size: int) -> None:
        if vector.shape[-1:] != (size,):
            raise ValueError(
                f"{self}: {name} must have shape (..., {size}), got {tuple(vector.shape)}; "
                f"points have {self.point_size} numbers and tangents {self.tangent_size}"
            )


class _Additive(Manifold):
    """A space whose tangents add up, but for whole turns."""

    def push_retract(self, point: Tensor, change: Tensor) -> Tensor:
        """See `TangentMaps`; so the others."""
        return change

    def push_local(self, point: Tensor, change: Tensor) -> Tensor:
        """See `TangentMaps`."""
        return change

    def transport(self, point: Tensor, tangent: Tensor, change: Tensor) -> Tensor:
        """See `TangentMaps`."""
        return change

    def transport_back(self, point: Tensor, tangent: Tensor, change: Tensor) -> Tensor:
        """See `TangentMaps`."""
        return change


@dataclass(frozen=True)
class Euclidean(_Additive):
    """R^n: retract adds, local subtracts.

    Attributes:
        size: n.
    """

    size: int

    flat = True

    @property
    def point_size(self) -> int:
        """Length of a point."""
        return self.size

    @property
    def tangent_size(self) -> int:
        """Length of a tangent."""
        return self.size

    def _retract(self, point: Tensor, tangent: Tensor) -> Tensor:
        return point + tangent

    def _local(self, point: Tensor, other: Tensor) -> Tensor:
        return other - point


@dataclass(frozen=True)
class SO2(_Additive):
    """Angles, radians in (-pi, pi]."""

    point_size, tangent_size = 1, 1

    def _retract(self, point: Tensor, tangent: Tensor) -> Tensor:
        return lie_groups.wrap_angle(point + tangent)

    def _local(self, point: Tensor, other: Tensor) -> Tensor:
        return lie_groups.wrap_angle(other - point)


@dataclass(frozen=True)
class LieGroup(Manifold):
    """A group whose points are composed: what SE2, SO3 and SE3 have in common.

    Attributes:
        side: "right", point * Exp(v), where v is seen from the moving frame; or "left", Exp(v) * point, from the fixed.
    """

    side: str = "right"

    def __post_init__(self) -> None:
        if self.side not in ("left", "right"):
            raise ValueError(
                f'{type(self).__name__}: side must be "right" (point * Exp(tangent)) or "left" (Exp(tangent) * point), '
                f"got {self.side!r}"
            )

    def transport(self, point: Tensor, tangent: Tensor, change: Tensor) -> Tensor:
        """The group's Jacobian; see `TangentMaps`."""
        return self._jacobian(self._sided(tangent), change)

    def transport_back(self, point: Tensor, tangent: Tensor, change: Tensor) -> Tensor:
        """The inverse of the group's Jacobian; see `TangentMaps`."""
        return self._inverse_jacobian(self._sided(tangent), change)

    @abstractmethod
    def _jacobian(self, tangent: Tensor, change: Tensor) -> Tensor:
        """The left Jacobian of the group times a tangent."""

    @abstractmethod
    def _inverse_jacobian(self, tangent: Tensor, change: Tensor) -> Tensor:
        """Its inverse."""

    def _sided(self, tangent: Tensor) -> Tensor:
        """The right Jacobian is the left one of the inverse."""
        return -tangent if self.side == "right" else tangent


@dataclass(frozen=True)
class SE2(LieGroup):
    """Rigid motions of the plane: points (..., 3) are x, y, angle, tangents (..., 3) twists in the same order."""

    point_size, tangent_size = 3, 3

    def _retract(self, point: Tensor, tangent: Tensor) -> Tensor:
        x, y, angle = point.unbind(-1)
        u, v, added = tangent.unbind(-1)
        a, b = lie_groups.exp_se2((u, v), added)
        if self.side == "right":
            a, b = lie_groups.turn(torch.sin(angle), torch.cos(angle), (a, b))
        else:
            x, y = lie_groups.turn(torch.sin(added), torch.cos(added), (x, y))
        return stack([x + a, y + b, lie_groups.wrap_angle(angle + added)])

    def _local(self, point: Tensor, other: Tensor) -> Tensor:
        x, y, angle = point.unbind(-1)
        a, b, other_angle = other.unbind(-1)
        between = lie_groups.wrap_angle(other_angle - angle)
        if self.side == "right":
            step = lie_groups.turn(-torch.sin(angle), torch.cos(angle), (a - x, b - y))
        else:
            x, y = lie_groups.turn(torch.sin(between), torch.cos(between), (x, y))
            step = (a - x, b - y)
        return stack([*lie_groups.log_se2(step, between), between])

    def push_retract(self, point: Tensor, change: Tensor) -> Tensor:
        """See `TangentMaps`."""
        x, y, angle = point.unbind(-1)
        u, v, added = change.unbind(-1)
        if self.side == "right":
            return stack([*lie_groups.turn(torch.sin(angle), torch.cos(angle), (u, v)), added])
        return stack([u - y * added, v + x * added, added])

    def push_local(self, point: Tensor, change: Tensor) -> Tensor:
        """See `TangentMaps`."""
        x, y, angle = point.unbind(-1)
        a, b, added = change.unbind(-1)
        if self.side == "right":
            return stack([*lie_groups.turn(-torch.sin(angle), torch.cos(angle), (a, b)), added])
        return stack([a + y * added, b - x * added, added])

    def _jacobian(self, tangent: Tensor, change: Tensor) -> Tensor:
        moved, turned = lie_groups.jacobian_se2(_planar(tangent), _planar(change))
        return stack([*moved, turned])

    def _inverse_jacobian(self, tangent: Tensor, change: Tensor) -> Tensor:
        moved, turned = lie_groups.inverse_jacobian_se2(_planar(tangent), _planar(change))
        return stack([*moved, turned])

    def from_matrix(self, matrix: Tensor) -> Tensor:
        """Points (..., 3) of homogeneous matrices (..., 3, 3)."""
        _check_matrix(self, matrix, 3)
        angle = torch.atan2(matrix[..., 1, 0], matrix[..., 0, 0])
        return stack([matrix[..., 0, 2], matrix[..., 1, 2], lie_groups.wrap_angle(angle)])

    def to_matrix(self, point: Tensor) -> Tensor:
        """Homogeneous matrices (..., 3, 3) of points (..., 3)."""
        self._check("point", point, self.point_size)
        x, y, angle = point.unbind(-1)
        sine, cosine = torch.sin(angle), torch.cos(angle)
        rotation = torch.stack([torch.stack([cosine, -sine], dim=-1), torch.stack([sine, cosine], dim=-1)], dim=-2)
        return _homogeneous(rotation, torch.stack([x, y], dim=-1))


@dataclass(frozen=True)
class SO3(LieGroup):
    """Rotations: points (..., 4) are unit quaternions x, y, z, w of either sign, tangents (..., 3) rotation vectors."""

    point_size, tangent_size = 4, 3

    def _retract(self, point: Tensor, tangent: Tensor) -> Tensor:
        added = lie_groups.exp_so3(_vector(tangent))
        return stack(lie_groups.normalise(_product(self.side, _quaternion(point), added)))

    def _local(self, point: Tensor, other: Tensor) -> Tensor:
        return stack(
            lie_groups.log_so3(_product(self.side, lie_groups.conjugate(_quaternion(point)), _quaternion(other)))
        )

    def push_retract(self, point: Tensor, change: Tensor) -> Tensor:
        """See `TangentMaps`."""
        return stack(_turned(self.side, _quaternion(point), _vector(change)))

    def push_local(self, point: Tensor, change: Tensor) -> Tensor:
        """See `TangentMaps`."""
        return stack(_turning(self.side, _quaternion(point), _quaternion(change)))

    def _jacobian(self, tangent: Tensor, change: Tensor) -> Tensor:
        return stack(lie_groups.jacobian_so3(_vector(tangent), _vector(change)))

    def _inverse_jacobian(self, tangent: Tensor, change: Tensor) -> Tensor:
        return stack(lie_groups.inverse_jacobian_so3(_vector(tangent), _vector(change)))

    def from_matrix(self, matrix: Tensor) -> Tensor:
        """Points (..., 4), with w >= 0, of rotation matrices (..., 3, 3)."""
        _check_matrix(self, matrix, 3)
        return stack(lie_groups.quaternion_from_matrix(matrix))

    def to_matrix(self, point: Tensor) -> Tensor:
        """Rotation matrices (..., 3, 3) of points (..., 4)."""
        self._check("point", point, self.point_size)
        return lie_groups.matrix_from_quaternion(_quaternion(point))


@dataclass(frozen=True)
class SE3(LieGroup):
    """Rigid motions: points (..., 7) are translation and unit quaternion x, y, z, w, tangents (..., 6) twists.

    A twist is (translation, rotation), and what it leads to is the exponential of the group, so its translation bends
    with its rotation.
    """

    point_size, tangent_size = 7, 6

    def _retract(self, point: Tensor, tangent: Tensor) -> Tensor:
        start, turned = _rigid(point)
        step, added = lie_groups.exp_se3(*_twist(tangent))
        if self.side == "right":
            step = lie_groups.rotate(turned, step)
        else:
            start = lie_groups.rotate(added, start)
        translation = [a + b for a, b in zip(start, step, strict=True)]
        return stack([*translation, *lie_groups.normalise(_product(self.side, turned, added))])

    def _local(self, point: Tensor, other: Tensor) -> Tensor:
        (start, turned), (end, other_turned) = _rigid(point), _rigid(other)
        back = lie_groups.conjugate(turned)
        between = _product(self.side, back, other_turned)
        if self.side == "right":
            step = lie_groups.rotate(back, _difference(end, start))
        else:
            step = _difference(end, lie_groups.rotate(between, start))
        translation, rotation = lie_groups.log_se3(step, between)
        return stack([*translation, *rotation])

    def push_retract(self, point: Tensor, change: Tensor) -> Tensor:
        """See `TangentMaps`."""
        (start, turned), (moved, added) = _rigid(point), _twist(change)
        step = lie_groups.rotate(turned, moved) if self.side == "right" else plus(moved, lie_groups.cross(added, start))
        return stack([*step, *_turned(self.side, turned, added)])

    def push_local(self, point: Tensor, change: Tensor) -> Tensor:
        """See `TangentMaps`."""
        (start, turned), (moved, spun) = _rigid(point), _rigid(change)
        rotation = _turning(self.side, turned, spun)
        if self.side == "right":
            step = lie_groups.rotate(lie_groups.conjugate(turned), moved)
        else:
            step = _difference(moved, lie_groups.cross(rotation, start))
        return stack([*step, *rotation])

    def _jacobian(self, tangent: Tensor, change: Tensor) -> Tensor:
        moved, turned = lie_groups.jacobian_se3(_twist(tangent), _twist(change))
        return stack([*moved, *turned])

    def _inverse_jacobian(self, tangent: Tensor, change: Tensor) -> Tensor:
        moved, turned = lie_groups.inverse_jacobian_se3(_twist(tangent), _twist(change))
        return stack([*moved, *turned])

    def from_matrix(self, matrix: Tensor) -> Tensor:
        """Points (..., 7), with w >= 0, of homogeneous matrices (..., 4, 4)."""
        _check_matrix(self, matrix, 4)
        quaternion = lie_groups.quaternion_from_matrix(matrix[..., :3, :3])
        return stack([*matrix[..., :3, 3].unbind(-1), *quaternion])

    def to_matrix(self, point: Tensor) -> Tensor:
        """Homogeneous matrices (..., 4, 4) of points (..., 7)."""
        self._check("point", point, self.point_size)
        _, quaternion = _rigid(point)
        return _homogeneous(lie_groups.matrix_from_quaternion(quaternion), point[..., :3])


@dataclass(frozen=True, init=False)
class Product(Manifold):
    """Several manifolds side by side, `Product(SE3(), Euclidean(6))`.

    Attributes:
        parts: the manifolds, in the order in which their points and tangents lie end to end.
    """

    parts: tuple[Manifold, ...]

    def __init__(self, *parts: Manifold) -> None:
        if not parts:
            raise ValueError("Product: give at least one manifold")
        object.__setattr__(self, "parts", parts)

    def __repr__(self) -> str:
        return f"Product({', '.join(map(repr, self.parts))})"

    @property
    def point_size(self) -> int:
        """Length of a point, the sum over the parts."""
        return sum(part.point_size for part in self.parts)

    @property
    def tangent_size(self) -> int:
        """Length of a tangent, the sum over the parts."""
        return sum(part.tangent_size for part in self.parts)

    @property
    def flat(self) -> bool:
        """Whether every part is flat."""
        return all(part.flat for part in self.parts)

    def _retract(self, point: Tensor, tangent: Tensor) -> Tensor:
        if self.flat:
            return point + tangent
        pieces = zip(self.parts, self._points(point), self._tangents(tangent), strict=True)
        return concatenate([part.retract(x, v) for part, x, v in pieces])

    def _local(self, point: Tensor, other: Tensor) -> Tensor:
        if self.flat:
            return other - point
        pieces = zip(self.parts, self._points(point), self._points(other), strict=True)
        return concatenate([part.local(x, y) for part, x, y in pieces])

    def push_retract(self, point: Tensor, change: Tensor) -> Tensor:
        """See `TangentMaps`."""
        pieces = zip(self._maps, self._points(point), self._tangents(change), strict=True)
        return concatenate([part.push_retract(x, u) for part, x, u in pieces])

    def push_local(self, point: Tensor, change: Tensor) -> Tensor:
        """See `TangentMaps`."""
        pieces = zip(self._maps, self._points(point), self._points(change), strict=True)
        return concatenate([part.push_local(x, y) for part, x, y in pieces])

    def transport(self, point: Tensor, tangent: Tensor, change: Tensor) -> Tensor:
        """See `TangentMaps`."""
        pieces = zip(self._maps, self._points(point), self._tangents(tangent), self._tangents(change), strict=True)
        return concatenate([part.transport(x, v, u) for part, x, v, u in pieces])

    def transport_back(self, point: Tensor, tangent: Tensor, change: Tensor) -> Tensor:
        """See `TangentMaps`."""
        pieces = zip(self._maps, self._points(point), self._tangents(tangent), self._tangents(change), strict=True)
        return concatenate([part.transport_back(x, v, u) for part, x, v, u in pieces])

    @property
    def _maps(self) -> list[TangentMaps]:
        return [tangent_maps(part) for part in self.parts]

    def _points(self, point: Tensor) -> tuple[Tensor, ...]:
        return point.split([part.point_size for part in self.parts], dim=-1)

    def _tangents(self, tangent: Tensor) -> tuple[Tensor, ...]:
        return tangent.split([part.tangent_size for part in self.parts], dim=-1)


def _check_matrix(manifold: Manifold, matrix: Tensor, size: int) -> None:
    if matrix.shape[-2:] != (size, size):
        raise ValueError(f"{manifold}: matrix must have shape (..., {size}, {size}), got {tuple(matrix.shape)}")


def _turned(side: str, point: Quaternion, change: Vector) -> Quaternion:
    """Change of a quaternion that is turned by a small rotation vector on the given side."""
    x, y, z = (0.5 * each for each in change)
    return _product(side, point, (x, y, z, torch.zeros_like(x)))


def _turning(side: str, point: Quaternion, change: Quaternion) -> Vector:
    """The small rotation vector, on the given side, of a change of a quaternion (of any length)."""
    x, y, z, _ = _product(side, lie_groups.conjugate(point), change)
    a, b, c, d = point
    scale = 2.0 / (a * a + b * b + c * c + d * d)
    return scale * x, scale * y, scale * z


def _planar(tangent: Tensor) -> tuple[lie_groups.Pair, Tensor]:
    u, v, angle = tangent.unbind(-1)
    return (u, v), angle


def _vector(tangent: Tensor) -> Vector:
    x, y, z = tangent.unbind(-1)
    return x, y, z


def _quaternion(point: Tensor) -> Quaternion:
    x, y, z, w = point.unbind(-1)
    return x, y, z, w


def _twist(tangent: Tensor) -> tuple[Vector, Vector]:
    u, v, w, x, y, z = tangent.unbind(-1)
    return (u, v, w), (x, y, z)


def _rigid(point: Tensor) -> tuple[Vector, Quaternion]:
    a, b, c, x, y, z, w = point.unbind(-1)
    return (a, b, c), (x, y, z, w)


def _difference(end: Vector, start: Vector) -> Vector:
    return end[0] - start[0], end[1] - start[1], end[2] - start[2]


def _product(side: str, point: Quaternion, added: Quaternion) -> Quaternion:
    """The rotation added on the given side of the point."""
    return lie_groups.multiply(point, added) if side == "right" else lie_groups.multiply(added, point)


def _homogeneous(rotation: Tensor, translation: Tensor) -> Tensor:
    """Rotations (..., d, d) and translations (..., d) into matrices (..., d + 1, d + 1)."""
    upper = torch.cat([rotation, translation.unsqueeze(-1)], dim=-1)
    last = torch.zeros_like(upper[..., :1, :])
    last = torch.cat([last[..., :-1], torch.ones_like(last[..., -1:])], dim=-1)
    return torch.cat([upper, last], dim=-2)
