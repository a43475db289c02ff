"""Settings from a file."""

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from sigmaslam.bodies.object_tracker import OBJECT_CONFIG
from sigmaslam.errors import InputError
from sigmaslam.slam.config import TrackerConfig, read_config


def written(folder: Path, text: str) -> Path:
    path = folder / "settings.yaml"
    path.write_text(text)
    return path


def test_settings_that_a_file_names_are_changed_and_no_others(tmp_path: Path):
    path = written(tmp_path, "keyframe_ratio: 0.75\nwindow: 8\nconstant_sigma: [0.3, 0.5]\nlinearisation: extended\n")
    expected = TrackerConfig(keyframe_ratio=0.75, window=8, constant_sigma=(0.3, 0.5), linearisation="extended")
    assert read_config(path) == expected
    assert read_config(path, OBJECT_CONFIG).acceleration == OBJECT_CONFIG.acceleration


def test_every_setting_can_be_written_and_read(tmp_path: Path):
    settings = {name: value for name, value in asdict(TrackerConfig()).items() if value is not None}
    assert read_config(written(tmp_path, yaml.safe_dump(settings))) == TrackerConfig()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("keyframe_ration: 0.7", ("there is no setting 'keyframe_ration'", "keyframe_ratio")),
        ("keyframe_ratio: often", ("keyframe_ratio: expected a number, zero or more, found 'often'",)),
        ("acceleration: -1", ("acceleration: expected a number, zero or more, found -1",)),
        ("window: 2.5", ("window: expected a whole number above zero, found 2.5",)),
        ("min_inliers: true", ("min_inliers: expected a whole number above zero, found True",)),
        ("constant_sigma: 1", ("constant_sigma: expected two positive numbers in a list, found 1",)),
        ("linearisation: cubature", ("expected one of unscented, extended",)),
        ("- 1", ("expected lines like", "found list")),
        ("keyframe_sigma: 0", ("keyframe_sigma: expected a number above zero, found 0",)),
        ("keyframe_ratio: 1.5", ("keyframe_ratio: expected at most 1, found 1.5",)),
        ("search_limit: 1e+300", ("search_limit: expected at most 1e+06, found 1e+300",)),
        ("a: [", ("not valid YAML",)),
    ],
)
def test_a_bad_file_is_refused_by_name(tmp_path: Path, text: str, words: tuple[str, ...]):
    path = written(tmp_path, text)
    with pytest.raises(InputError) as caught:
        read_config(path)
    for word in (str(path), *words):
        assert word in str(caught.value)


def test_a_missing_file_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match="cannot read the settings: no such file"):
        read_config(tmp_path / "nothing.yaml")


@pytest.mark.parametrize("name", asdict(TrackerConfig()))
@pytest.mark.parametrize("value", ["moon", -1, float("nan"), float("inf"), 1e300, True, {}, np.zeros(3)], ids=repr)
def test_nonsense_in_python_is_refused_by_the_setting_s_name(name: str, value: object):
    with pytest.raises(InputError, match=f"^TrackerConfig: {name}: (expected|a calibration has no error)"):
        TrackerConfig(**{name: value})


def test_values_in_python_are_as_those_of_a_file(tmp_path: Path):
    path = written(tmp_path, "acceleration: 1e-3\nconstant_sigma: [1, 2.5e-1]\nestimate: [yaw]\n")
    given = TrackerConfig(acceleration=np.float32(1e-3), constant_sigma=[1, 0.25], estimate=["yaw"])  # type: ignore[arg-type]
    assert read_config(path, TrackerConfig(constant_sigma=(1.0, 1.0))) == replace(given, acceleration=1e-3)
    assert type(given.acceleration) is float
    assert given.constant_sigma == (1.0, 0.25)
    assert given.estimate == ("yaw",)
