"""Trials: what they read back, and which of their figures are used again."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest

from sigmaslam.errors import InputError
from sigmaslam.slam.tracker import TrackerConfig
from sigmaslam_benchmarks import trial
from sigmaslam_benchmarks.tracking.stereo_peers import track_with_peer
from sigmaslam_benchmarks.trial import Trial, TrialCache
from sigmaslam_synthetic import render_sequence
from sigmaslam_synthetic.simulation import Recipe

RECIPE, CONFIG = Recipe("room", 3, 7), TrackerConfig()


def test_a_baseline_leaves_a_run_folder_without_a_map(demo_sequence: Path, tmp_path: Path):
    method = partial(track_with_peer, name="klt-pnp")
    result = Trial(demo_sequence, demo_sequence / "poses.txt", method).run(tmp_path / "run")
    assert len(result.trajectory) == len(result.table) == 40
    assert result.tracked.sum() == 39
    assert result.point_map == {}
    assert result.evaluation.ate.rmse < 0.01
    assert np.isnan(result.nis).all()
    assert trial.read_trial(tmp_path / "run", None).evaluated is None


def test_figures_are_used_again_for_the_same_recipe_configuration_and_code_alone(tmp_path: Path):
    cache = TrialCache(tmp_path, "code")
    assert cache.read(RECIPE, "ours", CONFIG) is None
    cache.write(RECIPE, "ours", CONFIG, {"ate": 0.1})
    assert cache.read(RECIPE, "ours", CONFIG) == {"ate": 0.1}
    assert cache.read(RECIPE, "ours", TrackerConfig(iterations=1)) is None
    assert cache.read(Recipe("room", 4, 7), "ours", CONFIG) is None
    assert TrialCache(tmp_path, "other code").read(RECIPE, "ours", CONFIG) is None


def test_a_file_that_is_no_result_is_named(tmp_path: Path):
    (tmp_path / "room7-ours.json").write_text("torn")
    with pytest.raises(InputError, match=r"room7-ours\.json is no result"):
        TrialCache(tmp_path, "code").read(RECIPE, "ours", CONFIG)


def test_a_render_is_kept_for_the_same_recipe_and_renderer_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    rendered = []
    monkeypatch.setattr(render_sequence, "write_sequence", lambda out, *_, **__: rendered.append(out))
    first = trial.render(tmp_path, RECIPE, 1)
    assert trial.render(tmp_path, RECIPE, 1) == first != trial.render(tmp_path, Recipe("room", 3, 8), 1)
    monkeypatch.setattr(trial, "hash_renderer", lambda: "another renderer")
    assert trial.render(tmp_path, RECIPE, 1) != first
    assert len(set(rendered)) == 3
