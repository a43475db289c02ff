"""Trials: what they read back, and which of their figures are used again."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from sigmaslam.errors import InputError
from sigmaslam_benchmarks import trial
from sigmaslam_benchmarks.tracking import trial_pool
from sigmaslam_benchmarks.tracking.stereo_peers import track_with_peer
from sigmaslam_benchmarks.tracking.trial_pool import SequenceTrials, TrialKind
from sigmaslam_benchmarks.trial import Trial
from sigmaslam_synthetic import render_sequence
from sigmaslam_synthetic.simulation import Recipe
from tests.support.klt_trials import ErrorFigures

RECIPE = Recipe("room", 3, 7)


def test_a_baseline_leaves_a_run_folder_without_a_map(demo_sequence: Path, tmp_path: Path):
    method = partial(track_with_peer, name="klt-pnp")
    result = Trial(demo_sequence, demo_sequence / "poses.txt", method).run(tmp_path / "run")
    assert len(result.trajectory) == len(result.table) == 40
    assert result.tracked.sum() == 39
    assert result.point_map == {}
    assert result.evaluation.ate.rmse < 0.01
    assert np.isnan(result.nis).all()
    assert trial.read_trial(tmp_path / "run", None).evaluated is None


@pytest.fixture
def trials(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> SequenceTrials:
    monkeypatch.setattr(trial_pool, "render", lambda folder, recipe, workers: folder)
    kind = TrialKind(["ours"], lambda source, recipe, method: ErrorFigures(0.1, [], []), lambda: "code")
    return SequenceTrials(kind, RECIPE, tmp_path, "code")


def test_figures_are_used_again_for_the_same_recipe_and_code_alone(trials: SequenceTrials):
    assert trials.read("ours") is None
    trials.make()
    assert trials.read("ours") == {"ate": 0.1, "translations": [], "rotations": []}
    assert replace(trials, recipe=Recipe("room", 4, 7)).read("ours") is None
    assert replace(trials, code="other code").read("ours") is None


def test_a_file_that_is_no_result_is_named(trials: SequenceTrials):
    (trials.folder / "room7-ours.json").write_text("torn")
    with pytest.raises(InputError, match=r"room7-ours\.json is no result"):
        trials.read("ours")


def test_a_render_is_kept_for_the_same_recipe_and_renderer_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    rendered = []
    monkeypatch.setattr(render_sequence, "write_sequence", lambda out, *_, **__: rendered.append(out))
    first = trial.render(tmp_path, RECIPE, 1)
    assert trial.render(tmp_path, RECIPE, 1) == first != trial.render(tmp_path, Recipe("room", 3, 8), 1)
    monkeypatch.setattr(trial, "hash_renderer", lambda: "another renderer")
    assert trial.render(tmp_path, RECIPE, 1) != first
    assert len(set(rendered)) == 3
