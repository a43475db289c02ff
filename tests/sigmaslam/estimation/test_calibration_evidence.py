"""What may be wrong with a pair, against marginal likelihoods of the measurements themselves."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from sigmaslam.estimation.calibration_correction import change_rig, judge_calibration
from sigmaslam.estimation.calibration_errors import ERRORS, SHOWN, TURNS, CalibrationPrior
from sigmaslam.estimation.calibration_evidence import _ALIKE, _PATIENCE, _WORSE, HYPOTHESES, CalibrationEvidence, Cause
from sigmaslam.estimation.window_state import WindowState
from sigmaslam.geometry.calibration_sigmas import CalibrationSigmas
from sigmaslam.inference.backends import load_step
from tests.support.dense_window import CAMERA, by_pair_with, make_window, unsolved, world

USUAL = CalibrationPrior.of(CAMERA, CalibrationSigmas(), 0.5)
SIZE, PRIOR = 0.01 * CAMERA.fx, 0.01
COUNT, NOISE = 40, 0.3


def weigh(slopes: np.ndarray, measured: np.ndarray, expected: np.ndarray | None = None) -> dict[str, Cause]:
    """Of measurements (M,) with slopes (M, 12) by the errors and independent noise."""
    evidence = CalibrationEvidence(USUAL, CAMERA.fx, load_step("window_condition"), expected)
    evidence.learn(WindowState.initial(USUAL), slopes.T @ slopes / NOISE**2, slopes.T @ measured / NOISE**2)
    return evidence.weigh()


def measurements(seed: int, name: str, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Slopes, and what is measured with usual errors and one of a hypothesis."""
    rng = np.random.default_rng(seed)
    slopes = rng.normal(size=(COUNT, len(ERRORS)))
    errors = rng.normal(size=len(ERRORS)) * USUAL.sigma + size * np.isin(ERRORS, HYPOTHESES[name])
    return slopes, slopes @ errors + NOISE * rng.normal(size=COUNT)


@pytest.mark.parametrize(("name", "size"), [("yaw", 0.6), ("zoom", 1.2), ("lenses", 1.0)])
def test_probabilities_and_errors_are_those_of_the_measurements(name: str, size: float):
    slopes, measured = measurements(3, name, size)
    densities, errors = {}, {}
    for each, moved in {"nothing": (), **HYPOTHESES}.items():
        prior = USUAL.covariance + SIZE**2 * np.outer(*2 * [np.isin(ERRORS, moved).astype(float)])
        spread = slopes @ prior @ slopes.T + NOISE**2 * np.eye(COUNT)
        odds = PRIOR if moved else 1.0 - PRIOR * len(HYPOTHESES)
        densities[each] = odds * multivariate_normal(np.zeros(COUNT), spread).pdf(measured)
        gain = prior @ slopes.T @ np.linalg.inv(spread)
        # Errors that views have in common make the mean that much less certain.
        less = prior @ slopes.T @ np.linalg.inv(spread + (_ALIKE - 1.0) * NOISE**2 * np.eye(COUNT))
        errors[each] = gain @ measured, prior - less @ slopes @ prior
    causes = weigh(slopes, measured)
    assert name in causes
    for each, cause in causes.items():
        k = ERRORS.index(each)
        assert cause.probability == pytest.approx(densities[each] / sum(densities.values()), rel=1e-6)
        assert cause.mean == pytest.approx(errors[each][0][k], rel=1e-6)
        assert cause.variance == pytest.approx(errors[each][1][k, k], rel=1e-6)
    hopeless = sum(densities[each] for each in HYPOTHESES if each not in causes)
    assert hopeless < 0.05 * len(HYPOTHESES) * sum(densities.values())


@pytest.mark.parametrize("cause", [None, "yaw"])
def test_expected_errors_are_those_of_all_measurements_together(cause: str | None):
    slopes, measured = measurements(3, "yaw", 0.6)
    evidence = CalibrationEvidence(USUAL, CAMERA.fx, load_step("window_condition"))
    evidence.learn(WindowState.initial(USUAL), slopes.T @ slopes / NOISE**2, slopes.T @ measured / NOISE**2)
    prior = USUAL.covariance.copy()
    if cause is not None:
        prior += 0.5 * SIZE**2 * np.outer(*2 * [np.isin(ERRORS, HYPOTHESES[cause]).astype(float)])
    # What views say counts a part.
    gain = prior @ slopes.T @ np.linalg.inv(slopes @ prior @ slopes.T + _ALIKE * NOISE**2 * np.eye(COUNT))
    found, _ = evidence.beside({} if cause is None else {cause: Cause(0.5, 0.6, 0.1)})
    np.testing.assert_allclose(found, np.where(np.isin(ERRORS, SHOWN), gain @ measured, 0.0), rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize(
    ("name", "cause", "is_gross"),
    [
        ("yaw", Cause(0.99, -0.012 * CAMERA.fx, 0.1), True),
        ("yaw", Cause(0.4, -0.012 * CAMERA.fx, 0.1), False),
        ("zoom", Cause(0.99, 0.009 * CAMERA.fx, 0.1), False),
    ],
)
def test_a_likely_cause_is_gross_beyond_half_a_degree(name: str, cause: Cause, is_gross: bool):
    evidence = CalibrationEvidence(USUAL, CAMERA.fx, load_step("window_condition"))
    assert evidence.is_gross({name: cause}) == is_gross
    assert not evidence.is_gross({})


def test_nothing_is_wrong_until_evidence_speaks():
    assert weigh(np.zeros((COUNT, len(ERRORS))), np.zeros(COUNT)) == {}
    silent = [weigh(*measurements(seed, "yaw", 0.0)) for seed in range(40)]
    assert sum(any(cause.probability > 0.5 for cause in causes.values()) for causes in silent) <= 1


@pytest.mark.parametrize("name", list(HYPOTHESES))
def test_a_large_error_is_named(name: str):
    causes = weigh(*measurements(5, name, 8.0 if name == "offset" else 4.0))
    assert max(causes, key=lambda each: causes[each].probability) == name
    assert causes[name].probability > 0.99


def test_errors_count_from_what_is_expected():
    """After a bump the prior holds about another calibration."""
    expected = np.zeros(len(ERRORS))
    expected[0] = 5.0
    rng = np.random.default_rng(7)
    slopes = rng.normal(size=(COUNT, len(ERRORS)))
    # What is learned is about the window's prior mean, which is zero.
    assert weigh(slopes, slopes @ expected, expected) == {}
    assert weigh(slopes, slopes @ expected)["offset"].probability > 0.99


def leave(evidence: CalibrationEvidence, slopes: np.ndarray, measured: np.ndarray) -> None:
    """A keyframe leaves whose views measure the calibration alone."""
    step = np.eye(4), 1e-4 * np.eye(6)
    evidence.add_keyframe(*step)
    about, slopes = WindowState.initial(USUAL).grow(*step, np.zeros(len(ERRORS))), np.pad(slopes, ((0, 0), (0, 6)))
    evidence.marginalise_oldest(about, slopes.T @ slopes / NOISE**2, slopes.T @ measured / NOISE**2)
    evidence.learn(WindowState.initial(USUAL), np.zeros(2 * (len(ERRORS),)), np.zeros(len(ERRORS)))


def test_views_of_another_pair_are_not_heard_until_they_go_on_for_two_windows():
    (slopes, measured), (_, others) = measurements(3, "yaw", 2.0), measurements(3, "yaw", -2.0)
    evidence = CalibrationEvidence(USUAL, CAMERA.fx, load_step("window_condition"))
    leave(evidence, slopes, measured)
    alone, _ = evidence.beside({})
    leave(evidence, slopes, measured)
    agreed, _ = evidence.beside({})
    assert np.abs(agreed - alone).max() > 0.01
    for _ in range(_PATIENCE):
        leave(evidence, slopes, others)
        np.testing.assert_array_equal(evidence.beside({})[0], agreed)
    leave(evidence, slopes, others)
    assert np.abs(evidence.beside({})[0] - agreed).max() > 0.01


def test_a_frame_is_weighed_as_a_keyframe_is_and_forgotten():
    slopes, measured = measurements(3, "yaw", 2.0)
    slopes = np.column_stack([slopes, np.random.default_rng(1).normal(size=(COUNT, 12))])  # by two poses, too
    views = slopes.T @ slopes / NOISE**2, slopes.T @ measured / NOISE**2
    evidence, step = CalibrationEvidence(USUAL, CAMERA.fx, load_step("window_condition")), (np.eye(4), 1e-4 * np.eye(6))
    evidence.add_keyframe(*step)
    about = WindowState.initial(USUAL).grow(*step, np.zeros(len(ERRORS)))
    evidence.learn(about, np.zeros(2 * (len(about.covariance),)), np.zeros(len(about.covariance)))
    about = about.grow(*step, np.zeros(len(ERRORS)))
    found = evidence.weigh_frame(about, *step, *views)
    assert evidence.weigh() == {}
    evidence.add_keyframe(*step)
    evidence.learn(about, *views)
    assert found["yaw"].probability > 0.99
    assert found == pytest.approx(evidence.weigh())


# Of `dense_window`: considered errors of calibrations, of which it estimates the first three.
CONSIDERED_SIGMA = USUAL.sigma[3:]


@pytest.mark.parametrize("name", ["zoom", "lenses"])
def test_a_window_takes_over_what_evidence_names(name: str):
    k = ERRORS.index(name)
    error = 6.0 * (np.arange(len(ERRORS)) == k)
    given = world(1, 0.3, count=90)
    right, wrong = (unsolved(each, considered_sigma=CONSIDERED_SIGMA) for each in (given, by_pair_with(given, error)))
    right.solve()
    assert right.causes == {}
    # Images know no better than calibrations usually are.
    np.testing.assert_allclose(right.posterior.calibration[3:], right.corrected[0, 3:], atol=1e-12)
    assert (np.abs(right.corrected[0]) <= USUAL.sigma).all()
    assert not right.corrected[1].any()
    wrong.solve()
    assert wrong.causes[name].probability > 0.95
    # What was linearised about no error, is so about most of it the next time.
    wrong.solve()
    sigma = np.hypot(wrong.corrected[1, k], USUAL.sigma[k])
    assert wrong.posterior.calibration[k] == pytest.approx(6.0, abs=3.0 * sigma)
    assert sigma < 1.5
    assert wrong.calibration.sigma[k] == pytest.approx(sigma)


def test_a_mean_that_moves_is_off_by_as_much(monkeypatch: pytest.MonkeyPatch):
    window, k = make_window(np.full(3, 0.5), considered_sigma=CONSIDERED_SIGMA), ERRORS.index("lenses")
    for mean, moved in [(4.0, 0.0), (6.0, 2.0), (6.0, 0.0), (5.0, -1.0)]:
        monkeypatch.setattr(window.evidence, "weigh", lambda mean=mean: {"lenses": Cause(1.0, mean, 0.09)})
        judge_calibration(window)
        assert window.corrected[1, k] == pytest.approx(np.hypot(0.3, moved))


@pytest.mark.parametrize("sigma", [0.0, 0.3])
def test_a_bump_may_have_turned_the_camera_whatever_its_file_claims(sigma: float):
    window = make_window(np.full(3, 0.5), considered_sigma=np.full(9, sigma))
    turns = [ERRORS.index(name) for name in TURNS]
    before, covariance = window.posterior.common, window.calibration.covariance
    change_rig(window, 2.0)
    after = window.posterior.common
    np.testing.assert_allclose(np.diag(after @ after.T - before @ before.T)[turns], 4.0)
    np.testing.assert_allclose(np.diag(window.calibration.covariance - covariance)[turns], 4.0)


@pytest.mark.parametrize("worse", [1.0, 4.0])
def test_errors_of_a_bad_calibration_are_as_much_larger_as_their_likelihood_says(worse: float):
    found = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        slopes = 3.0 * rng.normal(size=(COUNT, len(ERRORS)))
        # What views say counts an eighth, as those of an eighth of their information would.
        loud = np.sqrt(_ALIKE) * NOISE
        grows = np.isin(ERRORS, SHOWN)
        measured = slopes @ (rng.normal(size=len(ERRORS)) * USUAL.sigma * np.where(grows, worse, 1.0))
        measured += loud * rng.normal(size=COUNT)
        evidence = CalibrationEvidence(USUAL, CAMERA.fx, load_step("window_condition"))
        evidence.learn(WindowState.initial(USUAL), slopes.T @ slopes / NOISE**2, slopes.T @ measured / NOISE**2)
        densities = [
            multivariate_normal(
                np.zeros(COUNT),
                slopes @ np.diag(np.where(grows, each**2, 1.0) * USUAL.sigma**2) @ slopes.T + loud**2 * np.eye(COUNT),
            ).logpdf(measured)
            for each in _WORSE
        ]
        found.append(evidence.beside({})[1])
        assert found[-1] == _WORSE[np.argmax(densities)]
    assert np.median(found) == pytest.approx(worse, rel=0.25)
    # A covariance that claims to be exact leaves nothing to be larger.
    exact = CalibrationPrior.independent(np.r_[0.5, np.zeros(len(ERRORS) - 1)], "offset")
    assert CalibrationEvidence(exact, CAMERA.fx, load_step("window_condition")).beside({})[1] == 1.0
