"""Records of rendered pairs: a function of (seed, index), as they are read back, and what is true in them."""

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from sigmaslam.errors import SigmaSlamError
from sigmaslam_training.matching import match_sets
from sigmaslam_training.matching.match_sets import (
    DETECTORS,
    SIZE,
    MatchSet,
    MatchSets,
    PairRecord,
    load_record,
    record_path,
    save_record,
    write_records,
)

PLANES, STEREO, SCENES, VIDEO = 0, 2, 3, 5


@pytest.fixture(scope="module")
def planes() -> PairRecord:
    return MatchSets(0).record(PLANES)


@pytest.fixture(scope="module")
def video() -> PairRecord:
    return MatchSets(0).record(VIDEO)


@pytest.fixture(scope="module")
def stereo() -> PairRecord:
    return MatchSets(0).record(STEREO)


def arrays_of(found: MatchSet) -> dict[str, np.ndarray]:
    named = {name: getattr(found, name) for name in ("places", "expected", "visible")}
    for name in ("features0", "features1", "putative"):
        part = getattr(found, name)
        named |= {f"{name}.{field.name}": getattr(part, field.name) for field in fields(part)}
    return named


def assert_same(a: PairRecord, b: PairRecord) -> None:
    np.testing.assert_array_equal(a.image0, b.image0)
    np.testing.assert_array_equal(a.image1, b.image1)
    assert list(a.sets) == list(b.sets)
    for kind in a.sets:
        assert a.sets[kind].source == b.sets[kind].source
        others = arrays_of(b.sets[kind])
        for name, array in arrays_of(a.sets[kind]).items():
            assert array.dtype == others[name].dtype, name
            np.testing.assert_array_equal(array, others[name], err_msg=name)


def errors(found: MatchSet) -> np.ndarray:
    """(M,) pixels from the truth, infinite where there is none."""
    return np.linalg.norm(found.features1.keypoints[found.putative.index1] - found.places, axis=1)


# What a record is


@pytest.mark.long
def test_a_record_is_the_same_whenever_it_is_asked_for(planes: PairRecord):
    sets = MatchSets(0)
    sets.record(VIDEO)
    assert_same(sets.record(PLANES), planes)


def test_another_seed_shows_another_pair(planes: PairRecord):
    assert (MatchSets(1).record(PLANES).image0 != planes.image0).mean() > 0.5


@pytest.mark.parametrize("name", ["planes", "video"])
def test_a_record_holds_a_set_of_every_kind_of_features(name: str, request: pytest.FixtureRequest):
    record: PairRecord = request.getfixturevalue(name)
    assert record.image0.shape == record.image1.shape == (SIZE, SIZE)
    assert record.image0.dtype == record.image1.dtype == np.uint8
    assert list(record.sets) == list(DETECTORS)
    for found in record.sets.values():
        assert found.source == name
        count = len(found.places)
        assert count >= 24
        assert found.places.shape == (count, 2)
        assert all(len(array) == count for key, array in arrays_of(found).items() if key.startswith("putative"))
        assert found.features0.descriptors.shape == (len(found.features0.keypoints), 0)
        assert found.putative.index0.max() < len(found.features0.keypoints)
        assert found.putative.index1.max() < len(found.features1.keypoints)


@pytest.mark.parametrize("name", ["planes", "video"])
def test_there_are_right_and_wrong_matches_and_mutual_ones_are_right_more_often(
    name: str, request: pytest.FixtureRequest
):
    for kind, found in request.getfixturevalue(name).sets.items():
        right, mutual = errors(found) < 3.0, found.putative.mutual
        assert right.sum() >= 8, kind
        assert (~right).sum() >= 8, kind
        assert right[mutual].mean() > 2.0 * right[~mutual].mean(), kind


def test_right_matches_are_about_as_near_as_keypoints_are_exact(video: PairRecord):
    for kind, found in video.sets.items():
        error = errors(found)
        assert np.median(error[error < 3.0]) < 1.2, kind


def test_places_are_infinite_where_a_keypoint_is_not_seen(planes: PairRecord):
    for found in planes.sets.values():
        seen = np.isfinite(found.places).all(axis=1)
        assert np.isinf(found.places[~seen]).all()
        assert ((found.places[seen] > -1.0) & (found.places[seen] < SIZE)).all()
    assert not all(np.isfinite(found.places).all() for found in planes.sets.values())


def test_sources_take_turns_and_see_neighbouring_pairs(monkeypatch: pytest.MonkeyPatch):
    asked: list[tuple[str, int]] = []

    class Recorder:
        def __init__(self, name: str) -> None:
            self.name = name

        def pair(self, index: int) -> None:
            asked.append((self.name, index))
            raise LookupError

    sets = MatchSets(0)
    monkeypatch.setattr(sets, "_streams", {name: Recorder(name) for name in sets._streams})
    for index in range(12):
        with pytest.raises(LookupError):
            sets.record(index)
    assert asked[:6] == [
        ("planes", 0),
        ("scenes", 0),
        ("stereo", 0),
        ("scenes", 1),
        ("turned planes", 0),
        ("video", 0),
    ]
    assert [own for name, own in asked if name == "scenes"] == [0, 1, 2, 3]
    assert [own for name, own in asked if name == "stereo"] == [0, 1]


@pytest.mark.slow
def test_the_truth_of_a_stereo_pair_lies_on_the_same_row(stereo: PairRecord):
    for kind, found in stereo.sets.items():
        seen = np.isfinite(found.places).all(axis=1)
        assert seen.sum() > 20, kind
        keypoints = found.features0.keypoints[found.putative.index0][seen]
        assert np.abs(keypoints[:, 1] - found.places[seen, 1]).max() < 0.01, kind
        assert (keypoints[:, 0] >= found.places[seen, 0]).all(), kind
        assert (errors(found)[found.putative.mutual] < 3.0).mean() > 0.3, kind


@pytest.mark.slow
def test_many_mutual_matches_of_a_scene_are_right():
    for kind, found in MatchSets(0).record(SCENES).sets.items():
        assert found.source == "scenes"
        assert (errors(found)[found.putative.mutual] < 3.0).mean() > 0.2, kind


# Files


@pytest.mark.parametrize("name", ["planes", "video"])
def test_a_saved_record_is_read_back_as_it_was(name: str, request: pytest.FixtureRequest, tmp_path: Path):
    record = request.getfixturevalue(name)
    path = record_path(tmp_path, 7)
    save_record(path, record)
    assert [each.name for each in tmp_path.iterdir()] == ["00007.npz"]
    assert_same(load_record(path), record)


def test_a_record_with_too_few_matches_of_one_kind_is_read_back_without_it(planes: PairRecord, tmp_path: Path):
    fewer = PairRecord(planes.image0, planes.image1, {"orb": planes.sets["orb"]})
    save_record(tmp_path / "00000.npz", fewer)
    assert_same(load_record(tmp_path / "00000.npz"), fewer)


class _Nothing:
    """In place of processes: each makes its share when it is started."""

    made: list[int]

    def __init__(self, target: object, args: tuple[Path, int, list[int]]) -> None:
        self.folder, self.share, self.exitcode, self.sentinel = args[0], args[2], 0, 0

    def start(self) -> None:
        for index in self.share:
            _Nothing.made.append(index)
            record_path(self.folder, index).touch()

    def is_alive(self) -> bool:
        return False

    def terminate(self) -> None:
        pass


class _Dead(_Nothing):
    """One that dies before anyone looks."""

    def start(self) -> None:
        self.exitcode = 1


class _Context:
    def __init__(self, process: type) -> None:
        self.Process = process


def test_only_missing_records_are_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(match_sets.multiprocessing, "get_context", lambda method: _Context(_Nothing))
    _Nothing.made = []
    for index in (1, 4):
        record_path(tmp_path, index).touch()
    told = list(write_records(tmp_path, 0, 6, 2))
    assert sorted(_Nothing.made) == [0, 2, 3, 5]
    assert told[0] == 2
    assert told[-1] == 6
    _Nothing.made = []
    assert list(write_records(tmp_path, 0, 6, 2)) == [6]
    assert _Nothing.made == []


def test_a_process_that_died_at_once_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(match_sets.multiprocessing, "get_context", lambda method: _Context(_Dead))
    with pytest.raises(SigmaSlamError, match="died"):
        list(write_records(tmp_path, 0, 6, 2))


@pytest.mark.slow
def test_records_of_processes_are_those_made_here(tmp_path: Path):
    assert list(write_records(tmp_path, 0, 1, 2))[-1] == 1
    assert_same(load_record(record_path(tmp_path, 0)), MatchSets(0).record(0))


@pytest.mark.slow
def test_a_process_that_fails_is_an_error(tmp_path: Path):
    """A folder is where its file should be."""
    record_path(tmp_path, 0).mkdir()
    with pytest.raises(SigmaSlamError, match="died"):
        list(write_records(tmp_path, 0, 1, 1))
