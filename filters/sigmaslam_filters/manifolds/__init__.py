"""Spaces that states live in (`spaces`), and exponentials and logarithms of rotations and rigid motions."""

from sigmaslam_filters.manifolds.lie_groups import wrap_angle
from sigmaslam_filters.manifolds.spaces import (
    SE2,
    SE3,
    SO2,
    SO3,
    Euclidean,
    LieGroup,
    Manifold,
    Product,
    Space,
    is_flat,
)

__all__ = ["SE2", "SE3", "SO2", "SO3", "Euclidean", "LieGroup", "Manifold", "Product", "Space", "is_flat", "wrap_angle"]
