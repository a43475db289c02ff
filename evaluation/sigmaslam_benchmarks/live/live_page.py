"""The page of the benchmark `live`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sigmaslam_benchmarks.live.driver_faults import FAULTS, NO_FAULT
from sigmaslam_benchmarks.live.judge import Judgement
from sigmaslam_benchmarks.live.recordings import Recording
from sigmaslam_benchmarks.tracking.page import fill_page, number

_COMMON = ("tracking", "doubtful", "ambiguous", "relocalised", "lost", "skipped")
_UNTOLD = ("starting", *_COMMON)


@dataclass(frozen=True, slots=True)
class LivePage:
    """What the page is made of.

    Attributes:
        command: that makes the page.
        cases, methods: in the order of the page.
        found: a judgement, or why there is none, by recording, method and case; what is missing is left out.
        frames: of each recording that were asked for.
        asked: number of runs that were asked for.
    """

    command: str
    cases: Sequence[str]
    methods: Sequence[str]
    found: Mapping[tuple[Recording, str, str], Judgement | str]
    frames: int
    asked: int

    @property
    def recordings(self) -> list[Recording]:
        """Those with a result."""
        return list(dict.fromkeys(recording for recording, _, _ in self.found))

    def judgements(self, method: str, case: str) -> dict[Recording, Judgement]:
        """Of a method on a case."""
        results = {recording: self.found.get((recording, method, case)) for recording in self.recordings}
        return {recording: each for recording, each in results.items() if isinstance(each, Judgement)}

    def silent(self, recording: Recording, method: str, result: Judgement) -> int:
        """As of `Judgement.silent`."""
        good = self.found.get((recording, method, NO_FAULT))
        return result.silent(None if recording.exact or not isinstance(good, Judgement) or good is result else good)


def format_page(page: LivePage) -> str:
    """The page as Markdown."""
    recordings = page.recordings
    rendered = [recording for recording in recordings if recording.exact]
    return fill_page(
        "live",
        page.command,
        frames=page.frames,
        seeds=sorted({recording.seed for recording in rendered}),
        recordings=[recording.name for recording in recordings],
        open=page.asked - len(page.found),
        methods=[(method, *_totals(page, method)) for method in page.methods],
        tables=[(method, list(_case_rows(page, method))) for method in page.methods],
        details=[(recording.name, list(_recording_rows(page, recording))) for recording in recordings],
        words=[(recording.name, list(words_of(page, recording))) for recording in _one_of_each(recordings)],
        left_out=sorted({each for each in page.found.values() if isinstance(each, str)}),
    )


def _totals(page: LivePage, method: str) -> tuple[int, int, int, str]:
    """Runs, frames that are judged, silently wrong ones, and the cases that have such."""
    wrong: Counter[str] = Counter()
    runs = judged = 0
    for case in page.cases:
        for recording, result in page.judgements(method, case).items():
            runs += 1
            judged += result.judged
            wrong[case] += page.silent(recording, method, result)
    return runs, judged, wrong.total(), ", ".join(f"{case} ({count})" for case, count in wrong.most_common() if count)


def _case_rows(page: LivePage, method: str) -> Iterator[list[str]]:
    for case in page.cases:
        results = page.judgements(method, case)
        if not results:
            continue
        silent = {recording: page.silent(recording, method, result) for recording, result in results.items()}
        rendered = [result for recording, result in results.items() if recording.exact]
        sizes = [max_of([result.sigmas for result in rendered]), max_of([result.metres for result in rendered])]
        sizes += [max_of([result.away_sigmas for result in results.values()])]
        sizes += [max_of([result.away_metres for result in results.values()])]
        yield [
            case,
            FAULTS[case].words,
            *_statuses(list(results.values())),
            _bold(sum(silent.values())),
            f"{sum(count > 0 for count in silent.values())} of {len(silent)}",
            *sizes,
        ]


def _recording_rows(page: LivePage, recording: Recording) -> Iterator[list[str]]:
    for method in page.methods:
        for case in page.cases:
            result = page.found.get((recording, method, case))
            if not isinstance(result, Judgement):
                continue
            yield [
                case,
                method,
                *_statuses([result]),
                _bold(page.silent(recording, method, result)),
                max_of([result.sigmas]),
                max_of([result.metres]),
                max_of([result.end_metres]),
                max_of([result.away_sigmas]),
                max_of([result.away_metres]),
            ]


def _statuses(results: Sequence[Judgement]) -> list[str]:
    """Cells of counts: the common ones, and the others by name."""
    counts: Counter[str] = Counter()
    for result in results:
        counts.update(result.statuses)
    others = ", ".join(f"{count} {status}" for status, count in counts.items() if status not in _UNTOLD)
    return [*(str(counts[status]) for status in _COMMON), others or "-"]


def words_of(page: LivePage, recording: Recording) -> Iterator[tuple[str, str]]:
    """What the first method says of each case."""
    for case in page.cases:
        result = page.found.get((recording, page.methods[0], case))
        if isinstance(result, Judgement):
            said = [*result.said, *([f"refused: {result.refused}"] if result.refused else [])]
            yield case, " / ".join(said).replace("|", "\\|").replace("\n", " ") or "nothing"


def _one_of_each(recordings: Sequence[Recording]) -> list[Recording]:
    first: dict[str, Recording] = {}
    for recording in recordings:
        first.setdefault(recording.kind, recording)
    return list(first.values())


def max_of(values: Sequence[float]) -> str:
    """The largest number as a cell."""
    known = [value for value in values if np.isfinite(value)]
    return number(max(known, default=np.nan), ".3g")


def _bold(count: int) -> str:
    return f"**{count}**" if count else "0"
