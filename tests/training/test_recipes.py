from dataclasses import asdict, replace

import pytest

from sigmaslam.cli.train import Data, TrainingRecipe
from sigmaslam.errors import InputError
from sigmaslam_training.features.recipes import RECIPES, TrainingConfig, check_config, choose_config, starting_weights
from sigmaslam_training.mixes import MIXES


def test_the_command_line_offers_every_recipe_and_mix():
    assert [choice.value for choice in TrainingRecipe] == list(RECIPES)
    assert [choice.value for choice in Data] == list(MIXES)


@pytest.mark.parametrize("name", RECIPES)
def test_every_recipe_can_be_trained(name):
    check_config(RECIPES[name])
    assert choose_config(name) == RECIPES[name]


def test_the_full_recipe_is_what_the_shipped_weights_are_made_with():
    other = {"steps": 5000, "data": "turned"}
    assert asdict(choose_config("full")) == {**asdict(TrainingConfig()), **other}


def test_what_is_asked_for_replaces_what_the_recipe_says():
    config = choose_config("quick", steps=7, data="noise", seed=3)
    assert (config.steps, config.data, config.seed) == (7, "noise", 3)
    assert config.learning_rate == RECIPES["quick"].learning_rate


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"recipe": "huge"}, "recipe 'huge' is unknown; choose one of full, quick, endoscope"),
        ({"recipe": "full", "data": "photographs"}, "data 'photographs' is unknown; choose one of leaves"),
        ({"recipe": "full", "steps": 0}, "steps 0 is too small"),
    ],
)
def test_what_cannot_be_trained_is_refused_with_what_can(options, message):
    with pytest.raises(InputError, match=message):
        choose_config(**options)


def test_sizes_that_the_network_cannot_take_are_refused():
    with pytest.raises(InputError, match=r"size 100 .* multiple of 32"):
        check_config(TrainingConfig(size=100))


@pytest.mark.parametrize(("name", "value"), [("points", 7000), ("batch_size", 0)])
def test_losses_that_there_are_not_are_refused(name, value):
    with pytest.raises(InputError, match=f"{name} {value} "):
        check_config(replace(TrainingConfig(), **{name: value}))


def test_only_fine_tuning_starts_from_the_shipped_weights(tmp_path):
    assert starting_weights("full", None) is None
    assert starting_weights("endoscope", None).name == "features.safetensors"
    for recipe in RECIPES:
        assert starting_weights(recipe, tmp_path / "mine.safetensors") == tmp_path / "mine.safetensors"
