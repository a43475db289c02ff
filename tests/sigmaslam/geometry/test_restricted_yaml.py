"""YAML that bombs, nests or repeats is refused in a moment by one message; what people write is read."""

import time
from pathlib import Path

import pytest

from sigmaslam.errors import CalibrationError, InputError
from sigmaslam.geometry.camera import StereoCamera
from sigmaslam.geometry.restricted_yaml import MAX_DEPTH, parse_yaml
from sigmaslam.slam.config import read_config

EYE = "{width: 64, height: 48, fx: 50, fy: 50, cx: 32, cy: 24}"
T = "T_left_right: [[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n"
GOOD = f"left: {EYE}\nright: {EYE}\n{T}"
# Ten to the ninth values, and a text of 100 kB a thousand times.
BOMB = "a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]\n" + "".join(
    f"{after}: &{after} [{', '.join(['*' + before] * 10)}]\n"
    for before, after in zip("abcdefgh", "bcdefghi", strict=True)
)
LONG = f"a: &a '{'x' * 100_000}'\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (BOMB + "T_left_right: *i\n", ("aliases (*) repeat", "write out")),
        (f"{BOMB}left: {{width: *i}}\n", ("aliases (*) repeat", "write out")),
        (LONG + f"T_left_right: [{'*a, ' * 1000}]\n", ("'T_left_right.", "write out")),
        (GOOD.replace("50,", "&x [*x],", 1), ("'left.fx.0'", "alias")),
        ("left: " + "[" * 20_000, (f"deeper than {MAX_DEPTH}", "write them flat")),
        ("left: " + "[" * 40 + "]" * 40, ("'left.0.0", f"deeper than {MAX_DEPTH}", "write them flat")),
        ("left: " + "{a: " * 20_000, (f"deeper than {MAX_DEPTH}",)),
        (GOOD.replace("64", "6" * 5000, 1), ("'left.width'", "a number of 5,000 characters", "round it")),
        (GOOD.replace("64", "!!int six", 1), ("line 1", "'six' is no value of the type int", "correct it")),
        (GOOD.replace("64", "0x_", 1), ("line 1", "'0x_' is no value")),
        (GOOD.replace("50", "2020-13-45", 1), ("'left.fx' must be a number, got 2020-13-45",)),
        (GOOD.replace("50", "!!timestamp x", 1), ("line 1", "no value of the type timestamp")),
        (GOOD.replace("64", "1e300", 1), ("left: image size", "at most 32767")),
        (GOOD + T.replace("0.1", "0.2"), ("key 'T_left_right' stands twice, in lines 3 and 4", "remove")),
        (GOOD.replace("fy:", "fx:", 1), ("key 'left.fx' stands twice, in lines 1 and 1", "remove")),
        ("left: !!python/object/apply:os.getcwd []\n", ("not valid YAML", "python/object/apply")),
        (GOOD.replace("50", "\x00"), ("not valid YAML",)),
        ("left: [1, 1, 1]\n" * 20_000, ("at most 262,144",)),
    ],
)
def test_bad_yaml_is_refused_by_one_short_message(tmp_path: Path, text: str, words: tuple[str, ...]):
    path = tmp_path / "stereo.yaml"
    path.write_text(text)
    begin = time.perf_counter()
    with pytest.raises(CalibrationError) as caught:
        StereoCamera.from_yaml(path)
    assert time.perf_counter() - begin < 5.0
    message = str(caught.value)
    assert len(message) < 500
    for word in (str(path), *words):
        assert word in message


def test_settings_have_the_same_limits(tmp_path: Path):
    path = tmp_path / "settings.yaml"
    path.write_text("window: 8\nwindow: 9\n")
    with pytest.raises(InputError, match="key 'window' stands twice"):
        read_config(path)
    path.write_text(f"window: {'9' * 5000}\n")
    with pytest.raises(InputError, match="'window': a number of 5,000 characters"):
        read_config(path)


def test_what_people_write_is_read(tmp_path: Path):
    content = parse_yaml(
        "eye: &eye {fx: 1, name: left}\nright: {<<: *eye, name: right}\nboth: [*eye, *eye]\n"
        "made: 2026-02-30\nat: 12:30:10.5\nnone: ~\nflat: [1, 1e-3, 1.5e-3, yes]\nempty:\n",
        tmp_path,
    )
    eye = {"fx": 1, "name": "left"}
    assert content["right"] == {"fx": 1, "name": "right"}
    assert content["both"] == [eye, eye]
    assert content["made"] == "2026-02-30"
    assert content["none"] is content["empty"] is None
    assert content["flat"] == [1, 1e-3, 1.5e-3, True]


def test_eyes_may_share_their_numbers_by_an_alias(tmp_path: Path):
    (tmp_path / "stereo.yaml").write_text(f"left: &eye {EYE}\nright: *eye\n{T}")
    camera = StereoCamera.from_yaml(tmp_path / "stereo.yaml")
    assert camera.left == camera.right
    assert camera.left.fx == 50.0
