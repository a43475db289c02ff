import numpy as np
import pytest

from sigmaslam.estimation.calibration_errors import ERRORS, measured_errors
from sigmaslam.estimation.state_layout import CALIBRATION_SIZE
from sigmaslam.frontend import patch_kernels
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.image_cells import CELLS, image_cells
from sigmaslam.geometry.se3 import se3_exp, se3_inverse, se3_log
from sigmaslam.two_view import stereo_pose
from sigmaslam.two_view.stereo_pose import RelativePose, _StereoMatches, estimate_relative_pose

CAMERA = RectifiedStereo(fx=400.0, fy=400.0, cx=319.5, cy=239.5, baseline=0.2, width=640, height=480)

MOTIONS = {
    "general": [0.2, -0.1, 0.4, 0.05, -0.1, 0.03],
    "forward": [0.0, 0.0, 0.8, 0.0, 0.0, 0.0],
    "sideways": [0.5, 0.0, 0.0, 0.0, 0.0, 0.0],
    "backward": [0.05, 0.0, -0.5, 0.0, 0.02, 0.0],
    "turn": [0.0, 0.0, 0.0, 0.02, 0.15, -0.05],
    "none": [0.0] * 6,
}


def points_in_view(count: int, seed: int = 0, planar: bool = False) -> np.ndarray:
    """(u, v, disparity) in the keyframe, 3 to 15 m away, or all on a slanted plane."""
    rng = np.random.default_rng(seed)
    u, v = rng.uniform(80, 560, count), rng.uniform(60, 420, count)
    disparity = 14.0 + 0.01 * (u - 320) + 0.02 * (v - 240) if planar else 80.0 / rng.uniform(3, 15, count)
    return np.c_[u, v, disparity]


def observe(landmarks: np.ndarray, T_key_camera: np.ndarray) -> np.ndarray:
    T = se3_inverse(T_key_camera)
    return np.asarray(CAMERA.project(CAMERA.triangulate(landmarks) @ T[:3, :3].T + T[:3, 3]))


def error(found: np.ndarray, T_key_camera: np.ndarray) -> np.ndarray:
    """Translation and rotation error, metres and radians."""
    tangent = se3_log(se3_inverse(T_key_camera) @ found)
    return np.array([np.linalg.norm(tangent[:3]), np.linalg.norm(tangent[3:])])


def estimate(landmarks: np.ndarray, measurement: np.ndarray, sigma: float = 0.3) -> RelativePose | None:
    """From matches that are all said to be right, and known to `sigma` pixels."""
    count = len(landmarks)
    noise = np.tile(sigma**2 * np.eye(3), (count, 1, 1))
    landmark_sigma = np.tile([0.1, 0.1, sigma], (count, 1))
    return estimate_relative_pose(CAMERA, landmarks, landmark_sigma, measurement, noise, np.ones(count))


@pytest.mark.parametrize("planar", [False, True], ids=["scattered", "planar"])
@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS.keys())
def test_pose_is_exact_without_noise(motion, planar):
    landmarks, truth = points_in_view(80, planar=planar), se3_exp(motion)
    found = estimate(landmarks, observe(landmarks, truth))
    assert found is not None
    assert error(found.T_key_camera, truth).max() < 1e-6
    assert found.inliers.all()


@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS.keys())
@pytest.mark.parametrize("seed", range(3))
def test_forty_per_cent_outliers_do_no_harm(motion, seed):
    rng = np.random.default_rng(seed)
    landmarks, truth = points_in_view(150, seed), se3_exp(motion)
    measurement = observe(landmarks, truth) + rng.normal(0, 0.3, (150, 3))
    wrong = np.arange(150) < 60
    measurement[wrong, :2] = np.c_[rng.uniform(0, 640, 60), rng.uniform(0, 480, 60)]
    found = estimate(landmarks, measurement)
    assert found is not None
    assert (error(found.T_key_camera, truth) < (0.03, 0.005)).all()
    assert found.inliers[~wrong].mean() > 0.95
    assert found.inliers[wrong].mean() < 0.05


def test_consistent_outliers_do_no_harm():
    """A third of the points move together, as on another vehicle."""
    rng = np.random.default_rng(0)
    landmarks, truth = points_in_view(150), se3_exp(MOTIONS["general"])
    measurement = observe(landmarks, truth) + rng.normal(0, 0.3, (150, 3))
    measurement[:50] = observe(landmarks[:50], truth @ se3_exp([0.6, 0, 0.5, 0, 0, 0]))
    found = estimate(landmarks, measurement)
    assert found is not None
    assert (error(found.T_key_camera, truth) < (0.03, 0.005)).all()
    assert found.inliers[:50].mean() < 0.1


@pytest.mark.parametrize("seed", range(5))
def test_a_slow_mover_before_a_plane_is_told_by_matches_that_are_better_than_they_claim(seed):
    """An instrument before tissue: a turn in place of a shift fits both within the claimed noise."""
    rng = np.random.default_rng(seed)
    landmarks, truth = points_in_view(300, seed, planar=True), se3_exp([0.002, 0.004, 0.0, 0.002, 0.0, -0.003])
    mover = np.arange(300) < 40
    landmarks[mover] = np.c_[rng.uniform(80, 200, 40), rng.uniform(60, 160, 40), rng.normal(32.0, 1.0, 40)]
    measurement = observe(landmarks, truth) + rng.normal(0, 0.1, (300, 3))
    measurement[mover, :2] += [-2.0, 1.0]
    found = estimate(landmarks, measurement, sigma=0.5)
    assert found is not None
    apart = error(found.T_key_camera, truth)
    assert apart @ np.array([1.0, 5.0]) < 0.03, apart  # metres, 5 m away
    assert found.inliers[mover].mean() < 0.1
    assert found.inliers[~mover].mean() > 0.95
    assert found.scale < 0.25


def test_p3p_stands_alone_where_most_points_agree(monkeypatch):
    """As noisy as claimed: neither the essential matrix nor the finer threshold could explain more."""
    landmarks, truth = points_in_view(300), se3_exp(MOTIONS["general"])
    measurement = observe(landmarks, truth) + np.random.default_rng(0).normal(0, 0.5, (300, 3))
    measurement[:30, :2] += 20.0
    with monkeypatch.context() as patched:
        patched.setattr(stereo_pose, "estimate_epipolar_pose", lambda *args: pytest.fail("it is not needed"))
        alone = estimate(landmarks, measurement, sigma=0.5)
    monkeypatch.setattr(stereo_pose, "_CLEAR", 1.1)
    other = estimate(landmarks, measurement, sigma=0.5)
    assert alone is not None
    assert other is not None
    assert not alone.inliers[:30].any()
    assert alone.inliers[30:].mean() > 0.95
    np.testing.assert_allclose(alone.T_key_camera, other.T_key_camera, atol=1e-5)


def test_missing_disparities_are_no_obstacle():
    landmarks, truth = points_in_view(60), se3_exp(MOTIONS["general"])
    measurement = observe(landmarks, truth)
    measurement[:, 2] = np.nan
    found = estimate(landmarks, measurement)
    assert found is not None
    assert error(found.T_key_camera, truth).max() < 1e-6
    assert found.inliers.all()


def test_a_wrong_disparity_makes_an_outlier():
    landmarks, truth = points_in_view(60), se3_exp(MOTIONS["general"])
    measurement = observe(landmarks, truth)
    measurement[:5, 2] += 10.0
    found = estimate(landmarks, measurement)
    assert found is not None
    np.testing.assert_array_equal(found.inliers, np.arange(60) >= 5)


def test_points_at_infinity_take_no_part():
    landmarks, truth = points_in_view(60), se3_exp(MOTIONS["general"])
    measurement = observe(landmarks, truth)
    landmarks[:20, 2], measurement[:20, 2] = [0.3, -0.5] * 10, np.nan
    found = estimate(landmarks, measurement)
    assert found is not None
    assert (error(found.T_key_camera, truth) < (1e-3, 1e-3)).all()
    assert not found.inliers[:20].any()


@pytest.mark.parametrize("count", [0, 1, 7])
def test_too_few_points_give_no_pose(count):
    landmarks = points_in_view(count)
    assert estimate(landmarks, observe(landmarks, np.eye(4))) is None


def test_eight_points_are_enough():
    landmarks, truth = points_in_view(8), se3_exp(MOTIONS["general"])
    found = estimate(landmarks, observe(landmarks, truth))
    assert found is not None
    assert error(found.T_key_camera, truth).max() < 1e-6


def test_unrelated_points_give_no_pose():
    rng = np.random.default_rng(0)
    landmarks = points_in_view(40)
    measurement = np.c_[rng.uniform(0, 640, 40), rng.uniform(0, 480, 40), rng.uniform(1, 60, 40)]
    assert estimate(landmarks, measurement) is None


def test_only_far_points_give_no_pose():
    landmarks = points_in_view(40)
    landmarks[:, 2] = 0.5
    assert estimate(landmarks, observe(landmarks, np.eye(4))) is None


def test_the_same_points_give_the_same_pose():
    rng = np.random.default_rng(1)
    landmarks, truth = points_in_view(100), se3_exp(MOTIONS["general"])
    measurement = observe(landmarks, truth) + rng.normal(0, 0.5, (100, 3))
    first, second = (estimate(landmarks, measurement) for _ in range(2))
    assert first is not None
    assert second is not None
    np.testing.assert_array_equal(first.T_key_camera, second.T_key_camera)


@pytest.mark.parametrize("shared", [0.0, 0.3], ids=["own errors", "errors that neighbours share"])
def test_clustering_says_by_how_much_errors_that_neighbours_share_exceed_the_covariance(shared):
    rng, squared, factors = np.random.default_rng(3), [], []
    for seed in range(20):
        landmarks, truth = points_in_view(150, seed), se3_exp(MOTIONS["general"])
        common = rng.normal(0.0, shared, (CELLS, 3))[image_cells(landmarks[:, :2], 640, 480)]
        found = estimate(landmarks, observe(landmarks, truth) + rng.normal(0.0, 0.3, (150, 3)) + common, 0.3)
        assert found is not None
        off = se3_log(se3_inverse(truth) @ found.T_key_camera)
        squared.append(off @ np.linalg.solve(found.covariance, off) / 6)
        factors.append(found.clustering)
    assert 0.5 * np.mean(squared) < np.mean(factors) < 2.0 * np.mean(squared), (np.mean(squared), np.mean(factors))
    assert (np.mean(factors) > 2.0) == (shared > 0.0)


@pytest.mark.parametrize("name", ["offset", "focal", "yaw", "baseline"])
def test_an_error_of_the_calibration_moves_the_pose_as_it_says(name):
    """Both views have it, and the pose of what they then seem to measure departs by it, to first order."""
    landmarks, truth = points_in_view(200), se3_exp(MOTIONS["general"])
    seen = observe(landmarks, truth)
    error = np.zeros(CALIBRATION_SIZE)
    error[ERRORS.index(name)] = 1e-4 if name in ("focal", "baseline") else 0.01
    moved = (uvd + measured_errors(CAMERA, uvd) @ error for uvd in (landmarks, seen))
    right, found = estimate(landmarks, seen), estimate(*moved)
    assert right is not None
    assert found is not None
    expected = right.by_calibration @ error
    assert np.linalg.norm(expected) > 0.0
    departure = se3_log(se3_inverse(right.T_key_camera) @ found.T_key_camera)
    np.testing.assert_allclose(departure, expected, atol=0.02 * np.linalg.norm(expected))


def test_compiled_equations_equal_their_twin(monkeypatch):
    """Of far points, unknown disparities and points behind the camera, too."""
    pytest.importorskip("sigmaslam.frontend._kernels", reason="installed without a compiler")
    rng = np.random.default_rng(0)
    landmarks = points_in_view(60)
    landmarks[::7, 2] = rng.uniform(-0.5, 0.5, 9)
    measurement = landmarks + rng.normal(0.0, 2.0, landmarks.shape)
    measurement[::5, 2], measurement[3] = np.nan, np.nan
    noise = rng.normal(size=(60, 3, 3))
    noise = noise @ noise.transpose(0, 2, 1) + 0.1 * np.eye(3)
    sigma, weight = rng.uniform(0.1, 0.5, (60, 3)), rng.uniform(size=60)
    matches = _StereoMatches(CAMERA, landmarks, sigma, measurement, noise, weight)
    for motion in ([0.2, -0.1, 0.4, 0.05, -0.1, 0.03], [0.0, 0.0, -7.0, 0.0, 0.0, 0.0]):
        T = se3_exp(motion)
        found = matches.equations(T, 3.0)
        with monkeypatch.context() as without:
            without.setattr(patch_kernels, "_kernels", None)
            expected = matches.equations(T, 3.0)
        assert np.isinf(expected[0]).any()
        for each, twin in zip(found, expected, strict=True):
            np.testing.assert_allclose(each, twin, rtol=1e-7, atol=1e-9)
