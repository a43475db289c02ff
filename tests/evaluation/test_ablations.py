"""The page of ablations on made-up scores, and the weights of its variants."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from sigmaslam.errors import InputError
from sigmaslam.evaluation.benchmarks import ablations
from sigmaslam.evaluation.benchmarks.ablations import VARIANTS, Variant, configuration, selection_score, write_ablations
from sigmaslam.evaluation.matching.score_sets import Scores
from sigmaslam.evaluation.matching.sets import SELECTION
from sigmaslam.models.feature_network import FeatureNetwork
from sigmaslam.synthetic.rendering.textures import dead_leaves
from sigmaslam.training.features import loop
from sigmaslam.training.features.loop import WEIGHTS_NAME

COUNT = 200
STEPS = 10
COMMAND = "make the page"


# The page


@dataclasses.dataclass
class Calls:
    """What was trained and scored in place of the real thing.

    Attributes:
        trained: names of the folders, in order, with their configurations.
        scored: folders, in order.
        sets: those that were asked for.
        resumed: folders that were gone on with.
    """

    trained: dict[str, object] = dataclasses.field(default_factory=dict)
    scored: list[str] = dataclasses.field(default_factory=list)
    sets: set[str] = dataclasses.field(default_factory=set)
    resumed: list[str] = dataclasses.field(default_factory=list)


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> Calls:
    """Training writes an empty file; scores rise by 1 % a seed and are 10 % better at stride 16."""
    calls = Calls()

    def train(out: Path, config: object, workers: int = 1, resume: bool = False) -> None:
        assert workers == 0
        assert out.name not in calls.trained
        calls.trained[out.name] = config
        if resume:
            calls.resumed.append(out.name)
        out.mkdir(parents=True, exist_ok=True)
        (out / WEIGHTS_NAME).touch()

    def made_up(run: str, sets: tuple[str, ...], data: Path) -> Scores:
        assert data == Path("data")
        calls.scored.append(run)
        calls.sets |= set(sets)
        level = 0.3 + 0.01 * int(run.split("-")[-1]) + 0.1 * run.startswith("stride_16")
        return {name: dict.fromkeys(ablations._SHOWN[name], level) for name in sets}

    monkeypatch.setattr(loop, "train", train)
    monkeypatch.setattr(ablations, "score", made_up)
    monkeypatch.setattr(ablations, "_extractor", lambda run, variant: run.name)
    return calls


def write(folder: Path, seeds: int = 2) -> str:
    return write_ablations(folder / "page.md", folder / "runs", Path("data"), seeds, STEPS, COMMAND)


def rows(page: str) -> dict[str, list[str]]:
    """Cells of the rows by name of the variant."""
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in page.splitlines() if line[:2] == "| "]
    return {cells[1]: cells for cells in lines[1:]}


def test_the_page_has_a_row_for_each_variant_with_mean_and_deviation(tmp_path: Path, calls: Calls):
    page = write(tmp_path)
    assert f"`{COMMAND}`:" in page
    assert f"{STEPS} steps of 8 pairs at 192x192 a run, 2 seeds" in page
    found = rows(page)
    assert list(found) == [variant.name for variant in VARIANTS]
    columns = sum(len(keys) for keys in ablations._SHOWN.values())
    assert found["default"] == ["", "default", *["30.5 ± 0.7"] * (1 + columns)]
    assert found["16"] == ["stride", "16", *["40.5 ± 0.7"] * (1 + columns)]
    assert (tmp_path / "page.md").read_text(encoding="utf-8") == page


def test_one_seed_has_no_deviation(tmp_path: Path, calls: Calls):
    assert rows(write(tmp_path, seeds=1))["default"][2:] == ["30.0"] * (len(rows(write(tmp_path, 1))["default"]) - 2)


def test_only_the_sets_for_selection_are_touched(tmp_path: Path, calls: Calls):
    page = write(tmp_path)
    assert calls.sets == set(SELECTION)
    assert set(ablations._SHOWN) == set(SELECTION)
    assert f"over {' and '.join(SELECTION)}." in page


def test_every_variant_is_trained_and_scored_once_a_seed_one_seed_of_all_first(tmp_path: Path, calls: Calls):
    write(tmp_path)
    assert len(calls.trained) == 2 * len(VARIANTS)
    assert len(calls.scored) == len(set(calls.scored)) == 2 * len(VARIANTS)
    seeds = [name.split("-")[-1] for name in calls.trained]
    assert seeds == sorted(seeds)


def test_scores_are_kept_beside_the_weights_and_not_computed_again(tmp_path: Path, calls: Calls):
    page = write(tmp_path)
    run, better = (tmp_path / "runs" / f"{name}-{STEPS}-0" for name in ("default", "stride_16"))
    assert {path.name for path in run.iterdir()} == {WEIGHTS_NAME, "scores.json"}
    assert selection_score(json.loads((run / "scores.json").read_text())) == pytest.approx(0.3)
    assert selection_score(json.loads((better / "scores.json").read_text())) == pytest.approx(0.4)
    (tmp_path / "runs" / f"default-{STEPS}-1" / "scores.json").unlink()
    trained, scored = len(calls.trained), len(calls.scored)
    assert write(tmp_path) == page
    assert len(calls.trained) == trained
    assert calls.scored[scored:] == [f"default-{STEPS}-1"]


def test_a_run_that_was_stopped_goes_on(tmp_path: Path, calls: Calls):
    from sigmaslam.training.features.checkpoint import CHECKPOINT_NAME

    stopped = tmp_path / "runs" / f"stride_8-{STEPS}-0"
    write(tmp_path, seeds=1)
    (stopped / WEIGHTS_NAME).unlink()
    (stopped / CHECKPOINT_NAME).touch()
    calls.trained.clear()
    write(tmp_path, seeds=1)
    assert calls.resumed == [stopped.name]


def test_runs_of_another_network_are_refused(tmp_path: Path, calls: Calls):
    write(tmp_path, seeds=1)
    made_with = tmp_path / "runs" / "made_with.json"
    content = json.loads(made_with.read_text())
    content["network"]["judge.weight"] = [3, 64, 1, 1]
    for bad in (json.dumps(content), None):
        made_with.unlink()
        if bad is not None:
            made_with.write_text(bad)
        with pytest.raises(InputError, match="another --runs"):
            write(tmp_path, seeds=1)


def test_notes_below_the_mark_are_kept(tmp_path: Path, calls: Calls):
    write(tmp_path)
    path = tmp_path / "page.md"
    path.write_text(path.read_text(encoding="utf-8") + "<!-- notes -->\nWe take corners.\n", encoding="utf-8")
    assert write(tmp_path).endswith("<!-- notes -->\nWe take corners.\n")


def test_choices_are_the_mean_over_the_sets_for_selection():
    scores = {name: {"mma_1": 0.2 + place, "mma_3": 0.6 + place, "auc_3": 99.0} for place, name in enumerate(SELECTION)}
    assert selection_score(scores) == pytest.approx(0.9)


def test_every_variant_can_be_trained():
    assert [variant for variant in VARIANTS if not variant.training] == [VARIANTS[0]]
    assert len({variant.name for variant in VARIANTS if variant.question == "stride"}) == 2
    default = configuration(VARIANTS[0], 3, STEPS)
    assert (default.steps, default.seed, default.validate_every) == (STEPS, 3, 0)
    for variant in VARIANTS:
        assert configuration(variant, 3, STEPS) == dataclasses.replace(default, **variant.training)
        # Otherwise the runs would be those of another variant.
        assert all(getattr(default, key) != value for key, value in variant.training.items())


@pytest.mark.parametrize("training", [{}, {"descriptor_size": 32}, {"stride": 16}], ids=str)
def test_the_weights_of_a_variant_are_read_as_they_were_trained(tmp_path: Path, training: dict[str, int]):
    torch.manual_seed(0)
    state = FeatureNetwork(**training).state_dict()
    save_file({name: value.contiguous() for name, value in state.items()}, tmp_path / WEIGHTS_NAME)
    extract = ablations._extractor(tmp_path, Variant("", "", training))
    keypoints, descriptors = extract(dead_leaves((128, 160), np.random.default_rng(0)))
    assert len(keypoints) == len(descriptors) > 50
    assert descriptors.shape[1] == training.get("descriptor_size", FeatureNetwork().descriptor_size)
