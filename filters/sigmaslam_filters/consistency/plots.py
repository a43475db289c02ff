"""Figures of `sigmaslam_filters.consistency.statistics`; save them with `Figure.savefig`."""

from collections.abc import Sequence

import numpy as np
from torch import Tensor

from sigmaslam_filters.consistency.statistics import Consistency, Coverage, Whiteness

try:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
except ImportError as error:
    raise ImportError("matplotlib is not installed: pip install matplotlib for the pictures") from error

# Of Okabe and Ito's palette, which people with colour-blindness can tell apart.
BLUE, VERMILLION, GREEN, PURPLE, GREY = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#8C8C8C"

# A mean beyond this multiple of the band flattens it on a linear axis.
_LINEAR_UP_TO = 5.0


def plot_nees(check: Consistency, seconds: Tensor | None = None, quantity: str = "NEES") -> Figure:
    """Mean NEES (or NIS) of each step with the band of a consistent filter.

    Args:
        check: from `check_nees`.
        seconds: (steps,) time of each step, seconds; without it the axis counts steps.
        quantity: what the values are, for the axis and the legend.
    Raises:
        ValueError: seconds are not (steps,).
    """
    mean = _to_numpy(check.mean_per_step)
    expected, low, high = (_to_numpy(values) for values in (check.expected_per_step, check.low, check.high))
    at = np.arange(len(mean)) if seconds is None else _to_numpy(seconds)
    if at.shape != mean.shape:
        raise ValueError(f"seconds must be ({len(mean)},), one a step, not {at.shape}")
    title = f"{quantity} per degree of freedom {check.normalised_mean:.3g}, {_percent(check.share_inside)} inside"
    if check.nan_count:
        title += f", {check.nan_count} NaN left out"
    figure, axes = _figure((8, 3.2), "step" if seconds is None else "time [s]", quantity, title)
    edges = _band(axes, at, low, high, f"{_percent(check.probability)}, {check.runs} run(s)")
    axes.plot(edges, np.repeat(expected, 2), color=GREEN, lw=1, label="expected")
    marker = "." if len(mean) < 60 or not np.isfinite(mean).all() else ""
    axes.plot(at, mean, color=BLUE, lw=1.2, marker=marker, ms=4, label=f"mean {quantity}")
    if (mean > _LINEAR_UP_TO * high).any() and not (mean <= 0).any():
        axes.set_yscale("log")
    axes.legend(fontsize=8)
    return figure


def plot_whiteness(whiteness: Whiteness) -> Figure:
    """Autocorrelation of the innovations at each lag with the band of white noise."""
    correlation, band = _to_numpy(whiteness.autocorrelation), _to_numpy(whiteness.band)
    lags = np.arange(1, len(correlation) + 1)
    title = f"White noise: p {whiteness.p_value:.2g}, {_percent(whiteness.share_inside)} inside"
    figure, axes = _figure((8, 3.2), "lag [steps]", "autocorrelation", title)
    _band(axes, lags, -band, band, _percent(whiteness.probability))
    axes.plot(lags, correlation, color=BLUE, marker="o", ms=4, label="innovations")
    axes.legend(fontsize=8)
    return figure


def plot_coverage(coverage: Coverage, labels: Sequence[str] | None = None, title: str = "") -> Figure:
    """Share of errors inside each region against the share that should be; below the diagonal is overconfident.

    Args:
        coverage: from the function of that name.
        labels: one a row of shares: n by axis, else one.
        title: over the figure.
    Raises:
        ValueError: the number of labels does not fit.
    """
    level = _to_numpy(coverage.level)
    share, low, high = (np.atleast_2d(_to_numpy(values)) for values in (coverage.share, coverage.low, coverage.high))
    if labels is None:
        labels = ["errors"] if len(share) == 1 else [f"axis {axis}" for axis in range(len(share))]
    if len(labels) != len(share):
        raise ValueError(f"labels must be {len(share)}, one a row of shares, not {len(labels)}")
    figure, axes = _figure((5.5, 5), "nominal", "share of errors inside", title)
    axes.set_prop_cycle(color=[BLUE, VERMILLION, GREEN, PURPLE])
    axes.plot([0, 1], [0, 1], color=GREY, lw=1, label="consistent (below: overconfident)")
    for inside, below, above, label in zip(share, share - low, high - share, labels, strict=True):
        reach = np.stack([below, above]).clip(min=0)
        axes.errorbar(level, inside, reach, marker="o", ms=4, lw=1.2, capsize=3, label=label)
    axes.legend(fontsize=8)
    return figure


def _figure(size: tuple[float, float], across: str, up: str, title: str) -> tuple[Figure, Axes]:
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.add_subplot(xlabel=across, ylabel=up)
    axes.set_title(title, fontsize=10)
    axes.grid(True, color="#D9D9D9", lw=0.6)
    return figure, axes


def _band(axes: Axes, at: np.ndarray, low: np.ndarray, high: np.ndarray, name: str) -> np.ndarray:
    """Draws the band; returns beginning and end of each step, halfway to its neighbours, (2 steps,)."""
    # Each step has a width, so that one between two without a value is seen as well.
    between = (at[1:] + at[:-1]) / 2
    first, last = (2 * at[0] - between[0], 2 * at[-1] - between[-1]) if len(at) > 1 else (at[0] - 0.5, at[0] + 0.5)
    edges = np.stack([np.append(first, between), np.append(between, last)], axis=-1).ravel()
    axes.fill_between(
        edges, np.repeat(low, 2), np.repeat(high, 2), color=GREEN, alpha=0.25, lw=0, label=f"band, {name}"
    )
    return edges


def _percent(share: float) -> str:
    return f"{round(100 * share, 1):g} %"


def _to_numpy(values: Tensor) -> np.ndarray:
    return np.asarray(values.detach().cpu().double())
