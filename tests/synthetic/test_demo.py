"""The shipped demo, and sequences rendered by several processes, with the real textures."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from sigmaslam_synthetic.render_sequence import write_sequence
from sigmaslam_synthetic.simulation import Recipe, Simulation, Studio


@pytest.mark.long
def test_shipped_demo_is_what_its_scene_renders(demo_sequence: Path) -> None:
    content = json.loads((demo_sequence / "scene.json").read_text())
    assert sum(p.stat().st_size for p in demo_sequence.rglob("*") if p.is_file()) <= 4_500_000
    simulation = Simulation.from_json(content["simulation"])
    for eye in ("image_0", "image_1"):
        assert len(list((demo_sequence / eye).glob("*.png"))) == simulation.frames == 40
    with torch.inference_mode():
        frame = Studio(simulation).frames(np.array([7]))[0]
    for eye, again in (("image_0", frame.left), ("image_1", frame.right)):
        shipped = cv2.imread(str(demo_sequence / eye / "000007.png"), cv2.IMREAD_UNCHANGED).astype(int)
        # Noise may differ where another processor rounds another way; the picture may not.
        assert np.abs(again - shipped).mean() < 2.5


@pytest.mark.slow
def test_processes_give_the_same_bytes_as_one(tmp_path: Path) -> None:
    recipe = Recipe("organ", 4, seed=5, width=96, height=72)
    folders = []
    for workers in (1, 2):
        write_sequence(tmp_path / str(workers), recipe, workers=workers)
        folder = tmp_path / str(workers)
        folders.append({str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()})
    assert folders[0] == folders[1]
