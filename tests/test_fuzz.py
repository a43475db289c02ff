"""Readers read changed files or refuse them with an error of ours; `python -m tests.fuzz` does the same at length."""

import tempfile
import time
from pathlib import Path
from random import Random

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sigmaslam.errors import InputError
from sigmaslam.geometry.camera import StereoCamera
from sigmaslam.slam.config import read_config
from tests.support import fuzz_targets
from tests.support.fuzz_targets import FuzzTarget, Tally, make_targets

NAMES = (
    *("calibration", "EuRoC sensor", "KITTI calibration", "settings", "map", "relative poses", "tracks", "covariance"),
    *("trajectory", "times", "locations", "frames", "image", "region", "box", "manifest", "EuRoC time table"),
    *("bag", "db3", "mcap"),
)
# The bags' readers take five milliseconds a file.
FEW, MANY = 8, 40


@pytest.fixture(scope="module")
def targets(tmp_path_factory: pytest.TempPathFactory) -> dict[str, FuzzTarget]:
    return make_targets(tmp_path_factory.mktemp("targets"))


@pytest.mark.long
def test_every_target_is_tested(targets: dict[str, FuzzTarget]):
    assert tuple(targets) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_good_files_are_read(targets: dict[str, FuzzTarget], tmp_path: Path, name: str):
    """All but the two of which the mend is asked: a table with semicolons, TUM form with commas."""
    tally, target = Tally(), targets[name]
    for seed in target.seeds:
        tally.run(target, seed, tmp_path)
    assert not tally.crashes
    assert tally.refused == {"trajectory": 3, "locations": 1}.get(name, 0)


@pytest.mark.parametrize("name", NAMES)
def test_changed_files_are_read_or_refused(targets: dict[str, FuzzTarget], tmp_path: Path, name: str):
    target, tally = targets[name], Tally()

    @settings(
        max_examples=FEW if name in ("bag", "db3", "mcap") else MANY,
        deadline=None,
        suppress_health_check=list(HealthCheck),
        database=None,
    )
    @given(st.randoms(use_true_random=False))
    def run(random: Random) -> None:
        tally.run(target, target.changed(random), tmp_path)
        assert [crash.kind for crash in tally.crashes.values()] == []

    run()


SCALARS = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | st.dates()
KEYS = st.sampled_from(["left", "right", "T_left_right", "sigmas", "fx", "width", "window", "estimate"]) | st.text(
    max_size=3
)
CONTENTS = st.recursive(
    SCALARS, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(KEYS, inner, max_size=4), max_leaves=12
)


@pytest.mark.long
@settings(max_examples=40, deadline=None)
@given(content=CONTENTS)
def test_any_yaml_is_read_or_refused_by_name(content: object):
    with tempfile.TemporaryDirectory() as folder:
        tally, text = Tally(), yaml.safe_dump(content, allow_unicode=False)
        for read in (StereoCamera.from_yaml, read_config):
            tally.run(FuzzTarget("YAML", "content.yaml", [], read), text.encode(), Path(folder))
    assert [crash.kind for crash in tally.crashes.values()] == []
    assert tally.read + tally.refused == 2


def refuse_without_a_name(path: Path) -> None:
    raise InputError("wrong")


def refuse_at_length(path: Path) -> None:
    raise InputError(f"{path}: {'wrong ' * 1000}")


@pytest.mark.parametrize(
    ("read", "kind"),
    [
        (lambda path: {}["a"], "KeyError"),
        (lambda path: time.sleep(10), "HangError"),
        (refuse_without_a_name, "does not name the file"),
        (refuse_at_length, "longer than"),
    ],
)
def test_a_bad_reader_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, read, kind: str):
    monkeypatch.setattr(fuzz_targets, "HANG_SECONDS", 0.2)
    tally = Tally()
    for _ in range(2):
        tally.run(FuzzTarget("bad", "bad.txt", [b"1"], read), b"1", tmp_path)
    (crash,) = tally.crashes.values()
    assert kind in crash.kind
    assert crash.count == tally.executions == 2
