import json
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from sigmaslam.errors import InputError
from sigmaslam_models.model_card import card_page, read_card, read_scores
from sigmaslam_training.devices import Workplace
from sigmaslam_training.features.checkpoint import TrainingState, begin
from sigmaslam_training.run_card import describe_origin, make_card
from sigmaslam_training.source_commit import current_commit

PLACE = Workplace(torch.device("cpu"))


def made(state: TrainingState) -> dict[str, Any]:
    state.origin = {"commit": "abc", "command": "sigmaslam train"}
    return make_card(state, PLACE)


def test_paths_behind_an_equals_sign_are_hidden_too(monkeypatch):
    out = Path("/home/somebody/runs/third")
    monkeypatch.setattr(sys, "argv", ["sigmaslam", "train", f"--out={out}", "--seed=3"])
    assert describe_origin([out])["command"] == "sigmaslam train --out=third --seed=3"


def test_the_card_tells_names_of_paths_alone(tiny, weights, monkeypatch):
    out = Path("/home/somebody/runs/third")
    monkeypatch.setattr(sys, "argv", ["sigmaslam", "train", "--out", str(out), "--from", str(weights)])
    state = begin(tiny, "endoscope", weights, PLACE)
    state.origin = describe_origin([out, weights])
    card = make_card(state, PLACE)
    assert card["commit"] == current_commit()
    assert card["command"] == "sigmaslam train --out third --from others.safetensors"
    assert card["recipe"] == "endoscope"
    assert card["data"].endswith("leaves in turn")


def test_the_page_shows_what_the_card_holds(tiny, weights):
    card = made(begin(tiny, "quick", weights, PLACE))
    card["metrics_on_held_out_renders"] = {"mma_3": 0.61}
    card["onnx_minus_torch"] = {"features": 1.5e-6}
    page = card_page(card)
    assert f"Recipe: quick, started from others.safetensors (sha256 {card['started_from']['sha256']})" in page
    for line in ("| batch_size | 2 |", "| mma_3 | 0.61 |", "| features.onnx | 1.5e-06 |", f"- {card['limits'][1]}"):
        assert f"\n{line}\n" in page
    assert "Real sets" not in page
    page = card_page({**card, "metrics_on_real_sets": {"boat": {"mma_1": 0.4, "auc_3": 0.5}, "kitti": {"rows_1": 0.9}}})
    for line in ("## Real sets", "| boat auc_3 | 0.5 |", "| kitti rows_1 | 0.9 |"):
        assert f"\n{line}\n" in page


def test_cards_of_runs_without_a_recipe_have_a_page_too(tiny):
    card = made(begin(tiny, None, None, PLACE))
    for name in ("recipe", "started_from", "limits"):
        del card[name]
    assert "Recipe: none, started from random weights." in card_page({**card, "onnx_minus_torch": {}})


@pytest.mark.parametrize("content", [None, "no json", '{"config": {}}', "[1]", "[" * 100_000])
def test_a_file_that_is_no_card_is_refused(tmp_path, content):
    path = tmp_path / "card.json"
    if content is not None:
        path.write_text(content)
    with pytest.raises(InputError, match=r"card\.json (does not exist|is no card)"):
        read_card(path)


def test_a_whole_card_is_read(tmp_path, tiny):
    card = made(begin(tiny, "quick", None, PLACE))
    (tmp_path / "card.json").write_text(json.dumps(card))
    assert read_card(tmp_path / "card.json") == card


def test_scores_for_the_card_are_those_of_the_one_extractor_that_is_ours(tmp_path):
    path = tmp_path / "features.json"
    scores = {"ours": {"boat": {"mma_1": 0.123456}, "kitti": {"rows_1": 0.5}}, "sift": {"boat": {"mma_1": 0.9}}}
    path.write_text(json.dumps({**scores, "ours + sigmaslam match": {"boat": {"mma_1": 0.7}}, "klt": {}}))
    expected = {"boat": {"mma_1": 0.1235}, "boat + sigmaslam match": {"mma_1": 0.7}, "kitti": {"rows_1": 0.5}}
    assert read_scores(path) == expected
    path.write_text(json.dumps({**scores, "xfeat.onnx": {}}))
    with pytest.raises(InputError, match=r"features\.json holds the scores of ours, xfeat\.onnx"):
        read_scores(path)
    with pytest.raises(InputError, match=r"nothing\.json cannot be read"):
        read_scores(tmp_path / "nothing.json")
