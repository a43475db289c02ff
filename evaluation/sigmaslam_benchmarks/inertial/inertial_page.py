"""The page of the benchmark `inertial`."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sigmaslam_benchmarks.inertial.dark_runs import BOUND, METHODS, STATES, DarkResult
from sigmaslam_benchmarks.live.recordings import Recording
from sigmaslam_benchmarks.tracking.map_consistency import mean_with_error
from sigmaslam_benchmarks.tracking.page import fill_page, number, number_with_error

# Goals of the page.
_MH01_METRES, _MH01_MEDIAN, _MH01_ATE = 0.05, 0.03, 0.0039
_MH01_NEES = (0.5, 2.0)
_WITHIN = 0.95
_IMAGES, _, _SENSORS = METHODS


@dataclass(frozen=True, slots=True)
class InertialPage:
    """What the page is made of.

    Attributes:
        runs: results by recording, method, first dark frame and seconds of darkness.
        missing: number of runs that were asked for and are not there.
    """

    command: str
    runs: Mapping[tuple[Recording, str, int, float], DarkResult]
    missing: int = 0

    @property
    def kinds(self) -> list[str]:
        """Worlds with a result."""
        return list(dict.fromkeys(recording.kind for recording, *_ in self.runs))

    @property
    def seconds(self) -> list[float]:
        """Of darkness."""
        return sorted({seconds for *_, seconds in self.runs if seconds})

    def results(self, kind: str, method: str, seconds: float) -> list[DarkResult]:
        """Of all recordings of a world."""
        return [
            result
            for (recording, *case), result in self.runs.items()
            if recording.kind == kind and (case[0], case[2]) == (method, seconds)
        ]


def format_page(page: InertialPage) -> str:
    """The page as Markdown."""
    goals, missed = _goals(page)
    recordings = dict.fromkeys(recording for recording, *_ in page.runs)
    return fill_page(
        "inertial",
        page.command,
        counts=[f"{sum(each.kind == kind for each in recordings)} {kind}" for kind in page.kinds],
        seeds=sorted({each.seed for each in recordings if each.exact}),
        missing=page.missing,
        goals=goals,
        missed=missed,
        method=_SENSORS,
        bound=f"{BOUND:g}",
        dark=list(_dark_rows(page)),
        back=list(_back_rows(page)),
        light=list(_light_rows(page)),
        states=list(_state_rows(page)),
    )


def _goals(page: InertialPage) -> tuple[list[list[str]], list[str]]:
    """Rows of the goals, and which are missed."""
    rows: list[list[str]] = []
    missed: list[str] = []

    def judge(words: str, goal: str, found: str, holds: bool) -> None:
        rows.append([words, goal, found + ("" if holds else ", **missed**")])
        if not holds:
            missed.append(f"{words} ({found})")

    second = page.results("mh01", _SENSORS, 1.0)
    if second:
        lost, end = sum(each.lost + each.lost_after for each in second), [each.end_metres for each in second]
        nees, middle = _mean(second, "nees"), float(np.median(end))
        judge("MH_01, 1 s: frames lost", "0", f"{lost:.0f}", not lost)
        judge("MH_01, 1 s: largest error, m", f"{_MH01_METRES}", f"{max(end):.3f}", max(end) <= _MH01_METRES)
        judge("MH_01, 1 s: median error, m", f"{_MH01_MEDIAN}", f"{middle:.3f}", middle <= _MH01_MEDIAN)
        judge("MH_01, 1 s: NEES in the dark", "0.5 - 2", f"{nees:.2f}", _MH01_NEES[0] <= nees <= _MH01_NEES[1])
        place = _mean(second, "place_nees")
        judge("MH_01, 1 s: NEES of the position", "0.5 - 2", f"{place:.2f}", _MH01_NEES[0] <= place <= _MH01_NEES[1])
    light, without = (page.results("mh01", method, 0.0) for method in (_SENSORS, _IMAGES))
    if light and without:
        ate, cpu = light[0].ate, light[0].cpu / without[0].cpu
        judge("MH_01 with images: ATE, mm", f"{1e3 * _MH01_ATE:g}", f"{1e3 * ate:.2f}", ate <= _MH01_ATE)
        judge("MH_01 with images: CPU by that without the sensor", "1.00", f"{cpu:.2f}", cpu <= 1.0)
    rendered = [kind for kind in page.kinds if kind != "mh01"]
    dark = [each for kind in rendered for each in page.results(kind, _SENSORS, 2.0)]
    if dark:
        share = float(np.mean([each.end_sigmas <= BOUND for each in dark]))
        judge(f"renders, 2 s: ends within {BOUND:g} sigma", f"{_WITHIN:.0%}", f"{share:.0%}", share >= _WITHIN)
    light = [each for kind in rendered for each in page.results(kind, _SENSORS, 0.0)]
    for name in ("pose", *STATES):
        values = [each.states.get(name, each.nees if name == "pose" else np.nan) for each in light]
        if np.isfinite(values).any():
            nees = float(np.nanmean(values))
            judge(f"renders with images: NEES of {name}", "0.7 - 1.4", f"{nees:.2f}", 0.7 <= nees <= 1.4)
    return rows, missed


def _dark_rows(page: InertialPage) -> Iterator[list[str]]:
    for kind in page.kinds:
        for seconds in page.seconds:
            for method in METHODS:
                results = page.results(kind, method, seconds)
                if not results:
                    continue
                yield [
                    kind,
                    f"{seconds:g}",
                    method,
                    str(len(results)),
                    *(str(sum(getattr(each, name) for each in results)) for name in ("dark", "inertial", "lost")),
                    *_median_and_worst([each.end_metres for each in results], ".3f"),
                    f"{np.median([each.end_degrees for each in results]):.2f}",
                    f"{np.mean([each.end_sigmas <= BOUND for each in results]):.0%}",
                    *(
                        number_with_error(*mean_with_error([getattr(each, name) for each in results]), ".2f")
                        for name in ("nees", "place_nees")
                    ),
                ]


def _back_rows(page: InertialPage) -> Iterator[list[str]]:
    for kind in page.kinds:
        for seconds in page.seconds:
            for method in METHODS:
                results = [each for each in page.results(kind, method, seconds) if np.isfinite(each.back)]
                back = [each.back for each in results]
                if results:
                    yield [
                        kind,
                        f"{seconds:g}",
                        method,
                        *(str(count) for count in (len(back), back.count(0), back.count(-1))),
                        f"{sum(each.lost_after for each in results):.0f}",
                        *_median_and_worst([each.after_metres for each in results], ".3f"),
                    ]


def _light_rows(page: InertialPage) -> Iterator[list[str]]:
    for kind in page.kinds:
        for method in METHODS:
            if results := page.results(kind, method, 0.0):
                yield [
                    kind,
                    method,
                    str(len(results)),
                    f"{sum(each.lost_after for each in results):.0f}",
                    *_median_and_worst([1e3 * each.ate for each in results], ".2f"),
                    number_with_error(*mean_with_error([each.nees for each in results]), ".2f"),
                    f"{_mean(results, 'cpu'):.0f}",
                    "-"
                    if method == _IMAGES
                    else " / ".join(_median_and_worst([each.known for each in results], ".1f")),
                ]


def _state_rows(page: InertialPage) -> Iterator[list[str]]:
    for kind in page.kinds:
        for seconds in (0.0, *page.seconds):
            results = [each for each in page.results(kind, _SENSORS, seconds) if each.states]
            if results:
                nees = (mean_with_error([each.states[name] for each in results]) for name in STATES)
                yield [
                    kind,
                    f"{seconds:g} s of dark" if seconds else "images",
                    str(len(results)),
                    *(number_with_error(*each, ".2f") for each in nees),
                    *_median_and_worst([each.tilt for each in results], ".2f"),
                    number(_mean(results, "tilt_sigma"), ".2f"),
                ]


def _median_and_worst(values: Sequence[float], form: str) -> tuple[str, str]:
    known = [value for value in values if np.isfinite(value)]
    return (format(float(np.median(known)), form), format(max(known), form)) if known else ("-", "-")


def _mean(results: Sequence[DarkResult], name: str) -> float:
    values = [getattr(each, name) for each in results if np.isfinite(getattr(each, name))]
    return float(np.mean(values)) if values else float("nan")
