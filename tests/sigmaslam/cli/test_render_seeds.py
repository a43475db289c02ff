"""`sigmaslam train render --seeds`: a sequence of each seed, and ranges that are none."""

from pathlib import Path
from typing import Any

import pytest

from sigmaslam_synthetic import render_sequence
from tests.support.commands import assert_refused, run_here


@pytest.fixture
def rendered(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Folder, recipe, truth and address of what would be rendered; the one of seed 13 fails."""
    written: list[Any] = []

    def run_jobs(work, asked, workers, ended, ray, gpus):
        for recipe in asked:
            written.append((*work(recipe), ray))
            ended(recipe, ValueError("unlucky") if recipe.seed == 13 else 0)

    monkeypatch.setattr(render_sequence, "run_jobs", run_jobs)
    monkeypatch.setattr(render_sequence, "write_sequence", lambda out, recipe, truth, device: (out, recipe, truth))
    return written


def test_each_seed_has_its_folder_and_the_options_of_all(rendered: list[Any], tmp_path: Path):
    out = tmp_path / "out"
    done = run_here(
        "train", "render", "room", "--seeds", "100-102", "--out", out, "--frames", "5", "--ray", "host:6379"
    )
    assert done.returncode == 0
    assert [folder for folder, *_ in rendered] == [out / f"room{seed}" for seed in (100, 101, 102)]
    assert [recipe.seed for _, recipe, *_ in rendered] == [100, 101, 102]
    assert {(recipe.frames, truth, ray) for _, recipe, truth, ray in rendered} == {(5, "dense", "host:6379")}
    assert f"3 sequences of 5 stereo pairs in {out}" in done.stdout


def test_a_sequence_that_fails_is_named_after_the_others(rendered: list[Any], tmp_path: Path):
    done = run_here("train", "render", "room", "--seeds", "12-14", "--out", tmp_path)
    assert done.returncode == 2
    assert "lacks room13 (ValueError: unlucky)" in " ".join(done.stderr.split())
    assert len(rendered) == 3


@pytest.mark.parametrize("seeds", ["5", "9-7", "a-b", "1-2-3", "-1-4"])
def test_what_is_no_range_is_refused(rendered: list[Any], seeds: str, tmp_path: Path):
    done = run_here("train", "render", "room", f"--seeds={seeds}", "--out", tmp_path)
    assert done.returncode == 2
    assert "give the first and the last one, as 100-109" in " ".join(done.stderr.split())
    assert rendered == []


def test_seed_and_seeds_exclude_each_other(rendered: list[Any], tmp_path: Path):
    done = run_here("train", "render", "room", "--seed", "3", "--seeds", "1-2", "--out", tmp_path)
    assert done.returncode == 2
    assert "leave one out" in " ".join(done.stderr.split())


def test_a_device_that_is_not_there_is_named(tmp_path: Path):
    for device in ("cuda:99", "tpu"):
        refused = run_here("train", "render", "organ", "--out", tmp_path / "out", "--frames", "2", "--device", device)
        assert_refused(refused, device)
    assert not (tmp_path / "out").exists()
