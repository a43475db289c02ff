"""Animations of the gallery: their frames and their pace, and those that ship are small."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from sigmaslam.readers import open_sequence
from sigmaslam_benchmarks.tracking.tracking_gallery import MAX_BYTES, RECIPES, Animation

IMAGES = Path(__file__).resolve().parents[2] / "docs" / "images"


def test_an_animation_has_every_picture_in_order_and_plays_as_fast_as_they_came(demo_sequence: Path, tmp_path: Path):
    animation = Animation.of("demo", open_sequence(demo_sequence).camera)
    greys = [20, 80, 140, 200]
    animation.pictures += [np.full((60, 100, 3), grey, np.uint8) for grey in greys]
    animation.timestamps += [0.0, 0.05, 0.1, 0.15]
    animation.write(tmp_path / "animation.webp")
    _, read = cv2.imreadanimation(str(tmp_path / "animation.webp"))
    np.testing.assert_allclose([frame[..., :3].mean() for frame in read.frames], greys, atol=3)
    assert np.ravel(read.durations).tolist() == [50] * 4


@pytest.mark.parametrize("preset", [recipe.preset for recipe in RECIPES])
def test_the_animations_that_ship_are_whole_and_small(preset: str):
    path = IMAGES / f"track_{preset}.webp"
    assert path.stat().st_size < MAX_BYTES
    _, read = cv2.imreadanimation(str(path))
    assert len(read.frames) == next(recipe.frames for recipe in RECIPES if recipe.preset == preset)


def test_no_recipe_has_a_seed_of_reported_figures():
    assert all(recipe.seed < 1000 for recipe in RECIPES)
