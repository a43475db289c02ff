"""Fuzzes every reader: `python -m tests.fuzz --executions 1000000`.

Each execution changes a small good file and reads it. A reader may read it, or refuse it by a SigmaSlamError that names
the file in a short message; anything else, and more than five seconds, is a crash. Targets get equal shares of the
time: the slow ones fewer executions. The same seed gives the same files.
"""

from __future__ import annotations

import argparse
import logging
import os
import resource
import sys
import tempfile
import time
import warnings
from pathlib import Path
from random import Random

from tests.support.fuzz_targets import Tally, as_json, make_targets

_MEMORY_BYTES = 6 << 30
_ROUND = 50


def main() -> int:
    """Runs the targets in turn; exit code 1 if there are crashes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--executions", type=int, default=100_000, help="of all targets together")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="end after so long")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--targets", nargs="*", help="names; all by default")
    parser.add_argument("--crashes", type=Path, help="folder that gets the files that crash a reader")
    arguments = parser.parse_args()
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("ignore")
    # What takes more memory becomes a MemoryError, and so a crash.
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY_BYTES, _MEMORY_BYTES))
    # Libraries that decode images write to the terminal, beside Python.
    sys.stderr = os.fdopen(os.dup(2), "w")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    shared = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=shared if shared.is_dir() else None) as name:
        folder = Path(name)
        targets = make_targets(folder)
        chosen = [targets[each] for each in arguments.targets or targets]
        tallies = {target.name: Tally() for target in chosen}
        spent = dict.fromkeys(tallies, 0.0)
        began = time.perf_counter()
        while (done := sum(tally.executions for tally in tallies.values())) < arguments.executions:
            if time.perf_counter() - began > arguments.seconds:
                break
            # The target that has had the least time.
            target = min(chosen, key=lambda each: spent[each.name])
            tally, since = tallies[target.name], time.perf_counter()
            for _ in range(min(_ROUND, arguments.executions - done)):
                random = Random(f"{arguments.seed} {target.name} {tally.executions}")
                tally.run(target, target.changed(random), folder)
            spent[target.name] += time.perf_counter() - since
        return _report(tallies, time.perf_counter() - began, arguments.crashes)


def _report(tallies: dict[str, Tally], seconds: float, crashes: Path | None) -> int:
    for name, tally in tallies.items():
        print(
            f"{name:20} {tally.executions:8} executions, {tally.read:7} read, {tally.refused:7} refused, slowest "
            f"{tally.slowest:5.2f} s, {sum(crash.count for crash in tally.crashes.values()):5} crashes"
        )
        for number, crash in enumerate(tally.crashes.values()):
            print(f"    {crash.count:5} {crash.kind}\n          {as_json(crash.content)}")
            if crashes is not None:
                crashes.mkdir(parents=True, exist_ok=True)
                (crashes / f"{name.replace(' ', '_')}-{number}").write_bytes(crash.content)
    total, kinds = (
        sum(tally.executions for tally in tallies.values()),
        sum(len(tally.crashes) for tally in tallies.values()),
    )
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"{total} executions in {seconds:.0f} s, {kinds} kinds of crashes, at most {peak:.0f} MB")
    return 1 if kinds else 0


if __name__ == "__main__":
    sys.exit(main())
