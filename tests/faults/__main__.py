"""Runs all faults and counts what is survived: `python -m tests.faults --out docs/known-limits.md`.

Each fault is put into a good input, and the command line runs on it, with --processes in a process of its own, whose
memory is bounded. Real data are those of SIGMASLAM_DATA; without it their faults are left out.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
import tempfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from sigmaslam.bounded_files import shorten
from sigmaslam_benchmarks.source_description import describe_source
from sigmaslam_benchmarks.tracking.page import fill_page, write_page
from tests.faults.case import Case, Runner, Verdict, judge
from tests.faults.running import attempt, run_in_process, run_in_this_process
from tests.faults.table import CASES

_LONGEST = 230


@dataclass(frozen=True, slots=True)
class Result:
    """What became of a fault.

    Attributes:
        case: the fault.
        verdict: on it.
        code: exit code.
        said: of what was written, the part with the words that the case expects; else the reason of the verdict.
    """

    case: Case
    verdict: Verdict
    code: int
    said: str


def run_case(case: Case, runner: Runner) -> Result:
    """Runs a case in a folder that is removed."""
    with tempfile.TemporaryDirectory(prefix="sigmaslam-fault-") as name:
        folder = Path(name)
        outcome = attempt(case, folder, runner)
        verdict, reason = judge(case, outcome, folder)
        said = _excerpt(_without_folders(outcome.text), case.says)
        return Result(case, verdict, outcome.code, said if verdict == Verdict.GOOD else _without_folders(reason))


def _without_folders(text: str) -> str:
    """The text without the folders of this machine and without progress bars."""
    text = re.sub(r" frames [━╸╺ ]+ .*?(tracking|starting|lost|relocalised)(?= |$)", "", text)
    return re.sub(r"/\S*?(?:sigmaslam-faults?-[^/\s]*|synthetic/sigmaslam_synthetic/demo)(?:/|(?=[\s:]))", "", text)


def _excerpt(text: str, words: tuple[str, ...]) -> str:
    """The sentence of the text that has the first of the words, and what follows it."""
    place = text.find(words[0]) if words else 0
    starts = [match.end() for match in re.finditer(r"WARNING |error: |html |Nothing was tracked: |\. ", text[:place])]
    return shorten(text[starts[-1] if starts else 0 :], _LONGEST)


def write_limits(path: Path, results: list[Result], command: str) -> str:
    """Writes the page of results and returns it."""
    counts = Counter(result.verdict for result in results)
    tried = [result for result in results if result.case.first is not None]
    before = Counter(result.case.first for result in tried)
    after = Counter(result.verdict for result in tried)
    groups = Counter(result.case.group for result in results)
    missed = [
        (each.case.group, each.case.name, each.verdict, str(each.code), _cell(each.said))
        for each in results
        if each.verdict != Verdict.GOOD
    ]
    page = fill_page(
        "faults",
        command,
        good=counts[Verdict.GOOD],
        results=results,
        verdicts=list(Verdict),
        counts=[
            ("all faults", *(str(counts[verdict]) for verdict in Verdict)),
            (f"{len(tried)} of them, in a first trial", *(str(before[verdict]) for verdict in Verdict)),
            ("these, now", *(str(after[verdict]) for verdict in Verdict)),
        ],
        groups=[f"{group} {count}" for group, count in groups.items()],
        missed=missed,
    )
    return write_page(path, page)


def _cell(said: str) -> str:
    return said.replace("|", "\\|").replace("<", "&lt;").replace("[", "\\[")


def main() -> int:
    """Runs the cases; exit code 1 if a verdict is another than expected."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults", description=__doc__)
    parser.add_argument("--out", type=Path, help="Markdown page to write")
    parser.add_argument("--only", nargs="*", default=[], help="groups, or parts of names; all by default")
    parser.add_argument("--processes", action="store_true", help="a process for each, which takes thrice the time")
    arguments = parser.parse_args()
    chosen = [
        case
        for case in CASES
        if (not arguments.only or any(word in (case.group, *case.name.split(", ")) for word in arguments.only))
        and (case.data is None or (Path(os.environ.get("SIGMASLAM_DATA") or "/nowhere") / case.data).is_dir())
    ]
    results: list[Result] = []
    describe_source()  # now: the sources may change while they run
    command = "python -m tests.faults" + (f" --out {arguments.out}" if arguments.out else "")
    command += " --processes" if arguments.processes else ""
    for case in chosen:
        result = run_case(case, run_in_process if arguments.processes else run_in_this_process)
        results.append(result)
        mark = "" if result.verdict == case.expected else "  <- expected: " + case.expected
        print(f"{result.verdict:14} {result.code:4} {case.group}: {case.name}{mark}\n    {result.said}", flush=True)
    counts = Counter(result.verdict for result in results)
    print(f"{counts[Verdict.GOOD]} of {len(results)} survived; {', '.join(f'{counts[v]} {v}' for v in Verdict)}")
    if arguments.out is not None:
        write_limits(arguments.out, results, command)
    return int(any(result.verdict != result.case.expected for result in results))


if __name__ == "__main__":
    sys.exit(main())
