"""Does a filter's covariance describe its errors?"""

from sigmaslam_filters.consistency.statistics import (
    LEVELS,
    Consistency,
    Coverage,
    Whiteness,
    check_nees,
    chi_square_band,
    coverage,
    nees,
    nis,
    whiten,
    whiteness,
)

__all__ = [
    "LEVELS",
    "Consistency",
    "Coverage",
    "Whiteness",
    "check_nees",
    "chi_square_band",
    "coverage",
    "nees",
    "nis",
    "whiten",
    "whiteness",
]
