"""The plots of a report, over the time of all frames."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from sigmaslam.estimation.chi_square import CHI_SQUARE_BAND_OF_6
from sigmaslam.plot_style import BLUE, GREEN, GREY, SERIES, VERMILLION
from sigmaslam.run_record.frame_table import FrameTable
from sigmaslam.run_record.recorded_run import RecordedRun

MAX_FRAMES = 20_000
"""Of one run; with more an even selection is drawn."""
# A scale is logarithmic where the largest value is so many times the median.
_WIDE = 100.0


def thin(values: np.ndarray, most: int = MAX_FRAMES) -> np.ndarray:
    """An even selection of at most so many values, those of all frames."""
    return values[:: max(1, -(-len(values) // most))]


def nis_per_dof(frames: FrameTable) -> np.ndarray:
    """(F,) NIS per degree of freedom; NaN where there is none."""
    nis, dof = frames.columns["nis"], frames.columns["dof"]
    return np.where(dof > 0, nis / np.where(dof > 0, dof, 1.0), np.nan)


def build_plots(run: RecordedRun) -> list[dict[str, Any]]:
    """Title, caption, series and bands of each plot that has data.

    Series that are of interest beside those of another run say in `compared` what they are, if the title does not.
    """
    plots = [
        *_sigmas(run),
        *_nees(run),
        _nis(run.frames),
        _inliers(run.frames),
        _offset(run.frames),
        *_inertial(run),
        *_times(run.frames),
        _belief(run.frames),
    ]
    return [plot for plot in plots if _has_numbers(*(each["values"] for each in plot["series"]))]


def _line(label: str, values: np.ndarray, colour: str, **style: Any) -> dict[str, Any]:
    return {"label": label, "colour": colour, "values": values, **style}


def _plot(title: str, caption: str, series: list[dict[str, Any]], **options: Any) -> dict[str, Any]:
    return {"title": title, "caption": caption, "series": series, **options}


def _has_numbers(*values: np.ndarray) -> bool:
    return any(bool(np.isfinite(each).any()) for each in values)


def _sigmas(run: RecordedRun) -> list[dict[str, Any]]:
    """3 sigma of position and rotation, with their errors where there is a truth."""
    plots, errors = [], run.evaluated
    kinds = (("position", "m", 1.0), ("rotation", "deg", float(np.degrees(1.0))))
    for (kind, unit, scale), sigma in zip(kinds, run.sigmas, strict=True):
        claimed = run.of_frames(3.0 * scale * sigma)
        caption = "3 sigma are those of the pose in the world, as it was said with the frame."
        series = [_line("3 sigma", claimed, BLUE, width=2, compared="3 sigma")]
        if errors is not None:
            error = scale * (errors.position_error if kind == "position" else errors.rotation_error)
            caption += " The error is that of the pose relative to the first one with a truth."
            series.append(_line("error", run.of_frames(error, errors.row), VERMILLION, width=2, compared="error"))
        values = np.concatenate([each["values"] for each in series])
        values = values[np.isfinite(values) & (values > 0)]
        is_wide = bool(len(values) and values.max() > _WIDE * np.median(values))
        plots.append(_plot(f"Error of the {kind} [{unit}]", caption, series, log=is_wide))
    return plots


def _band(low: np.ndarray, high: np.ndarray, label: str) -> list[dict[str, Any]]:
    return [_line(label, high, GREEN, width=0.5), _line("", low, GREEN, width=0.5)]


_BANDS = [{"series": [1, 2], "fill": "rgb(0 158 115 / 20%)"}]


def _nees(run: RecordedRun) -> list[dict[str, Any]]:
    if run.evaluated is None or not _has_numbers(run.evaluated.nees):
        return []
    ratio = run.of_frames(run.evaluated.nees, run.evaluated.row)
    low, high = (np.full(len(ratio), bound) for bound in CHI_SQUARE_BAND_OF_6 / 6.0)
    caption = (
        "Normalised estimation error squared, per degree of freedom: 1 is right, above the band the covariance is too "
        "small. The band holds 95 % of a right one's."
    )
    series = [*_band(low, high, "95 %"), _line("NEES / dof", ratio, BLUE, dots=True, compared="")]
    return [_plot("NEES", caption, series, log=True, bands=_BANDS)]


def _nis(frames: FrameTable) -> dict[str, Any]:
    ratio = nis_per_dof(frames)
    # (chi2 / dof)^(1/3) is nearly normal (Wilson and Hilferty).
    dof = np.where(frames.columns["dof"] > 0, frames.columns["dof"], np.nan)
    spread = np.sqrt(2 / (9 * dof))
    low, high = (np.maximum(1 - 2 / (9 * dof) + sign * 1.96 * spread, 1e-3) ** 3 for sign in (-1, 1))
    caption = (
        "Normalised innovation squared, per degree of freedom: about 1 where the claimed uncertainty is right, above "
        "the band where it is too small. The band holds 95 % of the frames of a consistent filter."
    )
    series = [*_band(low, high, "95 %"), _line("NIS / dof", ratio, BLUE, dots=True, compared="")]
    return _plot("NIS", caption, series, log=True, bands=_BANDS)


def _inliers(frames: FrameTable) -> dict[str, Any]:
    matches, inliers = frames.columns["matches"], frames.columns["inliers"]
    series = [_line("matches", matches, BLUE), _line("inliers", inliers, VERMILLION, compared="")]
    return _plot("Matches and inliers", "Inliers are the matches that the filter used.", series)


def _offset(frames: FrameTable) -> dict[str, Any]:
    offset, sigma = frames.columns["disparity_offset"], frames.columns["disparity_offset_sigma"]
    series = [
        _line("+ 2 sigma", offset + 2 * sigma, GREY, width=0.5),
        _line("- 2 sigma", offset - 2 * sigma, GREY, width=0.5),
        _line("offset", offset, BLUE, width=2, compared=""),
    ]
    bands = [{"series": [1, 2], "fill": "rgb(0 114 178 / 18%)"}]
    return _plot("Disparity offset [px]", "Estimated error of the calibration.", series, bands=bands)


def _inertial(run: RecordedRun) -> list[dict[str, Any]]:
    """Roll and pitch, and the biases, of the frames with a known gravity."""
    records = run.inertial
    if records is None or not len(records):
        return []
    rows = np.searchsorted(run.frames.columns["timestamp"], records.timestamp - 1e-6)

    def of_frames(values: np.ndarray) -> np.ndarray:
        spread = np.full(len(run.frames), np.nan)
        spread[rows] = values
        return spread

    def plot(title: str, caption: str, names: Sequence[str], values: np.ndarray, sigmas: np.ndarray) -> dict[str, Any]:
        series, bands = [], []
        for k, (name, colour) in enumerate(zip(names, (BLUE, VERMILLION, GREEN), strict=False)):
            for sign in (2.0, -2.0):
                series.append(_line("", of_frames(values[:, k] + sign * sigmas[:, k]), GREY, width=0.5))
            series.append(_line(name, of_frames(values[:, k]), colour, width=2))
            bands.append({"series": [3 * k + 1, 3 * k + 2], "fill": "rgb(120 120 120 / 18%)"})
        return _plot(title, f"{caption}, with 2 sigma.", series, bands=bands)

    level, biases, sigmas = np.degrees(records.level), records.biases, records.bias_sigmas
    return [
        plot("Roll and pitch [deg]", "Of the camera against the vertical", ("roll", "pitch"), level, level[:, 2:]),
        plot("Gyro bias [rad/s]", "In the sensor's frame", "xyz", biases, sigmas),
        plot("Accelerometer bias [m/s²]", "In the sensor's frame", "xyz", biases[:, 3:], sigmas[:, 3:]),
    ]


def _belief(frames: FrameTable) -> dict[str, Any]:
    belief = frames.columns["belief"]
    caption = "How far the tracker believes each of its poses, 0 to 1."
    return _plot("Belief", caption, [_line("belief", belief, BLUE, compared="")], range=[-0.03, 1.03])


def _times(frames: FrameTable) -> list[dict[str, Any]]:
    if not _has_numbers(frames.total_milliseconds):
        return []
    names = list(frames.milliseconds)
    stacked = np.cumsum(np.nan_to_num(np.array([frames.milliseconds[name] for name in names])), axis=0)
    stacked[:, ~np.isfinite(frames.total_milliseconds)] = np.nan
    # The tallest first, so that each covers those above it down to its own.
    series = [
        _line(
            f"to {names[k].replace('_', ' ')}",
            stacked[k],
            SERIES[k % 6],
            width=1,
            fill=f"{SERIES[k % 6]}66",
            **({"compared": ""} if k == len(names) - 1 else {}),
        )
        for k in reversed(range(len(names)))
    ]
    caption = "Stages one upon the other."
    interval = frame_interval(frames)
    if interval is not None:
        series.append(_line("real time", np.full(len(frames), 1e3 * interval), GREY, width=1.5, dash=[6, 4]))
        caption += f" Frames come every {1e3 * interval:.0f} ms."
    return [_plot("Time spent [ms]", caption, series)]


def frame_interval(frames: FrameTable) -> float | None:
    """Median time between frames, seconds; None for a single one."""
    return float(np.median(np.diff(frames.columns["timestamp"]))) if len(frames) > 1 else None
