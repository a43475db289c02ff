"""The page of the benchmark `calibration`."""

from __future__ import annotations

from collections.abc import Iterator

from sigmaslam_benchmarks.live.driver_faults import NO_FAULT
from sigmaslam_benchmarks.live.judge import Judgement
from sigmaslam_benchmarks.live.live_page import LivePage, sentences_of, words_cell
from sigmaslam_benchmarks.live.recordings import Recording
from sigmaslam_benchmarks.tracking.page import fill_page, number


def format_calibration_page(page: LivePage) -> str:
    """The page as Markdown."""
    recordings = page.recordings
    return fill_page(
        "calibration",
        page.command,
        frames=page.frames,
        recordings=[recording.name for recording in recordings],
        open=page.asked - len(page.found),
        tables=[
            (recording.name, method, list(_rows(page, recording, method)))
            for recording in recordings
            for method in page.methods
        ],
        words=[(recording.name, list(_words(page, recording))) for recording in recordings],
        left_out=sorted({each for each in page.found.values() if isinstance(each, str)}),
    )


def _rows(page: LivePage, recording: Recording, method: str) -> Iterator[list[str]]:
    good = page.found.get((recording, method, NO_FAULT))
    for case in page.cases:
        result = page.found.get((recording, method, case))
        if not isinstance(result, Judgement):
            continue
        before = good if isinstance(good, Judgement) else result
        statuses = ", ".join(f"{count} {status}" for status, count in result.statuses.items() if status != "starting")
        yield [
            case,
            statuses,
            _errors(result),
            f"{number(before.ate, '.3f')} -> {number(result.ate, '.3f')}",
            f"{number(100 * before.length, '+.2f')} -> {number(100 * result.length, '+.2f')}",
            number(result.end_metres, ".3f"),
            number(result.end_sigmas, ".1f"),
            str(page.silent(recording, method, result)),
        ]


def _words(page: LivePage, recording: Recording) -> Iterator[tuple[str, str]]:
    """What the first method says of each case."""
    for case in page.cases:
        result = page.found.get((recording, page.methods[0], case))
        if isinstance(result, Judgement):
            yield case, words_cell(sentences_of(result))


def _errors(result: Judgement) -> str:
    """What was estimated, and what is true in brackets."""
    learned = {name: f"{value:+.3g} ± {sigma:.2g}" for name, (value, sigma) in result.learned.items()}
    names = dict.fromkeys([*learned, *result.true_errors])
    cells = [f"{name} {learned.get(name, '-')} ({result.true_errors.get(name, 0.0):+.3g})" for name in names]
    return "; ".join(cells)
