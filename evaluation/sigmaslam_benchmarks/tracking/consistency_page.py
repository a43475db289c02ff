"""The pages of the benchmarks `consistency` and `noise`, of the same runs."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from sigmaslam.slam.relative_poses import SPANS
from sigmaslam_benchmarks.tracking.map_consistency import mean_with_error, ratio_with_error
from sigmaslam_benchmarks.tracking.page import fill_page, number_with_error


@dataclass(frozen=True, slots=True)
class Scale:
    """A kind of scene.

    Attributes:
        name: what it stands for.
        preset: of the renderer.
        width, height: pixels.
    """

    name: str
    preset: str
    width: int
    height: int


@dataclass(frozen=True, slots=True)
class ConsistencyResult:
    """One method on one sequence; NaN where there is nothing to judge.

    Attributes:
        nees: of the absolute pose per degree of freedom, mean over frames.
        inside: share of frames inside the 95 % ellipsoid.
        nis: per degree of freedom, over all tracked frames.
        ate: root mean square position error after alignment, metres.
        path_length: metres.
        offset_error: disparity offset at the end, estimated minus true, pixels.
        lost: frames after the first without a pose from the images.
        point_nees: of points of the map per degree of freedom, mean; those at edges are left out.
        point_inside: share inside the 95 % ellipsoid.
        point_gross: share beyond 5 sigma.
        relative: of poses relative to earlier ones, by the name of the span: mean NEES per degree of freedom, and share
            of pairs inside the 95 % ellipsoid.
    """

    nees: float
    inside: float
    nis: float
    ate: float
    path_length: float
    offset_error: float
    lost: int
    point_nees: float
    point_inside: float
    point_gross: float
    relative: Mapping[str, Sequence[float]]


Results: TypeAlias = Mapping[Scale, Mapping[str, Sequence[ConsistencyResult]]]
"""By scale and method, in the order of seeds; methods whose name ends with `DRAWN` have a calibration that is drawn."""
DRAWN = "calibration drawn"


@dataclass(frozen=True, slots=True)
class Goal:
    """A range for one number; `name` is an attribute of `ConsistencyResult`."""

    label: str
    name: str
    low: float
    high: float
    percent: bool = False

    def holds(self, value: float) -> bool:
        """Whether the value is in range; NaN is not."""
        return self.low <= value <= self.high

    def write(self, value: float) -> str:
        """The value as the page has it."""
        return f"{100 * value:.0f} %" if self.percent else f"{value:.2f}"


GOALS = (
    Goal("NEES of poses per dof", "nees", 0.7, 1.4),
    Goal("poses inside 95 %", "inside", 0.90, 0.98, percent=True),
    Goal("NIS per dof", "nis", 0.9, 1.1),
    Goal("NEES of map points per dof", "point_nees", 0.7, 1.5),
    Goal("map points inside 95 %", "point_inside", 0.90, 0.98, percent=True),
)


def format_page(
    results: Results, offset: float, frames: int, seeds: tuple[int, int], command: str, missing: Sequence[str] = ()
) -> str:
    """The page; the first method of each scale is the one that goals are for.

    Args:
        results: of the sequences that there are.
        offset: of all disparities, pixels.
        frames: of a sequence.
        seeds: the first one, and how many of a scale were asked for.
        missing: names of sequences that failed.
    """
    first, count = seeds
    return fill_page(
        "consistency",
        command,
        first=first,
        count=count,
        frames=frames,
        offset=offset,
        scales=[scale.name for scale in results],
        sizes=[f"{scale.name} ({scale.preset}) {scale.width}x{scale.height}" for scale in results],
        missing=missing,
        goals=[
            ("Goals, for ours", *_goals(results, 0, GOALS)),
            ("Goals, for ours with a calibration that is drawn", *_goals(results, -1, GOALS[:3])),
        ],
        tables=[
            (scale.name, list(_pose_rows(methods)), *_relative_table(methods), list(_map_rows(methods)))
            for scale, methods in results.items()
        ],
    )


def format_noise(
    results: Results, offset: float, frames: int, seeds: tuple[int, int], command: str, missing: Sequence[str] = ()
) -> str:
    """The page of own covariances of matches beside one for all; arguments as of `format_page`."""
    pairs = {"exact": ("ours", "one covariance"), "drawn": (f"ours, {DRAWN}", f"one covariance, {DRAWN}")}
    rows: list[list[str]] = []
    total: dict[str, tuple[list[ConsistencyResult], ...]] = {calibration: ([], []) for calibration in pairs}
    for scale, methods in results.items():
        for calibration, names in pairs.items():
            own, one = (methods[name] for name in names)
            rows.append([scale.name, calibration, *_compared(own, one)])
            for found, trials in zip(total[calibration], (own, one), strict=True):
                found += trials
    rows += [["**all**", calibration, *_compared(own, one)] for calibration, (own, one) in total.items()]
    own, one = ([*exact, *drawn] for exact, drawn in zip(*total.values(), strict=True))
    rows.append(["**all**", "both", *_compared(own, one)])
    first, count = seeds
    return fill_page(
        "noise", command, first=first, count=count, frames=frames, offset=offset, rows=rows, missing=missing
    )


def _compared(own: Sequence[ConsistencyResult], one: Sequence[ConsistencyResult]) -> list[str]:
    """Cells: quotient of the errors; what both say of themselves; frames lost."""
    ratio = ratio_with_error([result.ate for result in own], [result.ate for result in one])
    cells = [number_with_error(*ratio, ".2f")]
    for value, form in ((lambda r: r.nees, ".2f"), (lambda r: 100 * r.inside, ".0f"), (lambda r: r.nis, ".2f")):
        cells.append(f"{_cell(own, value, form)} / {_cell(one, value, form)}")
    return [*cells, " / ".join(str(sum(result.lost for result in trials)) for trials in (own, one))]


def _goals(results: Results, method: int, goals: Sequence[Goal]) -> tuple[list[list[str]], list[str]]:
    """Rows of the goals for the method of that position, and which it misses."""
    rows, missed = [], []
    for goal in goals:
        cells = [goal.label, f"{goal.write(goal.low)} to {goal.write(goal.high)}"]
        for scale, methods in results.items():
            judged = list(methods.values())[method]
            value, error = mean_with_error([getattr(result, goal.name) for result in judged])
            cells.append(f"{goal.write(value)} ± {goal.write(error)}" + ("" if goal.holds(value) else ", **missed**"))
            if not goal.holds(value):
                missed.append(f"{goal.label} in {scale.name} ({goal.write(value)})")
        rows.append(cells)
    return rows, missed


def _pose_rows(methods: Mapping[str, Sequence[ConsistencyResult]]) -> Iterator[list[str]]:
    ours = next(iter(methods.values()))
    for method, trials in methods.items():
        ate = [result.ate for result in trials]
        yield [
            method,
            _cell(trials, lambda r: r.nees),
            _cell(trials, lambda r: 100 * r.inside, ".0f"),
            _cell(trials, lambda r: r.nis),
            _cell(trials, lambda r: 100 * r.ate / r.path_length, ".3f"),
            "" if trials is ours else number_with_error(*ratio_with_error(ate, [r.ate for r in ours]), ".2f"),
            _cell(trials, lambda r: r.offset_error, "+.3f"),
            f"{sum(result.lost for result in trials)}",
        ]


def _relative_table(methods: Mapping[str, Sequence[ConsistencyResult]]) -> tuple[list[str], list[list[str]]]:
    """Columns and rows of poses relative to earlier ones, over the spans that a scale has; no rows without one."""
    results = [result for trials in methods.values() for result in trials]
    spans = [span for span in SPANS if any(span in result.relative for result in results)]
    rows = []
    for method, trials in methods.items() if spans else ():
        cells = [method]
        for span in spans:
            figures = [result.relative[span] for result in trials if span in result.relative]
            cells.append(number_with_error(*mean_with_error([nees for nees, _ in figures]), ".2f"))
            cells.append(number_with_error(*mean_with_error([100 * inside for _, inside in figures]), ".0f"))
        rows.append(cells)
    return ["method", *(f"{what} {span}" for span in spans for what in ("NEES", "inside"))], rows


def _map_rows(methods: Mapping[str, Sequence[ConsistencyResult]]) -> Iterator[list[str]]:
    for method, trials in methods.items():
        yield [
            method,
            _cell(trials, lambda r: r.point_nees),
            _cell(trials, lambda r: 100 * r.point_inside, ".0f"),
            _cell(trials, lambda r: 100 * r.point_gross, ".1f") + " %",
        ]


def _cell(trials: Sequence[ConsistencyResult], value: Callable[[ConsistencyResult], float], form: str = ".2f") -> str:
    return number_with_error(*mean_with_error([value(result) for result in trials]), form)
