"""The page of the benchmark `live`."""

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sigmaslam_benchmarks.live.driver_faults import FAULTS, NO_FAULT
from sigmaslam_benchmarks.live.judge import Judgement
from sigmaslam_benchmarks.live.recordings import Recording
from sigmaslam_benchmarks.tracking.page import fill_page, number

# In the order of the page; a starting frame has no pose yet.
_STATUSES = ("tracking", "doubtful", "ambiguous", "relocalised", "lost", "skipped", "refused")


@dataclass(frozen=True, slots=True)
class LivePage:
    """What the page is made of.

    Attributes:
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
        words=list(_words(page)),
        left_out=sorted({each for each in page.found.values() if isinstance(each, str)}),
    )


def _totals(page: LivePage, method: str) -> tuple[int, int, int]:
    """Runs, frames that are judged, and silently wrong ones."""
    results = [each for case in page.cases for each in page.judgements(method, case).items()]
    silent = sum(page.silent(recording, method, result) for recording, result in results)
    return len(results), sum(result.judged for _, result in results), silent


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
            _statuses(results.values()),
            _bold(sum(silent.values())),
            f"{sum(count > 0 for count in silent.values())} of {len(silent)}",
            *sizes,
        ]


def _words(page: LivePage) -> Iterator[tuple[str, str]]:
    """What the first method says of most recordings with a fault and not of most good frames, and of how many."""
    usual = _sentences(page.judgements(page.methods[0], NO_FAULT).values())
    for case in page.cases:
        results = page.judgements(page.methods[0], case).values()
        said = {
            key: f"{words} ({count} of {len(results)})"
            for key, (words, count) in _sentences(results).items()
            if 2 * usual.get(key, ("", 0))[1] < len(results) < 2 * count and "framestracked" not in key
        }
        # Of a warning and the summary that repeats it one is enough.
        words = [words for key, words in said.items() if not any(key in other for other in said if other != key)]
        if results:
            yield case, words_cell(words)


def sentences_of(result: Judgement) -> list[str]:
    """What was said of a run, and why it broke off."""
    return [*result.said, *([f"refused: {result.refused}"] if result.refused else [])]


def words_cell(sentences: Iterable[str]) -> str:
    """Sentences as one cell."""
    return " / ".join(sentences).replace("|", "\\|").replace("\n", " ") or "nothing"


def _sentences(results: Iterable[Judgement]) -> dict[str, tuple[str, int]]:
    """By sentence without its numbers: the first one, and how many results have it."""
    found: dict[str, tuple[str, int]] = {}
    for result in results:
        keys = {re.sub(r"[-+]?\d+(\.\d+)?|\W", "", each).lower(): each for each in sentences_of(result)}
        for key, words in keys.items():
            first, count = found.get(key, (words, 0))
            found[key] = first, count + 1
    return found


def _statuses(results: Iterable[Judgement]) -> str:
    """Counts of the frames by status; others than those of the page come last."""
    counts: Counter[str] = Counter()
    for result in results:
        counts.update(result.statuses)
    order = [*_STATUSES, *(status for status in counts if status not in ("starting", *_STATUSES))]
    return ", ".join(f"{counts[status]} {status}" for status in order if counts[status])


def max_of(values: Sequence[float]) -> str:
    """The largest number as a cell."""
    known = [value for value in values if np.isfinite(value)]
    return number(max(known, default=np.nan), ".3g")


def _bold(count: int) -> str:
    return f"**{count}**" if count else "0"
