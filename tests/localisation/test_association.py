"""Which landmark a sighting is of: small scenes whose answer is known, and drives whose numbers are hidden."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import mode
from typer.testing import CliRunner

from sigmaslam.cli.commands import app
from sigmaslam_localisation.association import NOBODY, Views, associate
from sigmaslam_localisation.recording import Recording
from sigmaslam_localisation.robots import localise_robots
from sigmaslam_localisation.scores import score, score_map
from tests.support.wheeled_world import World, drive, write_csv_folder

pytestmark = [pytest.mark.usefixtures("one_thread"), pytest.mark.timeout(300)]


def views(value: list[list[float]], shared: float = 0.0, own: float = 0.01) -> Views:
    """Expected views with a variance of their own and one that shifts them all."""
    size = 2 * len(value)
    covariance = own * np.eye(size) + shared * np.kron(np.ones((len(value), len(value))), np.eye(2))
    return Views(np.array(value), covariance, np.subtract)


def paired(seen: Views, sightings: list[list[float]], variance: float = 0.01) -> tuple[list[int], list[bool]]:
    found, away = seen.pair(np.array(sightings), np.full((len(sightings), 2), variance))
    return found.tolist(), away.tolist()


def test_sightings_are_paired_as_a_whole():
    """The first alone is nearest to landmark 1; both together are shifted, as an error that they share does."""
    seen = views([[0.0, 0.0], [1.0, 0.0]], shared=0.25, own=1e-4)
    assert paired(seen, [[0.6, 0.0], [1.6, 0.0]], 1e-3)[0] == [0, 1]
    # Alone it could be of either.
    assert paired(seen, [[0.5, 0.0]], 1e-3)[0] == [NOBODY]


def test_what_is_far_from_all_is_new_and_what_is_between_the_gates_is_left_out():
    seen = views([[0.0, 0.0], [5.0, 0.0]])
    assert paired(seen, [[0.1, 0.0], [0.6, 0.0], [2.5, 2.5]]) == ([0, NOBODY, NOBODY], [False, False, True])


def test_landmarks_that_look_alike_are_taken_for_each_other_and_others_are_not():
    assert paired(views([[0.0, 0.0], [0.05, 0.0]], own=0.04), [[0.01, 0.0]])[0] == [0]
    assert paired(views([[0.0, 0.0], [0.3, 0.0]], own=0.04), [[0.14, 0.0]])[0] == [NOBODY]


def test_of_pairs_that_are_not_compatible_together_the_much_likelier_one_is_left():
    """Each lies within its gate, on opposite sides, where the error that they share is on one."""
    seen = views([[0.0, 0.0], [9.0, 0.0]], shared=1.0, own=1e-4)
    assert paired(seen, [[0.1, 0.0], [5.5, 0.0]])[0] == [0, NOBODY]
    assert paired(seen, [[1.0, 0.0], [7.5, 0.0]])[0] == [NOBODY, NOBODY]


def wrong(recording: Recording, found: Recording) -> int:
    """Sightings of another landmark than most that have their number."""
    rows = np.flatnonzero(np.isin(recording.sightings[:, 0], found.sightings[:, 0]))
    truly, numbers = recording.landmark[rows], found.landmark
    return sum(int((truly[numbers == each] != mode(truly[numbers == each]).mode).sum()) for each in np.unique(numbers))


@pytest.mark.long
@pytest.mark.parametrize("mapping", [False, True])
def test_landmarks_are_found_that_nobody_named(mapping):
    recording = drive(World(seconds=20.0, outliers=0.05, seed=11))
    hidden = replace(recording, landmark=np.full_like(recording.landmark, -1))
    found = associate([hidden], mapping=mapping)[0]
    assert wrong(recording, found) == 0
    assert len(found.seconds) > 0.85 * len(recording.seconds)
    named = associate([recording], mapping=mapping)[0]
    np.testing.assert_array_equal(found.landmark, named.landmark)
    estimate = localise_robots([named], mapping=mapping)[1][0]
    assert score(estimate)["nees_mean"] < 9
    if mapping:
        assert len(found.landmarks) == len(recording.landmarks)
        assert np.isnan(found.landmarks).all()
        assert score_map(estimate.map)["landmark_rmse_aligned"] < 0.15


@pytest.mark.long
def test_a_folder_without_names_is_localised(tmp_path):
    folder = write_csv_folder(tmp_path / "robot", drive(World(seconds=10.0, seed=8)))
    sightings = folder / "sightings.csv"
    rows = [line.split(",") for line in sightings.read_text().splitlines()]
    sightings.write_text("".join(f"{','.join([row[0], *row[2:]])}\n" for row in rows))
    refused = CliRunner().invoke(app, ["localize", str(folder), "--out", str(tmp_path / "run")])
    assert "not time,landmark,range,bearing" in str(refused.exception)
    for name, options in (("placed", []), ("mapped", ["--map", "unknown"])):
        out = tmp_path / name
        done = CliRunner().invoke(
            app, ["localize", str(folder), "--out", str(out), "--association", "unknown", *options]
        )
        assert done.exit_code == 0, done.output
        assert (out / "trajectory.csv").stat().st_size > 0
