"""Sources of one's own: shares become turns, what cannot be used is refused before long work, and it can be trained."""

import pickle
import re
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import pytest

from sigmaslam.errors import InputError
from sigmaslam.files import atomic_write_text
from sigmaslam_synthetic.rendering.textures import dead_leaves, paint
from sigmaslam_synthetic.scene_pairs import ScenePairs
from sigmaslam_synthetic.simulation import Recipe, simulate
from sigmaslam_training.features.loop import TrainingStopped
from sigmaslam_training.features.recipes import TrainingConfig, choose_config
from sigmaslam_training.features.stream import MixedPairs, open_stream
from sigmaslam_training.features.validation import held_out_sources
from sigmaslam_training.mixes import MIXES
from sigmaslam_training.sources import SOURCES, choose_shares, label, turns_of
from tests.support.commands import assert_refused, run_here

BENCH = Path(__file__).resolve().parents[2] / "examples" / "my_world.py"


@pytest.fixture
def photographs(tmp_path: Path) -> Path:
    """A dark and a bright image, neither of which is square."""
    folder = tmp_path / "photographs"
    folder.mkdir()
    for k, shape in enumerate([(300, 400), (500, 350)]):
        image = dead_leaves(shape, np.random.default_rng(k)) // 2 + 128 * k
        cv2.imwrite(str(folder / f"{k}.png"), image.astype(np.uint8))
    return folder


@pytest.mark.parametrize(
    ("shares", "counts"),
    [
        ({"room": 0.4, "organ": 0.6}, {"room": 2, "organ": 3}),
        ({"leaves": 1.0}, {"leaves": 1}),
        ({"a": 0.33, "b": 0.33, "c": 0.34}, {"a": 33, "b": 33, "c": 34}),
        ({"a": 0.25, "b": 0.25, "c": 0.5}, {"a": 1, "b": 1, "c": 2}),
    ],
)
def test_turns_have_the_shares_and_are_spread(shares: dict[str, float], counts: dict[str, int]):
    turns = turns_of(shares)
    assert Counter(turns) == counts
    # At any place in the lap a source is at most one turn from its share.
    for source, share in shares.items():
        done = np.cumsum([each == source for each in turns])
        assert np.abs(done - share * np.arange(1, len(turns) + 1)).max() < 1.0 + 1e-9


def test_a_named_mix_is_what_it_was():
    assert turns_of("turned") == MIXES["turned"]


def test_the_order_of_the_command_line_does_not_change_the_run():
    assert turns_of({"room": 0.4, "organ": 0.6}) == turns_of({"organ": 0.6, "room": 0.4})


def test_the_command_line_gives_shares_in_its_order(photographs: Path):
    shares = choose_shares("organ, leaves", BENCH, photographs, "0.1,0.2,0.3,0.4")
    assert shares == {"organ": 0.1, "leaves": 0.2, str(BENCH): 0.3, str(photographs): 0.4}
    assert [label(source) for source in shares or {}] == ["organ", "leaves", "my_world", "photographs"]
    equal = choose_shares("organ,leaves,room", None, None, None)
    assert equal is not None
    assert sorted(equal.values()) == [0.33, 0.33, 0.34]
    assert choose_shares(None, None, None, None) is None


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--worlds", "room,moon"], "'moon' is unknown; choose among room, street,"),
        (["--worlds", "room,organ", "--mix", "0.4,0.7"], "--mix 0.4,0.7 sums to 1.1: give each source a share"),
        (["--worlds", "room,organ", "--mix", "1.5,-0.5"], "give each source a share of 0.01 or more, 1 together"),
        (["--worlds", "room,organ", "--mix", "1"], "--mix 1 has 1 shares: give 2, for room, organ"),
        (["--worlds", "room,organ", "--mix", "half,half"], "is no list of numbers"),
        (["--worlds", "room,room"], "names a source twice"),
        (["--mix", "1"], "name them with --worlds, --world or --textures"),
        (["--textures", "EMPTY"], "no image in it"),
        (["--textures", "nowhere"], "is no folder: give one with photographs"),
        (["--world", "nowhere.py"], "nowhere.py: is no Python file"),
        (["--world", "EMPTY"], "is no Python file"),
        (["--data", "leaves", "--worlds", "room"], "--data leaves and sources of one's own are given"),
    ],
)
def test_what_cannot_be_trained_on_is_refused_before_anything_is_written(
    words: list[str], message: str, tmp_path: Path
):
    (tmp_path / "empty").mkdir()
    words = [word.replace("EMPTY", str(tmp_path / "empty")) for word in words]
    assert_refused(run_here("train", "--out", tmp_path / "run", *words), message)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("code", "message"),
    [
        ("import nothing_of_this_name", r"cannot be run \(ModuleNotFoundError: No module named 'nothing_of"),
        ("def make(rng, wish): ...", r"has no function generate\(rng, wish\)"),
        (
            "def generate(rng, wish): return 1 / 0",
            r"generate\(rng, wish\) or its rendering fails \(ZeroDivisionError",
        ),
        (BENCH.read_text().replace("Scene(tuple(bodies)", "Scene(()"), "generate.* fails"),
        ("def generate(rng, wish): return 'street'", r"generate\(rng, wish\) returns str, not an Episode"),
    ],
)
def test_a_file_that_makes_no_world_is_refused_by_name(code: str, message: str, tmp_path: Path):
    world = tmp_path / "world.py"
    atomic_write_text(world, code)
    with pytest.raises(InputError, match=rf"{re.escape(str(world))}: {message}.*examples/my_world\.py"):
        choose_shares(None, world, None, None)
    with pytest.raises(InputError, match=message):
        Recipe("organ", 2, world=str(world)).check()


def test_a_world_of_one_s_own_gives_pairs_with_truth():
    stream = open_stream(str(BENCH), 3, 96)
    assert b"sigmaslam_world" not in pickle.dumps(stream)  # a worker knows no module of that name
    pair = stream.pair(0)
    assert pair.image0.shape == (96, 96)
    assert pair.image0.std() > 0.02
    points = np.stack(np.meshgrid(np.arange(8.0, 90.0, 8), np.arange(8.0, 90.0, 8)), -1).reshape(-1, 2)
    assert pair.transfer(points)[1].mean() > 0.15
    assert isinstance(open_stream("rubble", 0, 96), ScenePairs)


@pytest.mark.long
def test_a_rendered_sequence_shows_the_world_of_the_file():
    simulation = simulate(Recipe("organ", 2, 5, width=64, height=48, world=str(BENCH)))
    kinds = {layer.kind for material in simulation.scene.materials for layer in material.layers}
    assert kinds == {"wood", "glyphs", "checker", "strokes"}
    assert simulation.rig.left.width == 64
    assert simulate(Recipe("organ", 2, 5, width=64, height=48)).scene != simulation.scene


def test_a_path_that_ends_before_the_last_image_is_refused(tmp_path: Path):
    world = tmp_path / "short.py"
    atomic_write_text(world, BENCH.read_text().replace("wish.duration", "0.1"))
    with pytest.raises(InputError, match=r"short\.py: its path is from 0 to 0\.1 s, not from 0 to 0\.44 s"):
        simulate(Recipe("organ", 10, world=str(world)))


def test_photographs_are_textures_that_depend_on_seed_alone(photographs: Path):
    first = paint(str(photographs), 128, 1)
    np.testing.assert_array_equal(paint(str(photographs), 128, 1), first)
    assert first.shape == (128, 128)
    means = [paint(str(photographs), 128, seed).mean() for seed in range(20)]
    assert min(means) < 127 < max(means)  # both images are used
    pair = MixedPairs({str(photographs): 0.5, "leaves": 0.5}, 0, 96).pair(0)
    assert pair.image0.shape == (96, 96)


def test_a_cut_of_a_photograph_lies_in_it(tmp_path: Path):
    """A plane of grey that says its own place: every cut is a plane, of at least the pixels' own steps."""
    ramp = np.add.outer(np.arange(200) // 2, np.arange(300) // 2).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "ramp.png"), ramp)
    for seed in range(5):
        part = paint(str(tmp_path), 64, seed).astype(float)
        slopes = (part[-1].mean() - part[0].mean()) / 63, (part[:, -1].mean() - part[:, 0].mean()) / 63
        assert slopes[0] == pytest.approx(slopes[1], rel=0.05)
        assert 0.48 < slopes[0] < 0.5 * 200 / 64 + 0.05


def test_a_photograph_that_is_too_small_is_named(tmp_path: Path):
    cv2.imwrite(str(tmp_path / "stamp.png"), np.zeros((20, 90), np.uint8))
    with pytest.raises(InputError, match=r"stamp\.png is 90x20 pixels: give 64 or more"):
        paint(str(tmp_path), 64, 0)


def test_sources_of_one_s_own_are_validated_too():
    config = choose_config("fine-tune", shares={"organ": 0.5, "leaves": 0.5})
    assert held_out_sources(config.mix) == ("leaves", "patterns", "scenes", "organ")
    assert TrainingConfig().mix == "leaves"


def test_every_world_of_render_is_a_source():
    assert {"room", "street", "drone", "colon", "organ", "tool", "rubble", "leaves"} <= set(SOURCES)


@pytest.mark.parametrize(
    ("saved", "words"),
    [
        (3, ["3 of 8 steps are saved in", "the same command with --resume goes on"]),
        (0, ["0 of 8 steps are saved in", "give the same command again"]),
    ],
)
def test_a_stopped_run_says_what_is_saved_and_how_to_go_on(
    saved: int, words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def stop(*arguments: object) -> None:
        raise TrainingStopped(saved, 8)

    monkeypatch.setattr("sigmaslam_training.features.loop.train", stop)
    result = run_here("train", "--out", tmp_path / "run", "--steps", "8")
    assert result.returncode == 130
    for each in words:
        assert each in result.stderr
