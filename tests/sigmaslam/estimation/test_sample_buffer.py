"""Samples of a sensor of motion as drivers deliver them: late, by another clock, with one gone wrong, from a thread."""

from __future__ import annotations

from threading import Thread

import numpy as np
import pytest

from sigmaslam.estimation.sample_buffer import SampleBuffer


def filled(times: np.ndarray, rates: np.ndarray | None = None) -> SampleBuffer:
    buffer = SampleBuffer(0.0)
    rates = np.zeros((len(times), 3)) if rates is None else rates
    for time, rate in zip(times.tolist(), rates, strict=True):
        buffer.add(time, rate, np.zeros(3))
    return buffer


def test_a_clock_that_is_set_back_counts_from_there(caplog: pytest.LogCaptureFixture):
    """As a driver does that starts again; or one stamp was of the future."""
    times = 0.005 * np.arange(100)
    for before in (times + 9.0, np.r_[times, 1e4]):
        caplog.clear()
        buffer = filled(np.r_[before, times + 0.6])
        late = times + 0.6
        np.testing.assert_array_equal(buffer.around(0.702, 0.802)[:, 0], late[(late > 0.699) & (late < 0.806)])
        assert [record.message.split(" ")[0] for record in caplog.records] == ["a", "the"]


def test_samples_that_are_late_now_and_then_are_left_out(caplog: pytest.LogCaptureFixture):
    """Packets that come twice, or out of order."""
    times = 0.005 * np.arange(200)
    buffer = filled(np.r_[times[:100], times[80:95], times[100:150], times[90:80:-1], times[150:]])
    np.testing.assert_array_equal(buffer.around(0.0, 0.992)[:, 0], times)
    assert len(caplog.records) == 1


def test_a_rate_that_leaps_for_one_sample_is_that_of_its_neighbours():
    rng, times = np.random.default_rng(0), 0.005 * np.arange(200)
    rates = np.sin(3.0 * times)[:, None] + rng.normal(0.0, 0.01, (200, 3))
    hit = rates.copy()
    hit[120, 1] += 35.0
    seen = filled(times, hit).around(0.0, 0.994)[:, 1:4]
    np.testing.assert_array_equal(seen[120], 0.5 * (rates[119] + rates[121]))
    kept = np.arange(200) != 120
    np.testing.assert_array_equal(seen[kept], rates[kept])


@pytest.mark.parametrize("what", ["steady", "shaking", "turned at once", "slow"])
def test_motions_are_no_leaps(what: str):
    """Vibrations that samples alias, a jerk, and a sensor of few samples."""
    rng, times = np.random.default_rng(1), 0.005 * np.arange(200)
    rates = rng.normal(0.0, 0.02, (200, 3))
    rates[:, 0] += {
        "steady": np.zeros(200),
        "shaking": 3.0 * (-1.0) ** np.arange(200),
        "turned at once": 3.0 * (times > 0.5),
        "slow": 2.0 * np.sin(0.9 * np.arange(200)),
    }[what]
    np.testing.assert_array_equal(filled(times, rates).around(0.0, 0.994)[:, 1:4], rates)


def test_samples_may_come_while_others_are_used():
    buffer, errors = filled(0.001 * np.arange(50)), list[Exception]()

    def add() -> None:
        for k in range(50, 4000):
            buffer.add(0.001 * k, np.zeros(3), np.zeros(3))
            buffer.forget(0.001 * (k - 40))

    thread = Thread(target=add)
    thread.start()
    while thread.is_alive():
        try:
            assert (np.diff(buffer.around(0.0, 9.0)[:, 0]) > 0.0).all()
        except TypeError as error:
            errors.append(error)
    thread.join()
    assert not errors
