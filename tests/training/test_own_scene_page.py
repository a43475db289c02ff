"""The commands of docs/matching.md run one after the other as they stand, but for the numbers of steps and frames."""

import re
import shlex
from pathlib import Path

import cv2
import numpy as np
import pytest

from sigmaslam_training.features.recipes import RECIPES
from tests.support.commands import ROOT, run_here

PAGE = ROOT / "docs" / "matching.md"
# What is added to commands, by how they begin; of options that are given twice the last one counts.
SMALL = {
    "sigmaslam train render": ["--frames", "12", "--width", "192", "--height", "160"],
    "sigmaslam train --": ["--steps", "2", "--workers", "0"],
}


def commands() -> list[list[str]]:
    blocks = re.findall(r"^```\w*\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    lines = [line.partition("  #")[0] for block in blocks for line in block.splitlines()]
    return [shlex.split(line) for line in lines if line.startswith("sigmaslam ")]


def test_the_page_goes_from_a_render_to_matches():
    verbs = [words[2] if words[1] in ("train", "images") else words[1] for words in commands()]
    assert verbs == ["render", "--recipe", "export", "track", "evaluate", "match"]


def test_the_page_tells_the_steps_and_size_of_the_batches():
    recipe = RECIPES["fine-tune"]
    assert f"for {recipe.steps} steps of {recipe.batch_size} pairs" in PAGE.read_text(encoding="utf-8")
    assert f"every {recipe.validate_every} steps" in " ".join(PAGE.read_text(encoding="utf-8").split())


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_commands_run_in_their_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    for words in commands():
        more = next((each for start, each in SMALL.items() if " ".join(words).startswith(start)), [])
        done = run_here(*words[1:], *more)
        assert done.returncode == 0, f"{words}\n{done.stdout}\n{done.stderr}"
    picture = cv2.imread(str(tmp_path / "my_features" / "samples" / "step_00002.png"))
    size = RECIPES["fine-tune"].size
    assert picture.shape == (5 * 2 * size, 4 * size, 3)
    with np.load("matches.npz") as matches:
        assert len(matches["probability"]) > 20
