from collections import Counter

import numpy as np
import pytest

from sigmaslam_synthetic.rendering import bank as bank_module
from sigmaslam_synthetic.rendering.bank import TextureBank


@pytest.fixture
def painted(monkeypatch):
    """What was painted, as (kind, size, seed); the textures hold a number of their own."""
    calls: list[tuple[str, int, int]] = []

    def paint(kind: str, size: int, seed: int) -> np.ndarray:
        calls.append((kind, size, seed))
        return np.full((size, size), seed % 251, np.uint8)

    monkeypatch.setattr(bank_module, "paint", paint)
    return calls


def test_a_texture_does_not_depend_on_what_was_asked_before():
    forward, backward = (TextureBank(5, ("leaves", "bricks"), size=48, count=2, uses=3) for _ in range(2))
    indices = [0, 1, 7, 30, 2, 100, 0]
    found = [forward.texture(index) for index in indices]
    for index, texture in zip(reversed(indices), reversed(found), strict=True):
        np.testing.assert_array_equal(backward.texture(index), texture)
    assert (TextureBank(6, size=48).texture(0) != TextureBank(5, size=48).texture(0)).any()


@pytest.mark.parametrize(("count", "uses"), [(1, 1), (4, 3), (16, 32), (5, 7)])
def test_a_texture_is_used_and_then_replaced(count, uses):
    bank = TextureBank(0, count=count, uses=uses)
    keys = [bank.key(index) for index in range(6 * count * uses)]
    for start in range(0, len(keys) - count, count):
        assert len(set(keys[start : start + count])) == count
    times = Counter(keys)
    inner = [key for key in times if count <= key < max(keys) - 2 * count]
    assert inner
    assert {times[key] for key in inner} == {uses}
    for place in range(count):  # once replaced, a texture never comes back
        seen = keys[place::count]
        assert seen == sorted(seen)


def test_textures_are_replaced_one_after_another():
    bank = TextureBank(0, count=16, uses=32)
    keys = [bank.key(index) for index in range(2048)]
    new = [index for index in range(16, 2048) if keys[index] != keys[index - 16]]
    assert len(new) == pytest.approx(2048 / 32, abs=2)
    assert min(np.diff(new)) > 8


def test_no_two_textures_share_their_random_numbers(painted):
    for seed in range(3):
        bank = TextureBank(seed, size=1, count=4, uses=1)
        for index in range(500):
            bank.texture(index)
    assert len(painted) == len(set(painted)) == 1500


def test_neighbours_are_painted_once(painted):
    bank = TextureBank(0, size=1, count=4, uses=8)
    for index in range(64):
        bank.texture(index)
        bank.texture(index + 1)
    assert len(painted) == len({bank.key(index) for index in range(65)})
    assert len(bank._kept) <= 8


def test_a_mix_draws_among_its_kinds(painted):
    bank = TextureBank(0, ("leaves", "leaves", "noise"), size=1, count=4, uses=1)
    for index in range(600):
        bank.texture(index)
    drawn = Counter(kind for kind, _, _ in painted)
    assert set(drawn) == {"leaves", "noise"}
    assert drawn["leaves"] / 600 == pytest.approx(2 / 3, abs=0.06)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"kinds": ("leaves", "marble")}, "unknown texture 'marble'"),
        ({"kinds": ()}, "give one or more of leaves"),
        ({"count": 0}, "count is 0"),
        ({"uses": 0}, "uses is 0"),
    ],
)
def test_a_bank_that_cannot_be_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        TextureBank(0, **arguments)
