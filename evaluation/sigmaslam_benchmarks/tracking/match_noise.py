"""The tracker with every match's own covariance beside one constant for all, tuned on renders."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np

from sigmaslam.readers import StereoSequence, open_sequence
from sigmaslam.runs.request import TrackerOptions
from sigmaslam.slam.tracker import TrackerConfig
from sigmaslam_benchmarks.rendered_camera import open_rendered
from sigmaslam_benchmarks.tracking.page import fill_page, write_page
from sigmaslam_benchmarks.tracking.sequences import REAL, REAL_NAMES
from sigmaslam_benchmarks.trial import Trial, render, rendered_truth, track_ours
from sigmaslam_synthetic.simulation import Recipe

CONSTANTS = ((0.15, 0.2), (0.2, 0.3), (0.3, 0.4), (0.5, 0.6))
"""Sigma of a place per axis and of a disparity, pixels, that are tried."""
_PRESETS = ("street", "room", "drone")
_TUNING_SEED, _TEST_SEED = 101, 102
_FRAMES = 40


@dataclass(frozen=True, slots=True)
class NoiseResult:
    """One setting on one sequence.

    Attributes:
        ate: root mean square position error after alignment, metres.
        step: median translation error from frame to frame, metres.
        nees: per degree of freedom, mean.
        nis: per degree of freedom, median over tracked frames.
        tracked, frames: frames with a pose from the images, and all after the first.
    """

    ate: float
    step: float
    nees: float
    nis: float
    tracked: int
    frames: int


def write_noise(
    path: Path, data: Path, runs: Path, workers: int, command: str, note: Callable[[str], None] = lambda text: None
) -> str:
    """Renders what is missing, tunes the constant, compares, writes the page and returns it; notes in it are kept.

    Raises:
        InputError: a sequence is missing.
    """
    for name in REAL_NAMES:
        open_sequence(data / name)
    renders: dict[int, dict[str, tuple[Path, Path]]] = {}
    for seed in (_TUNING_SEED, _TEST_SEED):
        for preset in _PRESETS:
            note(f"rendering {preset}{seed}")
            source = render(runs, Recipe(preset, _FRAMES, seed), workers)
            renders.setdefault(seed, {})[source.name] = (source, rendered_truth(source))
    note(f"tuning {len(CONSTANTS)} constants")
    tuning = {
        constant: [_track(open_rendered(source), truth, constant) for source, truth in renders[_TUNING_SEED].values()]
        for constant in CONSTANTS
    }
    chosen = min(tuning, key=lambda constant: _geometric_mean([result.ate for result in tuning[constant]]))
    results = {}
    with as_file(files("sigmaslam_synthetic") / "demo") as demo:
        sequences = {"demo (rendered)": (demo, demo / "poses.txt"), **renders[_TEST_SEED]}
        sequences |= {name: (data / name, data / name / truth) for name, truth, _ in REAL}
        for name, (source, truth) in sequences.items():
            note(name)
            opener = open_sequence if data in source.parents else open_rendered
            results[name] = _track(opener(source), truth, None), _track(opener(source), truth, chosen)
    return write_page(path, _page(command, tuning, chosen, results))


def _track(source: StereoSequence, truth: Path, constant: tuple[float, float] | None) -> NoiseResult:
    tracker = TrackerOptions(config=TrackerConfig(constant_sigma=constant))
    result = Trial(source, truth, partial(track_ours, tracker=tracker)).run()
    evaluation = result.evaluation
    assert evaluation.nees is not None
    return NoiseResult(
        evaluation.ate.rmse,
        float(np.median(evaluation.rpe.translations)),
        evaluation.nees.mean,
        float(np.median(result.nis)) if len(result.nis) else float("nan"),
        int(result.tracked.sum()),
        len(result.table) - 1,
    )


def _page(
    command: str,
    tuning: dict[tuple[float, float], list[NoiseResult]],
    chosen: tuple[float, float],
    results: dict[str, tuple[NoiseResult, NoiseResult]],
) -> str:
    tried = []
    for constant, trials in tuning.items():
        ate, nees = (_geometric_mean([getattr(each, name) for each in trials]) for name in ("ate", "nees"))
        mark = " (chosen)" if constant == chosen else ""
        tried.append([f"{constant[0]} / {constant[1]}{mark}", f"{1e3 * ate:.2f}", f"{nees:.2f}"])
    rows = [
        [
            name,
            f"{own.tracked} / {same.tracked} of {own.frames}",
            f"{own.ate:.4f} / {same.ate:.4f}",
            f"{own.ate / same.ate:.2f}",
            f"{1e3 * own.step:.2f} / {1e3 * same.step:.2f}",
            f"{own.nees:.2f} / {same.nees:.2f}",
            f"{own.nis:.2f} / {same.nis:.2f}",
        ]
        for name, (own, same) in results.items()
    ]
    means = []
    for label, names in (("all", list(results)), ("renders", [n for n in results if n not in REAL_NAMES])):
        ratios = (
            _geometric_mean(
                [getattr(own, field) / getattr(same, field) for own, same in (results[name] for name in names)]
            )
            for field in ("ate", "step", "nees")
        )
        means.append((label, *(f"{ratio:.2f}" for ratio in ratios)))
    return fill_page("noise", command, frames=_FRAMES, seed=_TUNING_SEED, tried=tried, rows=rows, means=means)


def _geometric_mean(values: Sequence[float]) -> float:
    return float(np.exp(np.mean(np.log(values))))
