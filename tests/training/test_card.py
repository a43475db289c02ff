import sys
from pathlib import Path

import torch

from sigmaslam.models.export import _card_page
from sigmaslam.training.card import make_card
from sigmaslam.training.checkpoint import begin
from sigmaslam.training.devices import Workplace

PLACE = Workplace(torch.device("cpu"))


def test_the_card_tells_names_of_paths_alone(tiny, weights, monkeypatch):
    out = Path("/home/somebody/runs/third")
    monkeypatch.setattr(sys, "argv", ["sigmaslam", "train", "--out", str(out), "--from", str(weights)])
    card = make_card(begin(tiny, "endoscope", weights, PLACE), PLACE, "abc", [out, weights])
    assert card["command"] == "sigmaslam train --out third --from others.safetensors"
    assert card["recipe"] == "endoscope"
    assert card["data"].endswith("leaves in turn")


def test_the_page_shows_what_the_card_holds(tiny, weights):
    card = make_card(begin(tiny, "quick", weights, PLACE), PLACE, "abc", [])
    card["metrics_on_held_out_renders"] = {"mma_3": 0.61}
    card["onnx_minus_torch"] = {"features": 1.5e-6}
    page = _card_page(card)
    assert f"Recipe: quick, started from others.safetensors (sha256 {card['started_from']['sha256']})" in page
    for line in ("| batch_size | 2 |", "| mma_3 | 0.61 |", "| features.onnx | 1.5e-06 |", "- grey images"):
        assert f"\n{line}\n" in page
    assert "Real sets" not in page
    page = _card_page(
        {**card, "metrics_on_real_sets": {"boat": {"mma_1": 0.4, "auc_3": 0.5}, "kitti": {"rows_1": 0.9}}}
    )
    for line in ("## Real sets", "| boat auc_3 | 0.5 |", "| kitti rows_1 | 0.9 |"):
        assert f"\n{line}\n" in page


def test_cards_of_runs_without_a_recipe_have_a_page_too(tiny):
    card = make_card(begin(tiny, None, None, PLACE), PLACE, "abc", [])
    for name in ("recipe", "started_from", "limits"):
        del card[name]
    assert "Recipe: none, started from random weights." in _card_page({**card, "onnx_minus_torch": {}})
