"""Pages over rendered trials: the same figures wherever they are made, and what failed is named."""

from pathlib import Path

import pytest

from sigmaslam.errors import OutputError
from sigmaslam_benchmarks.tracking.page import fill_page
from sigmaslam_benchmarks.tracking.trial_pool import SequenceTrials, TrialKind, write_trials
from sigmaslam_synthetic.simulation import Recipe
from tests.support.klt_trials import METHODS, hash_nothing, hash_process, judge_klt

KIND = TrialKind(METHODS, judge_klt, hash_nothing)
RECIPES = [Recipe("room", 4, seed, width=160, height=120) for seed in (7, 13, 8)]


def form(done: list[SequenceTrials], missing: list[str]) -> str:
    figures = [f"{trials.recipe.name}: {trials.read('KLT + PnP')}" for trials in done]
    return "\n".join([*figures, fill_page("missing", "", missing=missing)])


@pytest.mark.long
def test_the_page_lacks_what_failed_by_name_and_what_is_there_is_used_again(tmp_path: Path):
    page, notes = tmp_path / "page.md", []
    for _ in range(2):
        with pytest.raises(OutputError, match=r"page\.md lacks room13 \(ValueError: 13 is unlucky\)"):
            write_trials(page, tmp_path / "runs", KIND, RECIPES, form, 2, None, notes.append)
    text = page.read_text()
    assert "**Missing, because they failed: room13.**" in text
    assert text.startswith("room7: {'ate':")
    assert "room8: {'ate':" in text
    assert [note for note in notes if "sequences are there" in note] == [
        "0 of 3 sequences are there",
        "2 of 3 sequences are there",
    ]
    assert "1 of 1: failed: room13 (ValueError: 13 is unlucky)" in notes


@pytest.mark.long
def test_where_all_fail_there_is_no_page(tmp_path: Path):
    with pytest.raises(OutputError, match=r"page\.md is not written, for want of room13"):
        write_trials(tmp_path / "page.md", tmp_path / "runs", KIND, RECIPES[1:2], form, 1)
    assert not (tmp_path / "page.md").exists()


@pytest.mark.long
def test_a_worker_with_other_code_is_refused(tmp_path: Path):
    kind = TrialKind(METHODS, judge_klt, hash_process)
    with pytest.raises(OutputError, match="install the same commit wherever jobs run"):
        write_trials(tmp_path / "page.md", tmp_path / "runs", kind, RECIPES[:1], form, 1)
    assert not list((tmp_path / "runs").iterdir())


@pytest.mark.slow
def test_two_workers_of_ray_give_the_figures_of_one_of_the_pool(tmp_path: Path):
    pytest.importorskip("ray")
    recipes = [RECIPES[0], RECIPES[2]]
    pages = [
        write_trials(tmp_path / f"{name}.md", tmp_path / name, KIND, recipes, form, workers, ray)
        for name, workers, ray in (("pool", 1, None), ("ray", 2, "local"))
    ]
    assert pages[0] == pages[1]
    assert "room7: {'ate':" in pages[0]
