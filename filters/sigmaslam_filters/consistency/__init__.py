"""Does a filter's covariance describe its errors? The tests, and plots of them in `plots`."""

from sigmaslam_filters.consistency.statistics import (
    LEVELS,
    Consistency,
    Coverage,
    Whiteness,
    check_nees,
    chi_square_band,
    coverage,
    nees,
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
    "whiten",
    "whiteness",
]
