"""Row differences of matches whose causes are known."""

from dataclasses import replace

import numpy as np
import pytest

from sigmaslam.checks.eye_matches import EyeMatches
from sigmaslam.checks.rig import check_rig
from sigmaslam.checks.row_fit import fit_rows, follows_motion
from sigmaslam.geometry.camera import CameraModel, RectifiedStereo, StereoCamera
from sigmaslam.geometry.rectification import StereoRectifier

VIEW = RectifiedStereo(500.0, 500.0, 319.5, 239.5, 0.1, 640, 480)
NOISE = 0.2


def camera(baseline: float = VIEW.baseline) -> StereoCamera:
    T = np.eye(4)
    T[0, 3] = baseline
    model = CameraModel(VIEW.width, VIEW.height, VIEW.fx, VIEW.fy, VIEW.cx, VIEW.cy)
    return StereoCamera(model, model, T)


def matches_of(
    rows: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0),
    lag: float = 0.0,
    offset: float = 0.0,
    outliers: float = 0.1,
    count: int = 300,
) -> EyeMatches:
    """Matches of points 1 to 20 m away, rows = (shift, roll, zoom, yaw) and a lag in frames of a swaying camera."""
    rng = np.random.default_rng(0)
    left = rng.uniform((80, 0), (VIEW.width, VIEW.height), (count, 2))
    disparity = VIEW.focal_baseline / rng.uniform(1.0, 20.0, count)
    right = left - np.column_stack([disparity + offset, np.zeros(count)])
    # Two pairs: the camera looks up in one, and ahead in the other.
    pair = np.arange(count) % 2
    shift, roll, zoom, yaw = rows
    x = (right[:, 0] - VIEW.cx) / VIEW.fx
    right[:, 0] -= yaw * (1 + x * x)
    x, y = ((right - (VIEW.cx, VIEW.cy)) / VIEW.fx).T
    flow = np.where(pair[:, None] == 0, [2.0, 8.0], np.column_stack([x, y]) * disparity[:, None])
    right = right + np.column_stack([np.zeros(count), shift + roll * x + zoom * y + yaw * x * y]) + lag * flow
    right += rng.normal(scale=NOISE, size=right.shape)
    wrong = rng.random(count) < outliers
    right[wrong] = rng.uniform((0, 0), (VIEW.width, VIEW.height), (wrong.sum(), 2))
    return EyeMatches(left, right, np.tile(NOISE**2 * np.eye(2), (count, 1, 1)), np.full(count, 0.9), flow, pair)


@pytest.mark.parametrize(
    ("rows", "lag"),
    [
        ((0.0, 0.0, 0.0, 0.0), 0.0),
        ((3.0, 0.0, 0.0, 0.0), 0.0),
        ((-1.5, 8.0, -12.0, 40.0), 0.0),
        ((0.5, 3.0, 0.0, -10.0), 0.4),
    ],
)
def test_the_causes_of_row_differences_are_told_apart(rows: tuple[float, float, float, float], lag: float):
    fit = fit_rows(matches_of(rows, lag), VIEW)
    found = np.array([fit.shift, fit.roll, fit.zoom, fit.yaw, fit.lag])
    # Weights of a robust loss cost some certainty; a fit that neglects outliers is off by tens of sigmas.
    # The fit is of first order: a tenth of what is there may be left.
    truth = np.array([*rows, lag])
    np.testing.assert_array_less(np.abs(found - truth), 5.0 * fit.sigmas + 0.1 * np.abs(truth))
    assert fit.sigmas[0] < 0.05
    assert np.median(np.abs(fit.residual)) < 2.0 * NOISE


def test_a_camera_at_rest_shows_no_lag():
    fit = fit_rows(matches_of().unfollowed(), VIEW)
    assert np.isnan(fit.lag)
    assert fit.lag_shift == 0.0


def findings_of(matches: EyeMatches) -> dict[str, tuple[str, float | None]]:
    found = check_rig(matches, StereoRectifier(camera()), 0.1)[0]
    return {each.name: (each.severity, each.figure) for each in found}


def test_a_good_rig_is_good():
    assert {severity for severity, _ in findings_of(matches_of()).values()} == {"ok"}


@pytest.mark.parametrize(
    ("shift", "severity"), [(0.5, "ok"), (-0.5, "ok"), (1.5, "warning"), (-1.5, "warning"), (3.0, "warning")]
)
def test_rows_are_judged_by_what_calibrations_are_off_by(shift: float, severity: str):
    found = findings_of(matches_of((shift, 0.0, 0.0, 0.0)))
    assert found["rows"][0] == severity
    assert found["rows"][1] == pytest.approx(shift, abs=0.1)
    assert {each for name, (each, _) in found.items() if name != "rows"} == {"ok"}


def test_a_disparity_offset_shows_where_it_leads_behind_infinity():
    far = matches_of(offset=-8.0, outliers=0.0)
    found = findings_of(far)
    assert found["eyes"][0] == "ok"
    assert found["infinity"] == ("error", pytest.approx((far.disparity < -1.0).mean(), abs=0.02))


def test_a_fence_that_is_matched_wrongly_is_not_behind_infinity():
    far = matches_of(outliers=0.0, count=1500)
    far.right[::16, 0] = far.left[::16, 0] + np.linspace(5.0, 30.0, len(far.left[::16]))
    assert findings_of(far)["infinity"][0] == "warning"


def test_a_right_camera_turned_outwards_is_not_taken_for_exchanged_eyes():
    found = findings_of(matches_of((0.0, 0.0, 0.0, 60.0)))
    assert found["eyes"][0] == "ok"
    assert found["rotation"][0] == "warning"  # it is corrected


def test_a_part_of_a_frame_between_the_eyes_is_measured():
    found = findings_of(matches_of(lag=0.3))
    severity, figure = found["synchronisation"]
    assert severity in ("warning", "error")
    assert figure == pytest.approx(0.3, abs=0.02)
    # Whatever else is wrong cannot be told from it.
    assert {found[name][0] for name in ("rows", "rotation", "scale", "infinity")} == {"unknown"}


def test_a_delay_of_a_few_milliseconds_is_told_in_seconds():
    found = {each.name: each for each in check_rig(matches_of(lag=0.1), StereoRectifier(camera()), 0.1)[0]}
    assert found["synchronisation"].severity == "warning"
    assert found["synchronisation"].delay == pytest.approx(0.01, abs=0.001)
    assert found["eyes"].delay == 0.0
    # Stamps in milliseconds: no velocity lasts so long, and no tracker takes that.
    found = {each.name: each for each in check_rig(matches_of(lag=0.1), StereoRectifier(camera()), 100.0)[0]}
    assert (found["synchronisation"].severity, found["synchronisation"].delay) == ("warning", 0.0)


def ahead(lag: float | np.ndarray = 0.0, bend: float = 0.0, scatter: float = 0.0, pairs: int = 4) -> EyeMatches:
    """A camera that goes ahead above a road: what is further from the middle is nearer, and a bend looks like its flow.

    The lag is that of all pairs, or of each.
    """
    matches, rng = matches_of(count=4800, outliers=0.0), np.random.default_rng(1)
    x, y = ((matches.right - (VIEW.cx, VIEW.cy)) / VIEW.fx).T
    pair = np.arange(4800) % pairs
    flow = ((100.0 + 25.0 * pair) * y**2)[:, None] * np.column_stack([x, y])
    matches.right[:, 1] += np.broadcast_to(lag, pairs)[pair] * flow[:, 1] + bend * y**3
    matches.right[:, 1] += rng.normal(0.0, scatter, 4800)
    return replace(matches, flow=flow, pair=pair)


@pytest.mark.parametrize(
    ("matches", "is_late"),
    [
        (ahead(), False),
        (ahead(lag=0.05), True),
        (ahead(bend=8.0), False),
        (ahead(lag=0.05, bend=8.0), False),
        (ahead(lag=np.array([0.1, 0.16, 0.1, 0.1])), False),
        (ahead(lag=0.05, scatter=0.7), False),
        (ahead(lag=0.05, pairs=1), False),
    ],
    ids=["good", "late", "a lens", "half of it a lens", "not in all pairs", "within the scatter", "one pair"],
)
def test_a_delay_follows_the_motion_of_all_pairs_as_no_lens_does(matches: EyeMatches, is_late: bool):
    fit = fit_rows(matches, VIEW)
    assert follows_motion(fit) == is_late


@pytest.mark.parametrize(
    ("matches", "severity"), [(ahead(lag=0.05, scatter=0.35), "warning"), (ahead(bend=8.0, scatter=0.35), "ok")]
)
def test_a_delay_that_explains_a_quarter_of_the_rows_is_told_from_a_lens(matches: EyeMatches, severity: str):
    fit = fit_rows(matches, VIEW)
    spread = [np.median(np.abs(rows - np.median(rows))) for rows in (fit.residual, fit.residual + fit.by_lag[:, 1])]
    assert 1 / 5 < 1.0 - (spread[0] / spread[1]) ** 2 < 1 / 3
    assert findings_of(matches)["synchronisation"][0] == severity


def test_a_bump_between_two_pairs_is_no_delay():
    matches = matches_of()
    matches.right[matches.pair == 0, 1] += 3.0
    found = findings_of(matches)
    assert found["synchronisation"] == ("ok", pytest.approx(0.0, abs=0.02))
    assert found["rows"][0] == "warning"


def test_few_matches_judge_nothing():
    assert {severity for severity, _ in findings_of(matches_of(count=40)).values()} == {"unknown"}
