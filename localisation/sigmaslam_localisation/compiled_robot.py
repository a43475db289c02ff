"""Steps of robots as machine code, where there is a compiler: the same steps, a hundred times as fast.

A step is traced once for each number of sightings that is usual. What was traced is kept as source in the user's cache,
by all that it is made of, so that later runs neither trace nor compile.
"""

import hashlib
import logging
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

import sigmaslam_filters
from sigmaslam.files import atomic_write_text
from sigmaslam_filters import Gaussian
from sigmaslam_localisation.robot_step import RobotStep

_log = logging.getLogger(__name__)
SHORTEST = 3500
"""Steps of torch, in two passes, that take about as long as tracing and compiling do the first time: a minute."""
WIDTHS = (0, 2, 8)
"""Sightings at a time that there is a program for: of ten steps that see anything nine see one or two."""
_MOST_OPERATIONS = 200_000

Found = tuple[Gaussian, tuple[Tensor, ...]]


def run_compiled(
    robot: RobotStep,
    prior: Gaussian,
    scale: Tensor,
    moves: Sequence[Tensor],
    sights: Sequence[Tensor],
    tell: Callable[[float], None] | None,
) -> Found | None:
    """All steps of all robots; None where they are few, cannot be compiled, or one fails: torch says what is wrong.

    Args:
        robot: what is done.
        prior: (B,) beliefs.
        scale: (B, m) variance of the noise at the start.
        moves: (K, B, ...) arguments of `RobotStep.move`.
        sights: (K, B, L, ...) arguments of `RobotStep.look`; a step's sightings come first among its slots.
        tell: called with the share that is done.
    Returns:
        The last belief; of each step (K, B) mean, covariance and scale, NIS, weight, innovation, log-likelihood.
    """
    value = sights[0]
    (K, B, L, m), n, p = value.shape, prior.covariance.shape[-1], prior.mean.shape[-1]
    if K < SHORTEST or WIDTHS[-1] < L:
        return None
    fills = torch.nan, 0.0, 1.0, 1.0
    more = [0, WIDTHS[-1] - L]
    pairs = zip(sights, fills, strict=True)
    sights = [torch.nn.functional.pad(each, [0, 0] * (each.ndim - 3) + more, value=fill) for each, fill in pairs]
    from torch._inductor.exc import CppCompileError, InvalidCxxCompiler

    from sigmaslam_filters.compiler.scalar_sequence import CompiledStep, Plan, load_driver, run_sequence
    from sigmaslam_filters.compiler.scalar_step import ScalarStepError

    seen = (~value.isnan().any(dim=-1)).sum(dim=-1)
    kind = torch.bucketize(seen, torch.tensor(WIDTHS))
    sizes = [(p + m,), (n, n), (), WIDTHS[-1:], WIDTHS[-1:], (WIDTHS[-1], m), ()]
    results = [(size, torch.bool if k == 2 else torch.float64) for k, size in enumerate(sizes)]
    state = torch.cat([prior.mean, scale], dim=-1)
    try:
        load_driver()  # says at once whether there is a compiler
        steps = []
        for width in WIDTHS:
            given = [each[0, 0] for each in moves] + [each[0, 0, :width] for each in sights if width]
            source = _source(replace(robot, slots=width), p, [state[0], prior.covariance[0], *given])
            steps.append(CompiledStep(partial(str, source), range(3 if width == 0 else 7)))
        rows = []
        for b in range(B):
            inputs, index = [], torch.zeros(K, dtype=torch.int64)
            for k, width in enumerate(WIDTHS):
                chosen = (kind[:, b] == k).nonzero()[:, 0]
                index[chosen] = torch.arange(len(chosen))
                inputs.append([each[chosen, b, None] for each in moves])
                inputs[-1] += [each[chosen, b, None, :width] for each in sights if width]
            plan = Plan(steps, kind[:, b].contiguous(), index, [len(each) for each in inputs], results)
            rows.append(run_sequence(plan, [state[b : b + 1], prior.covariance[b : b + 1]], inputs))
            if tell is not None:
                tell((b + 1) / B)
    except (ScalarStepError, CppCompileError, InvalidCxxCompiler, OSError) as error:
        _log.warning("steps are not compiled, so this takes many times as long: %s", error)
        return None
    both, covariance, healthy, *said, log_likelihood = (torch.cat(column, dim=1) for column in zip(*rows, strict=True))
    if not bool(healthy.all()):
        return None
    mean, said = both[..., :p], [each[:, :, :L] for each in said]
    return Gaussian(mean[-1], covariance[-1]), (mean, covariance, both[..., p:], *said, log_likelihood)


def _source(robot: RobotStep, points: int, arguments: list[Tensor]) -> str:
    """The step in C++, from the cache if it is there."""
    from sigmaslam_filters.compiler.scalar_step import ScalarStep

    shapes = [tuple(each.shape) for each in arguments]
    whole = hashlib.sha256(f"{torch.__version__} {robot!r} {shapes}".encode())
    for package in (Path(sigmaslam_filters.__file__).parent, Path(__file__).parent):
        for file in sorted(package.rglob("*.py")):
            whole.update(file.read_bytes())
    folder = Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")).expanduser() / "sigmaslam"
    path = folder / f"robot_step_{whole.hexdigest()[:32]}.cpp"
    if path.is_file():
        return path.read_text()
    # 165,000 statements: -O3, which is the rule, takes three times as long to compile them.
    source = '#pragma GCC optimize("O1")\n' + ScalarStep(_flat(robot, points), arguments, _MOST_OPERATIONS).source()
    with suppress(OSError):  # the next run writes it anew
        folder.mkdir(parents=True, exist_ok=True)
        atomic_write_text(path, source)
    return source


def _flat(robot: RobotStep, points: int) -> Callable[..., tuple[Tensor, ...]]:
    """The step of one robot, whose state is the mean and the scale of the noise, and the covariance."""
    held = replace(robot, bayes=replace(robot.bayes, on_failure="hold"))

    def step(state: Tensor, covariance: Tensor, path: Tensor, duration: Tensor, *sight: Tensor) -> tuple[Tensor, ...]:
        mean, scale = state[..., :points], state[..., points:]
        moved = held.move(Gaussian(mean, covariance, is_symmetric=True), path, duration)
        if not sight:
            return torch.cat([moved.belief.mean, scale], dim=-1), moved.belief.covariance, moved.healthy
        belief, learned, *said = held.look(moved.belief, scale, *sight)
        healthy = moved.healthy & torch.isfinite(belief.mean.sum())
        return torch.cat([belief.mean, learned], dim=-1), belief.covariance, healthy, *said

    return step
