"""Figures of `sigmaslam_filters.consistency.statistics`; save them with `Figure.savefig`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from torch import Tensor

from sigmaslam_filters.consistency.statistics import Consistency, Coverage, Whiteness

try:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, StrMethodFormatter
except ImportError as error:
    raise ImportError("matplotlib is not installed: pip install matplotlib for the pictures") from error

# Okabe and Ito's palette, which people with colour-blindness can tell apart.
BLUE, VERMILLION, GREEN, PURPLE, GREY = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#8C8C8C"
SERIES = (BLUE, VERMILLION, GREEN, PURPLE)

# A mean beyond this multiple of the band flattens it on a linear axis.
_LINEAR_UP_TO = 5.0


def plot_nees(
    check: Consistency, seconds: Tensor | None = None, quantity: str = "NEES", title: str | None = None
) -> Figure:
    """Mean NEES (or NIS) of each step with the band of a consistent filter.

    Args:
        check: from `check_nees`.
        seconds: (steps,) time of each step, seconds; without it the axis counts steps.
        quantity: what the values are, for the axis and the legend.
        title: instead of the summary.
    Raises:
        ValueError: seconds are not (steps,).
    """
    mean = _to_numpy(check.mean_per_step)
    expected, low, high = (_to_numpy(values) for values in (check.expected_per_step, check.low, check.high))
    at = np.arange(len(mean)) if seconds is None else _to_numpy(seconds)
    if at.shape != mean.shape:
        raise ValueError(f"seconds must be ({len(mean)},), one a step, not {at.shape}")
    if title is None:
        ratio_low, ratio_high = check.normalised_interval
        title = f"{quantity} per degree of freedom {check.normalised_mean:.3g}"
        if np.isfinite(ratio_low):
            title += f" ({ratio_low:.3g} to {ratio_high:.3g})"
        title += f"; {_percent(check.share_inside)} of the steps inside"
        if check.nan_count:
            title += f"; {check.nan_count} NaN left out"
    figure, axes = _figure((8, 3.2), "step" if seconds is None else "time [s]", quantity, title)
    band = f"{_percent(check.probability)} band, {check.runs} run{'s' if check.runs > 1 else ''}"
    # Each step has a width, so that one between two without a value is seen as well.
    edges = _edges(at)
    axes.fill_between(edges, np.repeat(low, 2), np.repeat(high, 2), color=GREEN, alpha=0.25, lw=0, label=band)
    axes.plot(edges, np.repeat(expected, 2), color=GREEN, lw=1, label="expected")
    marker = "." if len(mean) < 60 or not np.isfinite(mean).all() else ""
    axes.plot(at, mean, color=BLUE, lw=1.2, marker=marker, ms=4, label=f"mean {quantity}")
    if (mean > _LINEAR_UP_TO * high).any() and not (mean <= 0).any():
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.yaxis.set_minor_formatter(NullFormatter())
    if seconds is None:
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.margins(x=0.01)
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    return figure


def plot_whiteness(whiteness: Whiteness, title: str | None = None) -> Figure:
    """Autocorrelation of the innovations at each lag with the band of white noise.

    Args:
        whiteness: from the function of that name.
        title: instead of the summary.
    """
    correlation, band = _to_numpy(whiteness.autocorrelation), _to_numpy(whiteness.band)
    lags = np.arange(1, len(correlation) + 1)
    if title is None:
        p_value = f"{whiteness.p_value:.2g}" if not whiteness.p_value < 1e-4 else "< 0.0001"
        title = f"White noise: p {p_value}; {_percent(whiteness.share_inside)} of the lags inside"
    figure, axes = _figure((8, 3.2), "lag [steps]", "autocorrelation", title)
    edges, reach = _edges(lags), np.repeat(band, 2)
    label = f"{_percent(whiteness.probability)} band"
    axes.fill_between(edges, -reach, reach, color=GREEN, alpha=0.25, lw=0, label=label)
    axes.axhline(0.0, color=GREY, lw=1)
    axes.vlines(lags, 0.0, correlation, color=BLUE, lw=1.2)
    axes.plot(lags, correlation, color=BLUE, marker="o", ms=4, ls="", label="innovations")
    axes.set_xlim(0.5, len(lags) + 0.5)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    return figure


def plot_coverage(coverage: Coverage, labels: Sequence[str] | None = None, title: str | None = None) -> Figure:
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
    axes.plot([0, 1], [0, 1], color=GREY, lw=1, label="consistent (below: overconfident)")
    for row, label in enumerate(labels):
        reach, colour = np.stack([share[row] - low[row], high[row] - share[row]]).clip(min=0), SERIES[row % len(SERIES)]
        axes.errorbar(level, share[row], reach, color=colour, marker="o", ms=4, lw=1.2, capsize=3, label=label)
    axes.legend(fontsize=8, loc="upper left", frameon=False)
    return figure


def _figure(size: tuple[float, float], across: str, up: str, title: str | None) -> tuple[Figure, Axes]:
    """With names of the axes, a light grid, and no frame at the top and right."""
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.add_subplot(xlabel=across, ylabel=up)
    axes.set_title(title or "", fontsize=10)
    axes.grid(True, color="#D9D9D9", lw=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


def _percent(share: float) -> str:
    return f"{round(100 * share, 1):g} %"


def _edges(at: np.ndarray) -> np.ndarray:
    """Beginning and end of each step, halfway to its neighbours, (2 steps,)."""
    if len(at) < 2:
        return np.concatenate([at - 0.5, at + 0.5])
    between = (at[1:] + at[:-1]) / 2
    first, last = 2 * at[0] - between[0], 2 * at[-1] - between[-1]
    return np.stack([np.append(first, between), np.append(between, last)], axis=-1).ravel()


def _to_numpy(values: Tensor) -> np.ndarray:
    return np.asarray(values.detach().cpu().double())
