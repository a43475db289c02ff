"""Consistency of relative poses as text, figure and plain numbers."""

import math
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from sigmaslam.estimation.chi_square import CHI_SQUARE_BAND_OF_6
from sigmaslam.plot_style import BLUE, SKY, VERMILLION
from sigmaslam.run_record.relative_pose_file import RELATIVE_POSES_NAME
from sigmaslam_evaluation.metrics.relative_consistency import SpanConsistency

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def format_relative(spans: tuple[SpanConsistency, ...] | None) -> list[str]:
    """Lines of a text table; None stands for a run that does not say."""
    if spans is None:
        return [f"Relative poses: - (no {RELATIVE_POSES_NAME} beside the trajectory)"]
    if not spans:
        return ["Relative poses: -, the path is shorter than a span, or no two frames of one have a truth"]
    lines = [
        f"{'Relative poses':<16}{'pairs':>7}{'NEES per dof':>14}{'median':>8}{'inside 95 %':>13}"
        f"{'rmse [m]':>11}{'sigma [m]':>11}{'rmse [deg]':>12}{'sigma [deg]':>13}{'truth':>8}"
    ]
    for each in spans:
        share = "-" if math.isnan(each.truth_share) else f"{100 * each.truth_share:.0f} %"
        lines.append(
            f"{f'  over {each.span}':<16}{each.count:>7}{each.mean_nees:>14.2f}{each.median_nees:>8.2f}"
            f"{f'{100 * each.inside:.0f} %':>13}{each.translation_rmse:>11.2g}{each.translation_sigma:>11.2g}"
            f"{each.rotation_rmse_deg:>12.2g}{each.rotation_sigma_deg:>13.2g}{share:>8}"
            + ("  the truth is no better than the estimate here" if each.truth_rules else "")
        )
    return lines


def draw_relative(left: "Axes", right: "Axes", spans: tuple[SpanConsistency, ...]) -> None:
    """NEES of relative poses within their band, and errors beside what the covariances say of them."""
    places = np.arange(len(spans))
    low, high = CHI_SQUARE_BAND_OF_6 / 6
    left.axhspan(low, high, color=SKY, alpha=0.3, lw=0, label="95 % where the covariance is right")
    quantiles = np.array([np.quantile(span.nees, (0.025, 0.5, 0.975)) for span in spans])
    left.vlines(places, quantiles[:, 0], quantiles[:, 2], color=BLUE, lw=1.6, label="95 % of the pairs")
    left.plot(places, quantiles[:, 1], "o", color=BLUE, ms=5, label="median")
    left.set(yscale="log", ylabel="NEES per degree of freedom")
    left.set_title("Relative poses: NEES", fontsize=10)
    rmse = [span.translation_rmse for span in spans]
    right.plot(places, rmse, "o", color=BLUE, ms=5, label="position error, rmse")
    sigma = [span.translation_sigma for span in spans]
    right.plot(places, sigma, "_", color=VERMILLION, ms=16, mew=2, label="sigma, estimate and truth")
    right.set(yscale="log", ylabel="[m]")
    right.set_title("Relative poses: position", fontsize=10)
    for panel in (left, right):
        panel.set_xticks(places, [span.span for span in spans])
        panel.set(xlabel="span", xlim=(-0.5, len(spans) - 0.5))
        panel.margins(y=0.35)  # room for the legend
        panel.legend(fontsize=8, loc="upper left", ncols=2)


def span_to_dict(span: SpanConsistency) -> dict[str, Any]:
    """Numbers for JSON, without those of each pair."""
    numbers = asdict(span)
    del numbers["nees"]
    derived = {"count": span.count, "mean_nees": span.mean_nees, "median_nees": span.median_nees}
    return {**numbers, **derived, "truth_rules": span.truth_rules}
