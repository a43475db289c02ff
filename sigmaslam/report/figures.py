"""Figures of evaluations; matplotlib through its object interface only."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sigmaslam.files import atomic_path
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.plot_style import SERIES, style_axes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

AXIS_NAMES = ("x", "y", "z")


def view_axes(positions: np.ndarray) -> tuple[int, int, int]:
    """Axes of a view from above: the two along which the positions (N, 3) extend most, then the third.

    For a camera that drives with z forward and y down these are x, z and y.
    """
    extent = np.ptp(positions, axis=0) if len(positions) else np.zeros(3)
    # For equal extents the height is y, the axis that points down in a level camera.
    height = min((1, 2, 0), key=lambda axis: float(extent[axis]))
    horizontal, vertical = (axis for axis in range(3) if axis != height)
    return horizontal, vertical, height


def plot_trajectory(
    axes: Axes, trajectories: Mapping[str, Trajectory], predicted: Mapping[str, np.ndarray] | None = None
) -> tuple[int, int, int]:
    """Draw trajectories from above, with equal scales and a mark where each begins; dashed where they are guesses.

    Args:
        axes: where to draw.
        trajectories: by label; the first determines the plane of the view.
        predicted: by label, (N,) bool, which poses no image confirms; a trajectory that is not named has none.
    Returns:
        The axes of the view (see `view_axes`).
    """
    horizontal, vertical, height = view_axes(next(iter(trajectories.values())).positions)
    plane = [horizontal, vertical]
    for number, (label, trajectory) in enumerate(trajectories.items()):
        colour = SERIES[number % len(SERIES)]
        path = trajectory.positions[:, plane]
        style: dict[str, Any] = {"color": colour, "zorder": 3 + number}
        width = 2.6 if number == 0 and len(trajectories) > 1 else 1.4
        guess = (predicted or {}).get(label, np.zeros(len(path), bool))
        axes.plot(*np.where(guess[:, None], np.nan, path).T, "-", lw=width, label=label, **style)
        if guess.any():
            # The ways into a guess and out of it are guesses, too.
            beside = guess | np.append(guess[1:], False) | np.append(False, guess[:-1])
            axes.plot(
                *np.where(beside[:, None], path, np.nan).T, "--", lw=0.6 * width, label=f"{label} while lost", **style
            )
        axes.plot(path[:1, 0], path[:1, 1], "o", ms=5, **style)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel(f"{AXIS_NAMES[horizontal]} [m]")
    axes.set_ylabel(f"{AXIS_NAMES[vertical]} [m]")
    axes.legend(loc="best", fontsize=8, framealpha=0.85)
    style_axes(axes)
    return horizontal, vertical, height


def save_png(figure: Figure, path: str | Path) -> None:
    """Write the figure as PNG, whole or not at all."""
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png", dpi=130)


def to_svg(figure: Figure, name: str) -> str:
    """The figure as an `<svg>` element to put into a page; the same figure gives the same text.

    Args:
        figure: what to draw; rasterised artists become a PNG inside.
        name: unique among the figures of one page, as it makes their identifiers unique.
    """
    import matplotlib

    target = io.StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": name}):
        figure.savefig(target, format="svg", dpi=100, metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    text = target.getvalue()
    text = text[text.index("<svg") :]
    # Matplotlib writes six digits; a screen does not resolve a hundredth of a point.
    text = re.sub(r' (?:d|x|y)="[^"]*"', lambda attribute: re.sub(r"(\.\d\d)\d+", r"\1", attribute[0]), text)
    # Matplotlib repeats the names of groups in each figure. Only groups with references need one.
    used = set(re.findall(r'(?:href="#|url\(#)([^")]+)', text))
    return re.sub(r' id="([^"]*)"', lambda match: match[0] if match[1] in used else "", text)
