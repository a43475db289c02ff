import json
from dataclasses import asdict, replace

import cv2
import numpy as np
import pytest

from sigmaslam_synthetic.camera.sensor import Sensor, expose, exposure_gains, random_sensor

QUIET = Sensor(blur=0.0, photons_at_white=1e18, read_noise=0.0)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture
def texture(rng: np.random.Generator) -> np.ndarray:
    """(96, 128) float32 smooth texture in [0.1, 0.9]."""
    noise = cv2.GaussianBlur(rng.random((96, 128)).astype(np.float32), (0, 0), 1.5)
    return np.asarray(cv2.normalize(noise, None, 0.1, 0.9, cv2.NORM_MINMAX))


def spread(photograph: np.ndarray, axis: int) -> float:
    """Standard deviation of the light along an axis (0 = x, 1 = y), pixels."""
    profile = photograph.astype(float).sum(axis=axis)
    place = np.arange(len(profile))
    mean = (profile * place).sum() / profile.sum()
    return float(np.sqrt((profile * (place - mean) ** 2).sum() / profile.sum()))


def test_an_ideal_camera_only_quantises(texture: np.ndarray, rng: np.random.Generator) -> None:
    photograph = expose(texture, QUIET, rng)
    assert photograph.dtype == np.uint8
    np.testing.assert_array_equal(photograph, np.rint(255 * texture))
    np.testing.assert_array_equal(np.unique(expose(texture, replace(QUIET, bits=1), rng)), [0, 255])
    np.testing.assert_array_equal(expose(3 * texture + 1, QUIET, rng), 255)


@pytest.mark.parametrize("photons", [2.0, 19.0, 40.0, 5000.0])
def test_shot_noise_has_the_mean_and_variance_of_the_poisson_law(photons: float, rng: np.random.Generator) -> None:
    level = 0.25  # four times as many photons at white, so that saturation is out of reach
    sensor = replace(QUIET, photons_at_white=photons / level, read_noise=2.0)
    photograph = expose(np.full((500, 500), level, np.float32), sensor, rng).astype(float)
    if photons > 10:  # otherwise black and white cut the law
        np.testing.assert_allclose(photograph.mean(), 255 * level, rtol=0.003)
        np.testing.assert_allclose(photograph.var(), (255 * level) ** 2 / photons + 4.0 + 1 / 12, rtol=0.03)
    else:
        exact = np.rint(np.minimum(255 * rng.poisson(photons, 10**6) * level / photons, 255))
        no_read = expose(np.full((500, 500), level, np.float32), replace(sensor, read_noise=0.0), rng)
        np.testing.assert_allclose(no_read.mean(), exact.mean(), rtol=0.01)
        np.testing.assert_allclose(no_read.var(), exact.var(), rtol=0.02)


def test_read_noise_is_normal_and_white(rng: np.random.Generator) -> None:
    sensor = replace(QUIET, read_noise=10.0)
    noise = expose(np.full((500, 500), 0.5, np.float32), sensor, rng).astype(float) - 127.5
    for sigmas, share in ((1, 0.6827), (2, 0.9545), (3, 0.9973)):
        np.testing.assert_allclose((np.abs(noise) < 10 * sigmas).mean(), share, atol=0.003)
    assert np.abs(np.mean(noise[:, 1:] * noise[:, :-1])) < 1.0
    assert np.abs(np.mean(noise[1:] * noise[:-1])) < 1.0


@pytest.mark.parametrize(
    ("flow", "shutter"), [((12.0, 0.0), 0.5), ((6.0, 8.0), 0.8), ((0.0, 9.0), 1.0), ((50.0, 0.0), 0.5)]
)
def test_motion_blur_is_as_long_as_flow_times_shutter(
    flow: tuple[float, float], shutter: float, rng: np.random.Generator
) -> None:
    point = np.zeros((41, 41), np.float32)
    point[20, 20] = 4.0
    constant = expose(point, replace(QUIET, shutter=shutter), rng, flow=np.array(flow))
    # A field that is constant but for one far corner takes the general way.
    field = np.broadcast_to(np.array(flow), (41, 41, 2)).copy()
    field[0, 0] = 0.0
    general = expose(point, replace(QUIET, shutter=shutter), rng, flow=field)
    for photograph in (constant, general):
        for axis in (0, 1):
            # A uniform line of length L has variance L^2 / 12; bilinear sampling adds up to 1/4.
            variance = (flow[axis] * shutter) ** 2 / 12
            assert -0.15 < spread(photograph, axis) ** 2 - variance < 0.3


@pytest.mark.parametrize("length", [25, 32])
def test_a_long_blur_has_no_gaps(length: int, rng: np.random.Generator) -> None:
    point = np.zeros((21, 81), np.float32)
    point[10, 40] = 0.75 * length
    field = np.zeros((21, 81, 2)) + [2.0 * length, 0.0]
    field[0, 0] = 0.0  # or the field would be constant
    line = expose(point, replace(QUIET, shutter=0.5), rng, flow=field)[10].astype(float)
    first = 40 - (length - 3) // 2
    np.testing.assert_allclose(line[first : first + length - 3], 0.75 * 255, rtol=0.1)
    assert line[: first - 3].max() == line[first + length + 1 :].max() == 0


def test_constant_flow_gives_what_the_general_way_gives(texture: np.ndarray, rng: np.random.Generator) -> None:
    sensor = replace(QUIET, shutter=0.5)
    field = np.broadcast_to(np.array([9.0, -6.0]), (*texture.shape, 2)).copy()
    constant = expose(texture, sensor, rng, flow=field).astype(int)
    np.testing.assert_array_equal(expose(texture, sensor, rng, flow=field[0, 0]), constant)
    field[0, 0] = 0.0
    general = expose(texture, sensor, rng, flow=field).astype(int)
    assert np.abs(constant - general)[8:-8, 8:-8].max() <= 3
    assert np.abs(constant - general).mean() < 0.5


def test_motion_blur_needs_a_flow_a_shutter_and_finite_numbers(texture: np.ndarray, rng: np.random.Generator) -> None:
    sharp = expose(texture, QUIET, rng)
    flow = np.zeros((*texture.shape, 2)) + [20.0, 0.0]
    np.testing.assert_array_equal(expose(texture, QUIET, rng, flow=flow), sharp)
    np.testing.assert_array_equal(expose(texture, replace(QUIET, shutter=1.0), rng), sharp)
    flow[:, :64] = np.nan
    flow[:, 63] = np.inf
    photograph = expose(texture, replace(QUIET, shutter=0.5), rng, flow=flow)
    np.testing.assert_array_equal(photograph[:, :64], sharp[:, :64])
    assert np.abs(photograph[:, 64:].astype(int) - sharp[:, 64:]).mean() > 5


def test_vignetting_takes_its_share_at_the_corners_by_the_cos4_law(rng: np.random.Generator) -> None:
    white = np.full((61, 81), 0.8, np.float32)
    photograph = expose(white, replace(QUIET, vignetting=0.4), rng)
    assert photograph[30, 40] == 204
    for corner in (photograph[0, 0], photograph[0, -1], photograph[-1, 0], photograph[-1, -1]):
        assert corner == round(204 * 0.6)
    # Half way to the corner the tangent is half as large.
    square = 0.25 * (0.6**-0.5 - 1)
    assert abs(photograph[15, 20] - 204 * (1 + square) ** -2) <= 0.5


def test_gamma_is_undone_by_its_inverse(texture: np.ndarray, rng: np.random.Generator) -> None:
    photograph = expose(texture, replace(QUIET, gamma=1 / 2.2), rng)
    np.testing.assert_allclose((photograph / 255) ** 2.2, texture, atol=0.005)


def test_gain_and_black_level_are_linear(texture: np.ndarray, rng: np.random.Generator) -> None:
    photograph = expose(texture, replace(QUIET, gain=0.5, offset=0.2), rng)
    np.testing.assert_allclose(photograph, 255 * (0.5 * texture + 0.2), atol=0.51)


def test_point_spread_has_its_sigma(rng: np.random.Generator) -> None:
    point = np.zeros((41, 41), np.float32)
    point[20, 20] = 10.0
    photograph = expose(point, replace(QUIET, blur=1.5), rng)
    assert abs(spread(photograph, 0) - 1.5) < 0.05
    assert abs(spread(photograph, 1) - 1.5) < 0.05


def test_salt_and_pepper_come_at_their_probability(texture: np.ndarray, rng: np.random.Generator) -> None:
    grey = np.full((500, 500), 0.5, np.float32)
    photograph = expose(grey, replace(QUIET, salt_and_pepper=0.01), rng)
    np.testing.assert_allclose((photograph == 255).mean(), 0.005, rtol=0.1)
    np.testing.assert_allclose((photograph == 0).mean(), 0.005, rtol=0.1)


def test_jpeg_loses_more_at_lower_quality(texture: np.ndarray, rng: np.random.Generator) -> None:
    sharp = expose(texture, QUIET, rng).astype(int)
    errors = [
        np.abs(expose(texture, replace(QUIET, jpeg_quality=quality), rng) - sharp).mean() for quality in (95, 60, 20)
    ]
    assert 0 < errors[0] < errors[1] < errors[2] < 10


def test_depth_of_field_keeps_the_focus_and_blurs_what_is_far(texture: np.ndarray, rng: np.random.Generator) -> None:
    depth = np.full(texture.shape, 2.0)
    depth[:, 64:] = 1e3
    depth[:, 124:] = np.nan
    sensor = replace(QUIET, aperture=6.0, focus_distance=2.0)
    sharp = expose(texture, QUIET, rng)
    photograph = expose(texture, sensor, rng, depth=depth)
    np.testing.assert_array_equal(photograph[:, :64], sharp[:, :64])
    np.testing.assert_array_equal(photograph[:, 124:], sharp[:, 124:])
    detail, sharp_detail = (np.diff(image[:, 70:118].astype(float)).std() for image in (photograph, sharp))
    assert detail < 0.5 * sharp_detail
    np.testing.assert_array_equal(expose(texture, replace(sensor, aperture=0.0), rng, depth=depth), sharp)


@pytest.mark.parametrize("radius", [1.0, 2.4, 5.0])
def test_blur_disc_has_the_radius_of_thin_lenses(radius: float, rng: np.random.Generator) -> None:
    point = np.zeros((61, 61), np.float32)
    point[30, 30] = 2.0 * radius**2
    # aperture |1/z - 1/focus| = radius at z = 4, focus 2.
    sensor = replace(QUIET, aperture=4 * radius, focus_distance=2.0)
    photograph = expose(point, sensor, rng, depth=np.full(point.shape, 4.0))
    # A disc has variance r^2 / 4 along each axis; whole pixels add about 1/12.
    assert 0.0 < spread(photograph, 0) ** 2 - radius**2 / 4 < 0.2


def test_the_same_seed_gives_the_same_photograph(texture: np.ndarray) -> None:
    sensor = Sensor(salt_and_pepper=0.01, jpeg_quality=80, photons_at_white=100.0)
    first, again, other = (expose(texture, sensor, np.random.default_rng(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


def test_the_image_given_is_left_as_it_was(texture: np.ndarray, rng: np.random.Generator) -> None:
    before = texture.copy()
    expose(texture, replace(Sensor(blur=0.0, photons_at_white=50.0), salt_and_pepper=0.1), rng)
    np.testing.assert_array_equal(texture, before)


def test_random_sensors_are_json_and_cover_the_training_range() -> None:
    sensors = [random_sensor(np.random.default_rng(seed)) for seed in range(600)]
    assert all(Sensor(**json.loads(json.dumps(asdict(sensor)))) == sensor for sensor in sensors)
    assert sensors[0] == random_sensor(np.random.default_rng(0))
    gammas = np.log([sensor.gamma for sensor in sensors])
    assert gammas.min() < -0.6
    assert gammas.max() > 0.55
    # Black and white of the encoded image.
    black, white = np.array([(s.offset**s.gamma, (s.gain + s.offset) ** s.gamma) for s in sensors]).T
    assert black.min() > -1e-9
    assert 0.28 < (white - black).min() < 0.35
    assert 1.05 < white.max() < 1.11
    blurs = np.array([sensor.blur for sensor in sensors])
    assert 0.4 < (blurs == 0).mean() < 0.6
    assert blurs[blurs > 0].min() > 0.29
    assert blurs.max() < 1.41
    assert 0.15 < np.mean([sensor.jpeg_quality is not None for sensor in sensors]) < 0.25


def test_noise_of_random_sensors_is_between_a_fifth_and_four_per_cent(rng: np.random.Generator) -> None:
    grey = np.full((60, 60), 0.5, np.float32)
    deviations = []
    for seed in range(200):
        sensor = replace(random_sensor(np.random.default_rng(seed)), jpeg_quality=None, salt_and_pepper=0.0)
        flat = replace(sensor, vignetting=0.0, blur=0.0)
        deviations.append(expose(grey, flat, rng).std() / 255)
    assert np.median(deviations) > 0.004
    assert np.quantile(deviations, 0.02) < 0.003
    assert 0.025 < np.quantile(deviations, 0.98) < 0.05


def test_gains_drift_smoothly_within_their_bounds_and_apart() -> None:
    for seed in range(5):
        gains = exposure_gains(np.random.default_rng(seed), 500, drift=0.3, difference=0.1)
        assert gains.shape == (500, 2)
        left, right = np.log(gains).T
        assert np.abs(left + right).max() <= 2 * 0.3
        assert 0.02 < np.abs(left - right).max() <= 0.1
        assert np.ptp(left - right) > 0.02
        assert np.abs(np.diff(np.log(gains), axis=0)).max() < (0.3 + 0.05) * 2 * np.pi / 40
        shorter = exposure_gains(np.random.default_rng(seed), 20, drift=0.3, difference=0.1)
        np.testing.assert_array_equal(gains[:20], shorter)
    np.testing.assert_array_equal(exposure_gains(np.random.default_rng(0), 3, 0.0, 0.0), 1.0)


@pytest.mark.parametrize(
    "wrong", [{"gain": 0.0}, {"vignetting": 1.0}, {"bits": 9}, {"jpeg_quality": 0}, {"blur": -1.0}]
)
def test_a_value_out_of_range_is_named(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        Sensor(**wrong)  # type: ignore[arg-type]
