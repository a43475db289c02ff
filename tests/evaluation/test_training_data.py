"""The page that chooses the training data, on made-up scores."""

import json
from pathlib import Path

import pytest

from sigmaslam.evaluation.benchmarks import training_data
from sigmaslam.evaluation.benchmarks.training_data import selection_score, write_training_data
from sigmaslam.evaluation.matching.sets import FINAL, SELECTION
from sigmaslam.training.loop import WEIGHTS_NAME
from sigmaslam.training.stream import MIXES

# Which mix wins on the sets that choose, and which on those that are only recorded.
BEST, BEST_AFTERWARDS = "scenes", "noise"


def made_up(extractor: str, sets: tuple[str, ...], data: Path) -> dict[str, dict[str, float]]:
    mix, _, seed = Path(extractor).parent.name.split("-")
    level = 0.3 + 0.01 * int(seed)
    level += 0.2 * (mix == BEST) if sets == SELECTION else 0.6 * (mix == BEST_AFTERWARDS)
    return {name: dict.fromkeys(training_data._SHOWN[name], level) for name in sets}


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(training_data, "score", made_up)
    monkeypatch.setattr(training_data, "load_extractor", lambda path: path)
    for mix in MIXES:
        for seed in range(2):
            folder = tmp_path / f"{mix}-10-{seed}"
            folder.mkdir()
            (folder / WEIGHTS_NAME).touch()
    return tmp_path


def test_the_mix_is_chosen_by_the_selection_alone_and_the_rest_is_recorded(runs: Path) -> None:
    page = write_training_data(runs / "page.md", runs, Path("data"), seeds=2, steps=10, command="make it")
    assert f"**{BEST}**" in page
    choice, record = page.split("## For the record")
    assert f"| {BEST} | 50.5 ± 0.7 |" in choice
    assert f"| {BEST_AFTERWARDS} | 90.5 ± 0.7 |" in record
    assert not any(f"| {name} " in choice for name in FINAL)


def test_scores_are_kept_beside_the_weights(runs: Path) -> None:
    write_training_data(runs / "page.md", runs, Path("data"), seeds=1, steps=10, command="make it")
    kept = json.loads((runs / "mix-10-0" / f"scores-{'-'.join(SELECTION)}.json").read_text())
    assert selection_score(kept) == pytest.approx(0.3)
