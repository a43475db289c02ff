"""Fuzzes every reader: `python -m tests.fuzz --executions 1000000`.

Each execution changes a small good file and reads it. A reader may read it, or refuse it by a SigmaSlamError that names
the file in a short message; anything else, and more than five seconds, is a crash. Targets get equal shares of the
time: the slow ones fewer executions. The same seed gives the same files. With `--engine atheris` (pip install atheris)
changes that reach new code are kept and changed further; the executions are then shared equally.
"""

from __future__ import annotations

import argparse
import logging
import os
import resource
import subprocess
import sys
import tempfile
import time
import warnings
from contextlib import nullcontext
from pathlib import Path
from random import Random

if "atheris" in sys.argv:
    import atheris

    # Modules are instrumented as they are imported, so that changes that reach new code are told apart.
    _instrumented = atheris.instrument_imports(include=["sigmaslam", "yaml"])
else:
    _instrumented = nullcontext()
with _instrumented:
    from tests.support.fuzz_targets import FuzzTarget, Tally, as_json, make_targets

_MEMORY_BYTES = 6 << 30
_ROUND = 50


def main() -> int:
    """Runs the targets in turn; exit code 1 if there are crashes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--executions", type=int, default=100_000, help="of all targets together")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="end after so long")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--targets", nargs="*", help="names; all by default")
    parser.add_argument("--engine", choices=("random", "atheris"), default="random")
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
        if arguments.engine == "atheris" and len(chosen) > 1:
            return _run_each(chosen, arguments)
        if arguments.engine == "atheris":
            _fuzz_with_atheris(chosen[0], arguments, folder)
        began = time.perf_counter()
        tallies = _fuzz(chosen, arguments, folder)
        return _report(tallies, time.perf_counter() - began, arguments.crashes)


def _fuzz(chosen: list[FuzzTarget], arguments: argparse.Namespace, folder: Path) -> dict[str, Tally]:
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
    return tallies


def _run_each(chosen: list[FuzzTarget], arguments: argparse.Namespace) -> int:
    """A process for each target, as atheris ends its own."""
    codes = []
    for target in chosen:
        command = [sys.executable, "-m", "tests.fuzz", "--engine", "atheris", "--targets", target.name]
        command += ["--executions", str(arguments.executions // len(chosen)), "--seed", str(arguments.seed)]
        command += ["--seconds", str(arguments.seconds / len(chosen))]
        command += [] if arguments.crashes is None else ["--crashes", str(arguments.crashes)]
        codes.append(subprocess.run(command, check=False).returncode)
    return max(codes)


def _fuzz_with_atheris(target: FuzzTarget, arguments: argparse.Namespace, folder: Path) -> None:
    """Reports and ends the process."""
    tally, began = Tally(), time.perf_counter()
    corpus = folder / "corpus"
    corpus.mkdir()
    for number, seed in enumerate(target.seeds):
        (corpus / str(number)).write_bytes(seed)

    def end() -> None:
        code = _report({target.name: tally}, time.perf_counter() - began, arguments.crashes)
        sys.stdout.flush()
        os._exit(code)

    def execute(content: bytes) -> None:
        tally.run(target, content, folder)
        if tally.executions >= arguments.executions or time.perf_counter() - began > arguments.seconds:
            end()

    def change(content: bytes, longest: int, seed: int) -> bytes:
        return target.changed(Random(seed), content)[:longest]

    atheris.Setup(
        [sys.argv[0], f"-seed={arguments.seed + 1}", "-max_len=200000", str(corpus)], execute, custom_mutator=change
    )
    atheris.Fuzz()


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
    total = sum(tally.executions for tally in tallies.values())
    kinds = sum(len(tally.crashes) for tally in tallies.values())
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"{total} executions in {seconds:.0f} s, {kinds} kinds of crashes, at most {peak:.0f} MB")
    return 1 if kinds else 0


if __name__ == "__main__":
    sys.exit(main())
