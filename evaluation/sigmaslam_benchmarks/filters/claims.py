"""Two claims of the chapter put to Monte Carlo: the banana of 9.2.3.2, and that the UKF beats the EKF (9.6)."""

import math
import platform
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.stats import chi2, t
from torch import Generator, Tensor

from sigmaslam.files import save_png
from sigmaslam.plot_style import BLACK, BLUE, GREEN, GREY, ORANGE, VERMILLION, style_axes
from sigmaslam_benchmarks.filters import scenarios
from sigmaslam_benchmarks.filters.scenarios import Outcome, Scenario, run
from sigmaslam_benchmarks.tracking.page import fill_page, write_page
from sigmaslam_filters import (
    SE2,
    SO2,
    BayesFilter,
    Euclidean,
    ExtendedKalmanFilter,
    Gaussian,
    MotionModel,
    Product,
    UnscentedKalmanFilter,
)
from sigmaslam_filters.manifolds import Space
from sigmaslam_filters.systems import differential_drive

# Number of independent groups of runs or samples; their scatter gives the intervals.
_GROUPS = 20
_STEPS, _TIME_STEP, _SPEED = 50, 0.2, 1.0
_SPEED_SIGMA = 0.2
_SPREADS = (0.1, 0.3, 0.6)
_SHOWN = 0.6
_SAMPLES = 50_000
# Relative changes below this are negligible, whatever their significance.
_TOO_SMALL = 1e-3
_BANANA_FILTERS: tuple[tuple[str, BayesFilter, str], ...] = (
    ("EKF, R^3", ExtendedKalmanFilter(), VERMILLION),
    ("UKF, R^3", UnscentedKalmanFilter(), BLUE),
    ("EKF, SE(2)", ExtendedKalmanFilter(SE2()), ORANGE),
    ("UKF, SE(2)", UnscentedKalmanFilter(SE2()), GREEN),
)


@dataclass(frozen=True, slots=True)
class Interval:
    """A mean with its 95 % confidence interval."""

    mean: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class BananaRow:
    """One filter's prediction of where a robot is after a drive, against samples.

    Attributes:
        spread: standard deviation of the heading at the end, rad.
        name: of the filter and its chart.
        bias: mean of x, along the road, minus that of the samples, metres.
        divergence: Kullback-Leibler divergence of the Gaussian with the samples' moments from that with the filter's.
        coverage: share of the samples inside the 95 % region in the filter's own chart.
    """

    spread: float
    name: str
    bias: Interval
    divergence: Interval
    coverage: Interval


@dataclass(frozen=True, slots=True)
class Comparison:
    """UKF against EKF on the same runs.

    Attributes:
        name: of the scenario.
        unit: of the position.
        runs: how many.
        rmse: of the position: EKF, UKF.
        change: of the RMSE from EKF to UKF, relative to the EKF's.
        bias: of the position, root mean square over time, what scatter leaves taken off: EKF, UKF.
        bias_change: of the squared bias, relative to the EKF's mean square error.
        nees: mean per degree of freedom: EKF, UKF.
        better: share of the runs in which the UKF's RMSE is the lower one.
    """

    name: str
    unit: str
    runs: int
    rmse: tuple[float, float]
    change: Interval
    bias: tuple[float, float]
    bias_change: Interval
    nees: tuple[float, float]
    better: float


def drive_samples(spread: float, count: int, generator: Generator) -> Tensor:
    """True states (count, 3) after 10 m straight ahead with noise in speed and heading that ends at `spread` rad."""
    motion = _drive(spread)
    assert isinstance(motion.noise, Tensor)
    root = motion.noise.sqrt()
    state = torch.zeros(count, 3, dtype=torch.float64)
    for _ in range(_STEPS):
        noise = torch.randn(count, 2, generator=generator, dtype=torch.float64) @ root
        state = motion.function(state, noise, *_motion_inputs())
    return state


def predict_drive(bayes: BayesFilter, spread: float) -> Gaussian:
    """A filter's belief after the drive of `drive_samples`."""
    belief = Gaussian(torch.zeros(3, dtype=torch.float64), torch.zeros(3, 3, dtype=torch.float64))
    motion = _drive(spread)
    for _ in range(_STEPS):
        belief = bayes.predict(belief, motion, *_motion_inputs()).belief
    return belief


def compare_bananas(samples: int = _SAMPLES) -> list[BananaRow]:
    """All filters at all spreads, against `samples` samples in each of 20 groups."""
    rows = []
    bound = float(chi2.ppf(0.95, 3))
    for spread in _SPREADS:
        generator = torch.Generator().manual_seed(1)
        groups = [drive_samples(spread, samples, generator) for _ in range(_GROUPS)]
        for name, bayes, _ in _BANANA_FILTERS:
            belief = predict_drive(bayes, spread)
            mean, covariance = _cartesian_moments(belief, bayes.space)
            bias, divergence, coverage = [], [], []
            for truth in groups:
                centre, scatter = truth.mean(dim=0), torch.cov(truth.mT)
                bias.append(float(mean[0] - centre[0]))
                divergence.append(_divergence(centre, scatter, mean, covariance))
                error = truth - belief.mean if bayes.space is None else bayes.space.local(belief.mean, truth)
                white = torch.linalg.solve_triangular(belief.factor, error.mT, upper=False)
                coverage.append(float((white.square().sum(dim=0) <= bound).double().mean()))
            rows.append(BananaRow(spread, name, _interval(bias), _interval(divergence), _interval(coverage)))
    return rows


def compare(name: str, scenario: Scenario, ekf: BayesFilter, ukf: BayesFilter, unit: str = "m") -> Comparison:
    """Both filters on a scenario, whose runs must be a multiple of 20."""
    outcomes = run(scenario, ekf), run(scenario, ukf)
    runs = scenario.truth.shape[1]
    squares = [outcome.rmse_by_run.square().reshape(_GROUPS, -1).mean(dim=1) for outcome in outcomes]
    biases = [_squared_bias(outcome) for outcome in outcomes]
    change = _interval((squares[1].sqrt() - squares[0].sqrt()).tolist(), float(squares[0].sqrt().mean()))
    bias_change = _interval((biases[1] - biases[0]).tolist(), float(squares[0].mean()))
    size = outcomes[0].error.shape[-1]
    return Comparison(
        name=name,
        unit=unit,
        runs=runs,
        rmse=(outcomes[0].rmse, outcomes[1].rmse),
        change=change,
        bias=(_root(float(biases[0].mean())), _root(float(biases[1].mean()))),
        bias_change=bias_change,
        nees=(float(outcomes[0].nees.nanmean()) / size, float(outcomes[1].nees.nanmean()) / size),
        better=float((outcomes[1].rmse_by_run < outcomes[0].rmse_by_run).double().mean()),
    )


def compare_filters(runs: int = 400) -> list[Comparison]:
    """UKF against EKF, one linearisation each unless the name says otherwise, on all scenarios."""
    ekf, ukf = ExtendedKalmanFilter(iterations=1, on_failure="hold"), UnscentedKalmanFilter(iterations=1)
    ekf_2 = ExtendedKalmanFilter(iterations=2, on_failure="hold")
    ukf_2 = UnscentedKalmanFilter(iterations=2, on_failure="hold")
    rows = []
    for label, sigma in (
        ("1 cm", (0.01, 0.1, 0.002, 0.02)),
        ("5 cm", (0.05, 0.1, 0.01, 0.02)),
        ("20 cm", (0.2, 0.1, 0.05, 0.02)),
    ):
        rows.append(
            compare(
                f"12 states, 4 points, prior {label}", _seeded(scenarios.stereo_pose, runs, prior_sigma=sigma), ekf, ukf
            )
        )
    vague = _seeded(scenarios.vague_prior, runs)
    rows.append(compare("12 states, one update, 200 points", vague, ekf, ukf))
    rows.append(compare("the same, two linearisations", vague, ekf_2, ukf_2))
    circle = _seeded(scenarios.localisation, runs, rate=10)
    for chart, space in (("SO(2) x R^2", Product(Euclidean(2), SO2())), ("SE(2)", SE2())):
        pair = ExtendedKalmanFilter(space, iterations=1), UnscentedKalmanFilter(space, iterations=1)
        rows.append(compare(f"localisation, {chart}", circle, *pair))
    rows.append(compare("coordinated turn", _seeded(scenarios.coordinated_turn, runs), ekf, ukf))
    rows.append(compare("bearings only", _seeded(scenarios.bearings, runs), ekf, ukf))
    rows.append(compare("reentry", _seeded(scenarios.reentry, 100, steps=500), ekf, ukf, "km"))
    rows.append(compare("growth (two modes)", _seeded(scenarios.growth, runs, steps=200), ekf, ukf, "-"))
    return rows


def format_claims(bananas: Sequence[BananaRow], comparisons: Sequence[Comparison], figure: str, command: str) -> str:
    """The results as a Markdown page; `figure` is the path of the picture from the page."""
    return fill_page(
        "claims",
        command,
        figure=figure,
        processor=platform.machine(),
        groups=_GROUPS,
        metres=f"{_STEPS * _TIME_STEP * _SPEED:g}",
        spread=f"{_SPEED_SIGMA * _TIME_STEP * math.sqrt(_STEPS):.2f}",
        samples=_GROUPS * _SAMPLES,
        too_small=f"{100 * _TOO_SMALL:g}",
        bananas=[
            [
                f"{banana.spread:g}",
                banana.name.replace("R^3", "R³"),
                _spread(banana.bias, 1e3, "+.1f"),
                _spread(banana.divergence, 1.0, ".4f"),
                _spread(banana.coverage, 100.0, ".2f"),
            ]
            for banana in bananas
        ],
        comparisons=[
            [
                item.name.replace("R^2", "R²"),
                f"{item.runs}",
                f"{_short(item.rmse[0])} {item.unit}",
                _short(item.rmse[1]),
                _range(item.change),
                *map(_short, item.bias),
                _range(item.bias_change),
                *map(_short, item.nees),
                f"{100 * item.better:.0f}",
                f"{_verdict(item.change)}; {_verdict(item.bias_change)}",
            ]
            for item in comparisons
        ],
    )


def plot_claims(comparisons: Sequence[Comparison], samples: int = 400_000) -> Figure:
    """The banana and the change of RMSE, side by side."""
    figure = Figure(figsize=(11, 5), layout="constrained")
    banana, forest = figure.subplots(1, 2, width_ratios=(1, 1.3))
    _plot_banana(banana, samples)
    _plot_changes(forest, comparisons)
    return figure


def write_claims(path: Path, figure: Path, command: str, note: Callable[[str], None]) -> str:
    """Runs everything, writes page and figure and returns the page; what is below `<!-- notes -->` in it is kept."""
    note("simulating a dozen scenarios (two to seven minutes)")
    bananas, comparisons = compare_bananas(), compare_filters()
    try:
        link = figure.resolve().relative_to(path.resolve().parent).as_posix()
    except ValueError:
        link = figure.as_posix()
    page = format_claims(bananas, comparisons, link, command)
    save_png(plot_claims(comparisons), figure)
    return write_page(path, page)


def _plot_banana(axes: Axes, samples: int) -> None:
    generator = torch.Generator().manual_seed(2)
    truth = drive_samples(_SHOWN, samples, generator)
    axes.plot(*truth[:3000, :2].mT.numpy(), ".", ms=2, mew=0, color=GREY, alpha=0.7, rasterized=True)
    axes.plot([], [], "o", ms=4, color=GREY, mew=0, label="samples")
    _contour(axes, truth[:, :2].numpy(), BLACK, "-", "samples, 95 %")
    for name, bayes, colour in _BANANA_FILTERS:
        belief = predict_drive(bayes, _SHOWN)
        if bayes.space is None:
            _ellipse(axes, belief, colour, name.replace("R^3", "R³"))
        elif name.startswith("UKF"):
            _contour(axes, _draw(belief, bayes.space, samples)[:, :2].numpy(), colour, "--", name)
    axes.set_aspect("equal", adjustable="box")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.set_title(f"after 10 m, heading spread {_SHOWN:g} rad: 95 % regions", fontsize=10)
    axes.set_xlim(0.0, 12.0)
    axes.set_ylim(-9.0, 9.0)
    axes.legend(loc="center left", fontsize=8, framealpha=0.85)
    style_axes(axes)


def _plot_changes(axes: Axes, comparisons: Sequence[Comparison]) -> None:
    for height, item in enumerate(reversed(comparisons)):
        change = item.change
        colour = BLUE if change.high < 0 else VERMILLION if change.low > 0 else GREY
        ends = 100 * np.clip([change.low, change.high], -1.0, 1.0)
        axes.plot(ends, [height, height], color=colour, lw=2.2, solid_capstyle="butt")
        axes.plot(100 * change.mean, height, "o", color=colour, ms=5)
    axes.axvline(0.0, color=BLACK, lw=1)
    axes.set_yticks(
        range(len(comparisons)), [item.name.replace("R^2", "R²") for item in reversed(comparisons)], fontsize=8
    )
    axes.set_xlabel("change of the position RMSE from EKF to UKF, % of the EKF's")
    axes.set_title("blue: UKF better, red: EKF better, grey: zero inside 95 %", fontsize=10)
    style_axes(axes)


def _ellipse(axes: Axes, belief: Gaussian, colour: str, label: str) -> None:
    angle = np.linspace(0, 2 * np.pi, 181)
    circle = math.sqrt(float(chi2.ppf(0.95, 2))) * np.array([np.cos(angle), np.sin(angle)])
    mean = belief.mean[:2].numpy()
    # The position's marginal; its smallest eigenvalue may be zero to round-off.
    values, vectors = np.linalg.eigh(belief.covariance[:2, :2].numpy())
    outline = mean[:, None] + vectors @ (np.sqrt(np.maximum(values, 0.0))[:, None] * circle)
    axes.plot(*outline, color=colour, lw=1.6, label=label)
    axes.plot(*mean, "x", color=colour, ms=7, mew=1.8)


def _contour(axes: Axes, points: NDArray[np.float64], colour: str, dashes: str, label: str) -> None:
    """Outline of the smallest region with 95 % of the points (N, 2), and their mean."""
    # A few far points would make the bins wide, and smoothing the outline with them.
    low, high = np.percentile(points, (0.1, 99.9), axis=0)
    edges = np.linspace(low - 1.0, high + 1.0, 201)
    x, y = edges[:, 0], edges[:, 1]
    density, _, _ = np.histogram2d(points[:, 0], points[:, 1], bins=[x, y])
    density = gaussian_filter(density, 2.0)
    ordered = np.sort(density, axis=None)[::-1]
    level = float(ordered[np.searchsorted(np.cumsum(ordered), 0.95 * ordered.sum())])
    centres = 0.5 * (x[1:] + x[:-1]), 0.5 * (y[1:] + y[:-1])
    axes.contour(*centres, density.T, levels=[level], colors=[colour], linestyles=[dashes], linewidths=[1.6])
    axes.plot([], [], dashes, color=colour, lw=1.6, label=label)
    axes.plot(*points.mean(axis=0), "x", color=colour, ms=7, mew=1.8)


def _drive(spread: float) -> MotionModel:
    turn_sigma = spread / (_TIME_STEP * math.sqrt(_STEPS))
    return differential_drive(torch.diag(torch.tensor([_SPEED_SIGMA**2, turn_sigma**2], dtype=torch.float64)))


def _motion_inputs() -> tuple[Tensor, Tensor]:
    """Control and time step of each step."""
    return torch.tensor([_SPEED, 0.0], dtype=torch.float64), torch.tensor([_TIME_STEP], dtype=torch.float64)


def _draw(belief: Gaussian, space: Space, count: int) -> Tensor:
    generator = torch.Generator().manual_seed(3)
    tangent = torch.randn(count, 3, generator=generator, dtype=torch.float64) @ belief.factor.mT
    return space.retract(belief.mean.expand(count, 3), tangent)


def _cartesian_moments(belief: Gaussian, space: Space | None) -> tuple[Tensor, Tensor]:
    """Mean and covariance of (x, y, theta) under a belief; on a manifold by a million samples."""
    if space is None:
        return belief.mean, belief.covariance
    samples = _draw(belief, space, 1_000_000)
    return samples.mean(dim=0), torch.cov(samples.mT)


def _divergence(mean: Tensor, covariance: Tensor, other_mean: Tensor, other_covariance: Tensor) -> float:
    """KL(N(mean, covariance) || N(other))."""
    factor = torch.linalg.cholesky(other_covariance)
    ratio = torch.linalg.solve_triangular(factor, torch.linalg.cholesky(covariance), upper=False)
    shift = torch.linalg.solve_triangular(factor, (mean - other_mean).unsqueeze(-1), upper=False)
    squares = ratio.square().sum() + shift.square().sum() - len(mean)
    return float(0.5 * squares - ratio.diagonal().abs().log().sum())


def _squared_bias(outcome: Outcome) -> Tensor:
    """(20,) mean over time of |mean error|^2 in each group of runs, without what scatter adds to it."""
    steps, runs, size = outcome.position_error.shape
    grouped = outcome.position_error.reshape(steps, _GROUPS, runs // _GROUPS, size)
    scatter = grouped.var(dim=2) / (runs // _GROUPS)
    return (grouped.mean(dim=2).square() - scatter).sum(dim=-1).mean(dim=0)


def _interval(values: Sequence[float], scale: float = 1.0) -> Interval:
    """Student's interval of the mean of independent values, in units of `scale`."""
    given = np.asarray(values) / scale
    mean = float(given.mean())
    half = float(t.ppf(0.975, len(given) - 1) * given.std(ddof=1) / math.sqrt(len(given)))
    return Interval(mean, mean - half, mean + half)


def _seeded(maker: Callable[..., Scenario], runs: int, **options: object) -> Scenario:
    return maker(runs, torch.Generator().manual_seed(0), **options)


def _root(square: float) -> float:
    return math.sqrt(max(square, 0.0))


def _verdict(change: Interval) -> str:
    if abs(change.mean) < _TOO_SMALL:
        return "-"
    return "UKF" if change.high < 0 else "EKF" if change.low > 0 else "-"


def _short(value: float) -> str:
    return f"{value:.3g}" if value < 1e5 else f"{value:.0e}"


def _spread(interval: Interval, scale: float, form: str) -> str:
    return f"{interval.mean * scale:{form}} ± {(interval.high - interval.mean) * scale:{form.lstrip('+')}}"


def _range(interval: Interval) -> str:
    # Adding zero takes the sign off a negative one.
    mean, low, high = (round(100 * end, 1) + 0.0 for end in (interval.mean, interval.low, interval.high))
    return f"{mean:+.1f} ({low:+.1f} to {high:+.1f})"
