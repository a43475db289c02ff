"""The report of a localisation: one HTML file without links to anything outside it."""

import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from sigmaslam.files import atomic_write_text, printable, save_png
from sigmaslam.plot_style import BLUE, GREEN, GREY, NO_MATPLOTLIB, SERIES, has_matplotlib, style_axes
from sigmaslam.report.page_parts import load_template
from sigmaslam_localisation.robots import RobotEstimate

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ELLIPSES = 60
"""Of each robot on the map."""
SIGMAS = 3.0
"""Radius of the ellipses, in standard deviations."""


def write_page(
    path: Path, name: str, summaries: Mapping[str, Mapping[str, Any]], figures: "Sequence[tuple[str, str, Figure]]"
) -> None:
    """Write the page.

    Args:
        name: of the recording.
        summaries: by robot, label and value.
        figures: title, caption and figure of each.
    """
    labels = list(dict.fromkeys(label for summary in summaries.values() for label in summary))
    text = load_template("localisation.html", "sigmaslam_localisation").render(
        name=printable(name),
        columns=list(summaries),
        rows=[
            (label.replace("_", " "), [_cell(summary.get(label)) for summary in summaries.values()]) for label in labels
        ],
        remark=None if has_matplotlib() else NO_MATPLOTLIB,
        figures=[
            (title, caption, Markup(_to_svg(figure, f"figure{number}")))
            for number, (title, caption, figure) in enumerate(figures)
        ],
    )
    atomic_write_text(path, text)


def draw_robots(
    estimates: Sequence[RobotEstimate], landmarks: np.ndarray, png: Path
) -> "list[tuple[str, str, Figure]]":
    """The map, also as a PNG, and innovations over time; nothing without matplotlib."""
    if not has_matplotlib():
        return []
    figure, axes = draw_axes(6, "x [m]", "y [m]")
    _draw_map(axes, estimates, landmarks)
    save_png(figure, png)
    drawn = [("Map", f"Ellipses of {SIGMAS:g} sigma; landmarks are crosses, the truth is thin and grey.", figure)]
    figure, axes = draw_axes(2.6, "time [s]", "NIS / dof")
    for estimate, colour in zip(estimates, _colours(estimates), strict=True):
        row, slot = np.nonzero(np.isfinite(estimate.nis))
        ratio = estimate.nis[row, slot] / estimate.innovation.shape[-1]
        seconds = estimate.seconds[row] - estimate.seconds[0]
        axes.plot(seconds, ratio, ".", ms=1.5, color=colour, label=estimate.name, rasterized=True)
    axes.axhline(1.0, color=GREEN, lw=1)
    axes.set_yscale("log")
    drawn.append(("Normalised innovation squared", "Of each sighting, per degree of freedom.", figure))
    figure, axes = draw_axes(2.6, "time [s]", "belief")
    for estimate, colour in zip(estimates, _colours(estimates), strict=True):
        axes.plot(estimate.seconds - estimate.seconds[0], estimate.belief, color=colour, lw=1.0, rasterized=True)
    axes.set_ylim(-0.03, 1.03)
    drawn.append(("Belief", "One minus the largest standard deviation of the position in metres.", figure))
    return drawn


def draw_axes(height: float, x: str, y: str) -> "tuple[Figure, Axes]":
    """A figure of eight inches and so many, and its axes with these labels."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, height), layout="constrained")
    axes = figure.add_subplot()
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    style_axes(axes)
    return figure, axes


def _draw_map(axes: "Axes", estimates: Sequence[RobotEstimate], landmarks: np.ndarray) -> None:
    for estimate, colour in zip(estimates, _colours(estimates), strict=True):
        if estimate.truth is not None:
            axes.plot(*estimate.truth.poses[:, :2].T, color=GREY, lw=0.5, rasterized=True)
        axes.plot(*estimate.pose[:, :2].T, color=colour, lw=1.0, label=estimate.name, rasterized=True)
        axes.plot(*estimate.pose[0, :2], "o", ms=5, color=colour)
        for index in np.linspace(0, len(estimate.pose) - 1, ELLIPSES).astype(int):
            _draw_ellipse(axes, estimate.pose[index, :2], estimate.covariance[index, :2, :2], colour)
        if estimate.map is not None:
            axes.plot(*estimate.map.place.T, "+", ms=7, color=colour)
            for row, place in enumerate(estimate.map.place):
                _draw_ellipse(
                    axes, place, estimate.map.covariance[2 * row : 2 * row + 2, 2 * row : 2 * row + 2], colour
                )
    axes.plot(*landmarks.T, "x", ms=7, mew=1.6, color=GREY)
    axes.set_aspect("equal", adjustable="datalim")
    axes.legend(loc="best", fontsize=8)


def _draw_ellipse(axes: "Axes", centre: np.ndarray, covariance: np.ndarray, colour: str) -> None:
    from matplotlib.patches import Ellipse

    variances, directions = np.linalg.eigh(covariance)
    width, height = 2 * SIGMAS * np.sqrt(np.maximum(variances, 0.0))
    angle = np.degrees(np.arctan2(directions[1, 0], directions[0, 0]))
    x, y = centre.tolist()
    axes.add_patch(Ellipse((x, y), width, height, angle=angle, fill=False, color=colour, lw=0.6))


def _colours(estimates: Sequence[RobotEstimate]) -> list[str]:
    return [SERIES[number % len(SERIES)] for number in range(len(estimates))] or [BLUE]


def _cell(value: Any) -> str:
    if value is None:
        return "–"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _to_svg(figure: "Figure", name: str) -> str:
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
