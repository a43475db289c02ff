"""Exponentials and logarithms of SO(3), SE(3) and SE(2), component by component.

Vectors and quaternions are tuples of tensors (...,): a batch is then a plain sum of products, with no small matrices.
A quaternion is (x, y, z, w). Every branch is a torch.where whose unused side is fed a harmless number, so that values
and derivatives are finite everywhere, and to round-off at zero, near it and at half a turn.

The closed forms are those of J. Solà et al., "A micro Lie theory for state estimation in robotics", 2018,
https://arxiv.org/abs/1812.01537, written in half angles.
"""

import math

import torch
from torch import Tensor

Pair = tuple[Tensor, Tensor]
Vector = tuple[Tensor, Tensor, Tensor]
Quaternion = tuple[Tensor, Tensor, Tensor, Tensor]


def wrap_angle(angle: Tensor) -> Tensor:
    """The same angle in (-pi, pi], radians, any shape; one that is there already keeps every digit."""
    turn = 2.0 * math.pi
    wrapped = torch.sub(angle, torch.round(angle / turn), alpha=turn)
    # Round-off of the quotient leaves an ulp on the wrong side.
    wrapped = torch.where(wrapped > math.pi, wrapped - turn, wrapped)
    return torch.where(wrapped <= -math.pi, wrapped + turn, wrapped)


def cross(left: Vector, right: Vector) -> Vector:
    """Cross product."""
    (x, y, z), (a, b, c) = left, right
    return _combine("+-", (y, z), (c, b)), _combine("+-", (z, x), (a, c)), _combine("+-", (x, y), (b, a))


def multiply(left: Quaternion, right: Quaternion) -> Quaternion:
    """Hamilton product: the rotation `right`, then `left`."""
    (x, y, z, w), (a, b, c, d) = left, right
    return (
        _combine("+++-", (w, x, y, z), (a, d, c, b)),
        _combine("+-++", (w, x, y, z), (b, c, d, a)),
        _combine("++-+", (w, x, y, z), (c, b, a, d)),
        _combine("+---", (w, x, y, z), (d, a, b, c)),
    )


def conjugate(quaternion: Quaternion) -> Quaternion:
    """The inverse of a unit quaternion."""
    x, y, z, w = quaternion
    return -x, -y, -z, w


def normalise(quaternion: Quaternion) -> Quaternion:
    """The quaternion at unit length."""
    scale = torch.rsqrt(_combine("++++", quaternion, quaternion))
    x, y, z, w = quaternion
    return x * scale, y * scale, z * scale, w * scale


def rotate(quaternion: Quaternion, vector: Vector) -> Vector:
    """A vector turned by a unit quaternion."""
    x, y, z, w = quaternion
    across = cross((x + x, y + y, z + z), vector)
    twice = cross((x, y, z), across)
    a, b, c = (v + torch.addcmul(t, w, u) for v, t, u in zip(vector, twice, across, strict=True))
    return a, b, c


def plus(left: Vector, right: Vector) -> Vector:
    """Sum of two vectors."""
    return left[0] + right[0], left[1] + right[1], left[2] + right[2]


def exp_so3(rotation: Vector) -> Quaternion:
    """Unit quaternion of a rotation vector."""
    x, y, z = rotation
    cosine, sine, _ = _exp_coefficients(_combine("+++", rotation, rotation))
    return sine * x, sine * y, sine * z, cosine


def log_so3(quaternion: Quaternion) -> Vector:
    """Rotation vector, of length up to pi, of a quaternion of either sign and any length."""
    rotation, _ = _log_so3(quaternion)
    return rotation


def exp_se3(translation: Vector, rotation: Vector) -> tuple[Vector, Quaternion]:
    """Translation and unit quaternion of a twist."""
    x, y, z = rotation
    cosine, sine, third = _exp_coefficients(_combine("+++", rotation, rotation))
    second = 2.0 * (sine * sine)  # (1 - cos(a)) / a^2
    return _apply_v(translation, rotation, second, third), (sine * x, sine * y, sine * z, cosine)


def log_se3(translation: Vector, quaternion: Quaternion) -> tuple[Vector, Vector]:
    """Twist, turning by pi at most, of a translation and a quaternion of either sign and any length."""
    rotation, coefficient = _log_so3(quaternion)
    return _apply_v(translation, rotation, torch.full_like(coefficient, -0.5), coefficient), rotation


def jacobian_so3(rotation: Vector, change: Vector) -> Vector:
    """The left Jacobian J of SO(3) times a vector: Exp(v + u) = Exp(J u) Exp(v) to first order in u.

    The right one is that of the negative rotation vector, for this group and the others.
    """
    _, sine, third = _exp_coefficients(_combine("+++", rotation, rotation))
    return _apply_v(change, rotation, 2.0 * (sine * sine), third)


def inverse_jacobian_so3(rotation: Vector, change: Vector) -> Vector:
    """The inverse of the left Jacobian of SO(3) times a vector, for a rotation of pi at most."""
    _, coefficient = _log_so3(exp_so3(rotation))
    return _apply_v(change, rotation, torch.full_like(coefficient, -0.5), coefficient)


def jacobian_se3(twist: tuple[Vector, Vector], change: tuple[Vector, Vector]) -> tuple[Vector, Vector]:
    """The left Jacobian of SE(3) times a twist, both (translation, rotation)."""
    (translation, rotation), (moved, turned) = twist, change
    _, sine, third = _exp_coefficients(_combine("+++", rotation, rotation))
    second = 2.0 * (sine * sine)
    across = _apply_v(turned, rotation, second, third)
    coupled = _coupling(translation, rotation, turned, across, second, third)
    return plus(_apply_v(moved, rotation, second, third), coupled), across


def inverse_jacobian_se3(twist: tuple[Vector, Vector], change: tuple[Vector, Vector]) -> tuple[Vector, Vector]:
    """The inverse of the left Jacobian of SE(3) times a twist, for a rotation of pi at most."""
    (translation, rotation), (moved, turned) = twist, change
    _, sine, third = _exp_coefficients(_combine("+++", rotation, rotation))
    across = inverse_jacobian_so3(rotation, turned)
    coupled = _coupling(translation, rotation, across, turned, 2.0 * (sine * sine), third)
    x, y, z = (a - b for a, b in zip(moved, coupled, strict=True))
    return inverse_jacobian_so3(rotation, (x, y, z)), across


def turn(sine: Tensor, cosine: Tensor, vector: Pair) -> Pair:
    """A vector of the plane turned by an angle."""
    return _combine("+-", (cosine, sine), vector), _combine("++", (sine, cosine), vector)


def exp_se2(translation: Pair, angle: Tensor) -> Pair:
    """Translation of a twist of the plane; its angle is the twist's own."""
    half = 0.5 * angle
    ratio = _sine_ratio(half)
    return turn(ratio * torch.sin(half), ratio * torch.cos(half), translation)


def log_se2(translation: Pair, angle: Tensor) -> Pair:
    """Translation of the twist that ends there, for an angle of pi at most."""
    half = 0.5 * angle
    return turn(-half, torch.cos(half) / _sine_ratio(half), translation)


def jacobian_se2(twist: tuple[Pair, Tensor], change: tuple[Pair, Tensor]) -> tuple[Pair, Tensor]:
    """The left Jacobian of SE(2) times a twist, both (translation, angle)."""
    (translation, angle), (moved, turned) = twist, change
    a, b = exp_se2(moved, angle)
    c, d = _bend(translation, angle)
    return (a + turned * c, b + turned * d), turned


def inverse_jacobian_se2(twist: tuple[Pair, Tensor], change: tuple[Pair, Tensor]) -> tuple[Pair, Tensor]:
    """The inverse of the left Jacobian of SE(2) times a twist, for an angle of pi at most."""
    (translation, angle), (moved, turned) = twist, change
    c, d = _bend(translation, angle)
    return log_se2((moved[0] - turned * c, moved[1] - turned * d), angle), turned


def quaternion_from_matrix(matrix: Tensor) -> Quaternion:
    """Unit quaternion with w >= 0 of rotation matrices (..., 3, 3).

    The four rows of 4 q q^T are multiples of q; the one with the largest diagonal is at least 2 long.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = (row.unbind(-1) for row in matrix.unbind(-2))
    a, b, c = xy + yx, xz + zx, yz + zy
    d, e, f = zy - yz, xz - zx, yx - xy
    rows = (
        (1.0 + xx - yy - zz, a, b, d),
        (a, 1.0 - xx + yy - zz, c, e),
        (b, c, 1.0 - xx - yy + zz, f),
        (d, e, f, 1.0 + xx + yy + zz),
    )
    products = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
    largest = products.diagonal(dim1=-2, dim2=-1).argmax(dim=-1)
    x, y, z, w = products.take_along_dim(largest[..., None, None], dim=-2).squeeze(-2).unbind(-1)
    sign = _sign(w)
    return normalise((sign * x, sign * y, sign * z, sign * w))


def matrix_from_quaternion(quaternion: Quaternion) -> Tensor:
    """Rotation matrices (..., 3, 3) of unit quaternions."""
    x, y, z, w = quaternion
    x2, y2, z2 = x + x, y + y, z + z
    rows = (
        (1.0 - (y * y2 + z * z2), x * y2 - w * z2, x * z2 + w * y2),
        (x * y2 + w * z2, 1.0 - (x * x2 + z * z2), y * z2 - w * x2),
        (x * z2 - w * y2, y * z2 + w * x2, 1.0 - (x * x2 + y * y2)),
    )
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def _combine(signs: str, left: tuple[Tensor, ...], right: tuple[Tensor, ...]) -> Tensor:
    """Sum of products with the given signs, the first +; half the passes over memory of separate sums."""
    total = left[0] * right[0]
    for sign, a, b in zip(signs[1:], left[1:], right[1:], strict=True):
        total = torch.addcmul(total, a, b, value=1 if sign == "+" else -1)
    return total


def _sign(number: Tensor) -> Tensor:
    """1 or -1, never 0 (unlike torch.sign)."""
    return torch.copysign(torch.ones_like(number), number)


def _apply_v(vector: Vector, rotation: Vector, second: Tensor, third: Tensor) -> Vector:
    """V v, with V = I + second K + third K^2 and K the cross-product matrix of the rotation."""
    once = cross(rotation, vector)
    twice = cross(rotation, once)
    x, y, z = (
        torch.addcmul(torch.addcmul(v, second, a), third, b) for v, a, b in zip(vector, once, twice, strict=True)
    )
    return x, y, z


def _coupling(
    translation: Vector, rotation: Vector, turned: Vector, across: Vector, second: Tensor, third: Tensor
) -> Vector:
    """What a change of rotation does to the translation: d(V t) - (J u) x V t, with `across` = J u of `turned` = u."""
    slope_second, slope_third = _slopes(_combine("+++", rotation, rotation), second, third)
    once = cross(rotation, translation)
    twice = cross(rotation, once)
    spin = cross(turned, translation)
    both = plus(cross(rotation, spin), cross(turned, once))
    end = _apply_v(translation, rotation, second, third)
    away = cross(across, end)
    along = 2.0 * _combine("+++", rotation, turned)  # change of the squared angle
    first, last = along * slope_second, along * slope_third
    x, y, z = (
        second * a + third * b + first * c + last * d - e
        for a, b, c, d, e in zip(spin, both, once, twice, away, strict=True)
    )
    return x, y, z


def _bend(translation: Pair, angle: Tensor) -> Pair:
    """(I - W) / a times a vector, of W that makes the translation of a twist of the plane."""
    _, sine, third = _exp_coefficients(angle * angle)
    return turn(-2.0 * (sine * sine), angle * third, translation)


# Series have four terms. They end where the first one left out is half a unit of round-off, and no sooner, because the
# derivatives of the closed forms lose digits long before the closed forms do. A clamp whose bound lies well inside the
# other branch keeps the unused side finite. Numbers start sums only: `1.0 - tensor` takes twice as long.


def _exp_coefficients(squared: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """cos(a/2), sin(a/2)/a and (a - sin(a))/a^3 from a^2."""
    square = 0.25 * squared  # of the half angle h
    limit = (1.2e6 * torch.finfo(squared.dtype).eps) ** 0.25
    small = square < limit
    y = square.clamp_max(2.0 * limit)
    even = -1 / 2 + y * (1 / 24 + y * (-1 / 720 + y * (1 / 40320)))  # (cos(h) - 1) / h^2
    odd = -1 / 6 + y * (1 / 120 + y * (-1 / 5040 + y * (1 / 362880)))  # (sin(h) - h) / h^3
    product = y * odd
    large = square.clamp_min(0.5 * limit)
    half = torch.sqrt(large)
    cosine = torch.where(small, 1.0 + y * even, torch.cos(half))
    sine = 0.5 * torch.where(small, 1.0 + product, torch.sin(half) / half)
    third = torch.where(small, even + odd + even * product, (sine * cosine - 0.5) / (0.5 * large))
    return cosine, sine, -0.25 * third


def _slopes(squared: Tensor, second: Tensor, third: Tensor) -> tuple[Tensor, Tensor]:
    """Derivatives of (1 - cos(a)) / a^2 and (a - sin(a)) / a^3 by a^2, from a^2 and the two.

    Six terms end at round-off in float64 for a^2 below 1/4, from where on the closed forms lose two digits at most.
    """
    small = squared < 0.25
    y = squared.clamp_max(0.5)
    series_second = torch.zeros_like(y)
    series_third = torch.zeros_like(y)
    for k in range(6, 0, -1):
        series_second = series_second * y + (-1) ** k * k / math.factorial(2 * k + 2)
        series_third = series_third * y + (-1) ** k * k / math.factorial(2 * k + 3)
    large = squared.clamp_min(0.125)
    # sin(a) / a is 1 - a^2 times the third coefficient.
    closed_second = (1.0 - squared * third - 2.0 * second) / (2.0 * large)
    closed_third = (second - 3.0 * third) / (2.0 * large)
    return torch.where(small, series_second, closed_second), torch.where(small, series_third, closed_third)


def _log_so3(quaternion: Quaternion) -> tuple[Vector, Tensor]:
    """Rotation vector, and (1 - a/2 cot(a/2)) / a^2 of its length a."""
    x, y, z, w = quaternion
    sign = _sign(w)
    cosine = sign * w
    squared = _combine("+++", (x, y, z), (x, y, z))
    small = squared < (1.8 * torch.finfo(w.dtype).eps) ** 0.25 * (cosine * cosine)
    safe_cosine = torch.where(small, cosine, 1.0)
    u = squared / (safe_cosine * safe_cosine)  # squared tangent of the half angle
    lag = 1 / 3 + u * (-1 / 5 + u * (1 / 7 + u * (-1 / 9)))  # (1 - atan(t)/t) / t^2
    ratio = 1.0 + u * -lag  # atan(t)/t
    sine = torch.sqrt(torch.where(small, 1.0, squared))
    half = torch.atan2(sine, cosine)
    halves = torch.where(small, ratio / safe_cosine, half / sine)
    quarter = torch.where(small, lag / (ratio * ratio), (1.0 + cosine * -halves) / (half * half))
    stretch = 2.0 * sign * halves
    return (stretch * x, stretch * y, stretch * z), 0.25 * quarter


def _sine_ratio(angle: Tensor) -> Tensor:
    """sin(a) / a."""
    square = angle * angle
    limit = (1.8e5 * torch.finfo(angle.dtype).eps) ** 0.25
    y = square.clamp_max(2.0 * limit)
    series = 1.0 + y * (-1 / 6 + y * (1 / 120 + y * (-1 / 5040)))
    size = torch.sqrt(square.clamp_min(0.5 * limit))
    return torch.where(square < limit, series, torch.sin(size) / size)
