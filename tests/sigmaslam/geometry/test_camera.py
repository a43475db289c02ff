from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from sigmaslam.errors import CalibrationError
from sigmaslam.geometry.camera import CameraModel, RectifiedStereo, StereoCamera
from sigmaslam.geometry.checked_yaml import CalibrationYaml
from tests.support.calibration_yaml import write_calibration

RADTAN4 = (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05)
RADTAN5 = (-0.3728755, 0.2037299, 2.219027e-03, 1.383707e-03, -0.07233722)
RADTAN8 = (0.5, -0.1, 3e-4, -2e-4, 0.01, 0.8, 0.02, -0.01)
EQUIDISTANT = (-0.013, 0.02, -0.012, 0.003)


def make_camera(model="none", distortion=(), **changes):
    values = {"width": 752, "height": 480, "fx": 458.654, "fy": 457.296, "cx": 367.215, "cy": 248.375}
    return CameraModel(**(values | changes), distortion_model=model, distortion=distortion)


def make_stereo(left=None, right=None, translation=(0.11, 0.0, 0.0), rotation=(0.0, 0.0, 0.0)):
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(np.array(rotation, dtype=float))[0]
    T[:3, 3] = translation
    return StereoCamera(left or make_camera(), right or make_camera(), T)


def points_in_view(count=500, spread=0.7):
    rng = np.random.default_rng(0)
    xy = rng.uniform(-spread, spread, (count, 2))
    return np.c_[xy, np.ones(count)] * rng.uniform(0.5, 50, (count, 1))


def test_numbers_of_numpy_are_python_s_own_and_sides_whole():
    """A calibration in numpy is written, and rectified, as any other."""
    camera = make_camera(width=np.int64(752), height=480.0, fx=np.float64(458.654), fy=np.float32(457.5))
    assert {type(each) for each in (camera.width, camera.height)} == {int}
    assert {type(each) for each in (camera.fx, camera.fy, camera.cx, camera.cy, camera.skew)} == {float}
    with pytest.raises(CalibrationError, match="whole numbers"):
        make_camera(width=752.5)


@pytest.mark.parametrize("coefficients", [RADTAN4, RADTAN5, RADTAN8])
def test_radtan_projection_equals_opencv(coefficients):
    camera = make_camera("radtan", coefficients)
    expected, _ = cv2.projectPoints(points_in_view(), np.zeros(3), np.zeros(3), camera.matrix, np.array(coefficients))
    np.testing.assert_allclose(camera.project(points_in_view()), expected[:, 0], atol=1e-9)


def test_equidistant_projection_equals_opencv():
    camera = make_camera("equidistant", EQUIDISTANT, skew=2.0)
    points = points_in_view(spread=2.0)
    expected, _ = cv2.fisheye.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), camera.matrix, np.array(EQUIDISTANT), alpha=2.0 / camera.fx
    )
    np.testing.assert_allclose(camera.project(points), expected[:, 0], atol=1e-8)


@pytest.mark.parametrize("skew", [0.0, 3.5])
@pytest.mark.parametrize(
    ("model", "coefficients"),
    [
        ("none", ()),
        ("radtan", RADTAN4),
        ("radtan", RADTAN5),
        ("radtan", RADTAN8),
        ("equidistant", EQUIDISTANT),
    ],
)
def test_every_pixel_round_trips(model, coefficients, skew):
    # A long enough lens for every pixel to have a ray (RADTAN5 is of KITTI's 984 px).
    camera = make_camera(model, coefficients, skew=skew, fx=600.0, fy=590.0)
    pixels = np.stack(np.meshgrid(np.arange(0, 752.0, 17), np.arange(0, 480.0, 13)), axis=-1)
    rays = camera.unproject(pixels)
    np.testing.assert_array_equal(rays[..., 2], 1)
    np.testing.assert_allclose(camera.project(rays * 7.3), pixels, atol=1e-6)


def test_radtan_unprojection_equals_opencv():
    camera = make_camera("radtan", RADTAN4)
    pixels = np.random.default_rng(0).uniform((0, 0), (751, 479), (200, 2))
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 200, 1e-14)
    expected = cv2.undistortPoints(
        pixels[:, None], camera.matrix, np.array(RADTAN4), None, None, None, criteria=criteria
    )
    np.testing.assert_allclose(camera.unproject(pixels)[:, :2], expected[:, 0], atol=1e-9)


def test_skew_acts_after_distortion():
    plain, skewed = make_camera("radtan", RADTAN4), make_camera("radtan", RADTAN4, skew=5.0)
    points = points_in_view()
    shift = 5.0 * (plain.project(points)[:, 1] - plain.cy) / plain.fy
    np.testing.assert_allclose(skewed.project(points)[:, 0], plain.project(points)[:, 0] + shift, atol=1e-9)


def test_projection_on_the_axis_is_the_principal_point():
    for camera in (make_camera("radtan", RADTAN4), make_camera("equidistant", EQUIDISTANT)):
        np.testing.assert_allclose(camera.project(np.array([0.0, 0.0, 3.0])), [camera.cx, camera.cy])
        np.testing.assert_allclose(camera.unproject(np.array([camera.cx, camera.cy])), [0, 0, 1])


def test_pixels_without_a_ray_are_nan():
    # The image of this lens ends at a radius of 458 * max(x - 0.5 x^3) = 249 px.
    camera = make_camera("radtan", (-0.5, 0.0, 0.0, 0.0))
    rays = camera.unproject(np.array([[camera.cx + 300, camera.cy], [camera.cx + 200, camera.cy]]))
    np.testing.assert_array_equal(np.isnan(rays[:, 0]), [True, False])
    behind = make_camera("equidistant", (0.0, 0.0, 0.0, 0.0)).unproject(np.array([367.215 + 458.654 * 1.6, 248.0]))
    assert np.isnan(behind[0])


def test_floating_type_follows_the_input():
    camera = make_camera("radtan", RADTAN4)
    assert camera.project(np.ones((2, 3), np.float32)).dtype == np.float32
    assert camera.unproject(np.ones((2, 2), int)).dtype == np.float64
    with pytest.raises(ValueError, match=r"\(\.\.\., 3\), got \(4, 2\)"):
        camera.project(np.ones((4, 2)))


def test_the_matrix_with_skew_projects_as_the_camera_does():
    camera = CameraModel(640, 480, 700.0, 691.0, 320.0, 240.0, skew=6.9)
    np.testing.assert_array_equal(camera.matrix, [[700.0, 6.9, 320.0], [0.0, 691.0, 240.0], [0.0, 0.0, 1.0]])
    pixel = camera.matrix @ [0.2, -0.1, 1.0]
    np.testing.assert_allclose(camera.project(np.array([0.4, -0.2, 2.0])), pixel[:2])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"fx": 0.0}, "focal lengths must be positive"),
        ({"fy": -1.0}, "fy=-1.0"),
        ({"width": 0}, "0x480"),
        ({"cx": float("nan")}, "finite"),
        ({"model": "brown"}, "'brown'; use one of none, radtan, equidistant"),
        ({"model": "radtan", "distortion": (0.1,)}, "1 coefficients; model 'radtan' takes 4 or 5 or 8"),
        ({"distortion": (0.1, 0, 0, 0)}, "model 'none' takes 0"),
    ],
)
def test_wrong_intrinsics_are_refused(changes, message):
    with pytest.raises(CalibrationError, match=message):
        make_camera(**changes)


def test_wrong_extrinsics_are_refused():
    camera = make_camera()
    scaled = np.diag([1.1, 1.0, 1.0, 1.0])
    scaled[0, 3] = 0.1
    for T, message in (
        (np.eye(3), r"4x4 matrix, got shape \(3, 3\)"),
        (scaled, "not orthonormal"),
        (np.diag([-1.0, 1.0, 1.0, 1.0]), "not orthonormal"),
        (np.full((4, 4), np.nan), "finite"),
        (np.ones((4, 4)), "last row"),
    ):
        with pytest.raises(CalibrationError, match=message):
            StereoCamera(camera, camera, T)
    with pytest.raises(CalibrationError, match="left and right look swapped"):
        make_stereo(translation=(-0.11, 0, 0))
    with pytest.raises(CalibrationError, match="stands above the other"):
        make_stereo(translation=(0.01, 0.11, 0))
    with pytest.raises(CalibrationError, match="not beside the left camera"):
        make_stereo(translation=(0.01, 0, 0.11))
    with pytest.raises(CalibrationError, match="baseline is zero"):
        make_stereo(translation=(0, 0, 0))


def test_rectified_pairs_are_recognised():
    assert make_stereo().is_rectified
    assert not make_stereo(left=make_camera("radtan", RADTAN4)).is_rectified
    assert not make_stereo(right=make_camera(skew=1.0)).is_rectified
    assert not make_stereo(right=make_camera(cx=368.0)).is_rectified
    assert not make_stereo(right=make_camera(width=750)).is_rectified
    assert not make_stereo(rotation=(0, 1e-3, 0)).is_rectified
    assert not make_stereo(translation=(0.11, 0.001, 0)).is_rectified


def test_transformation_is_a_read_only_copy():
    T = np.eye(4)
    T[0, 3] = 0.2
    camera = StereoCamera(make_camera(), make_camera(), T)
    T[0, 3] = 9.0
    assert camera.baseline == pytest.approx(0.2)
    with pytest.raises(ValueError, match="read-only"):
        camera.T_left_right[0, 3] = 1.0


def test_yaml_round_trip_is_exact(tmp_path):
    path = tmp_path / "stereo.yaml"
    camera = make_stereo(
        make_camera("radtan", RADTAN5, skew=1e-7),
        make_camera("equidistant", EQUIDISTANT),
        rotation=(0.01, 0.1, -0.02),
    )
    write_calibration(camera, path)
    again = StereoCamera.from_yaml(path)
    assert (again.left, again.right) == (camera.left, camera.right)
    np.testing.assert_array_equal(again.T_left_right, camera.T_left_right)


finite = st.floats(-1e9, 1e9)


@settings(max_examples=40, deadline=None)
@given(fx=st.floats(1e-3, 1e6), centre=st.tuples(finite, finite), distortion=st.tuples(*[st.floats(-10, 10)] * 5))
def test_any_camera_survives_yaml(tmp_path_factory, fx, centre, distortion):
    camera = CameraModel(640, 480, fx, fx, *centre, distortion_model="radtan", distortion=distortion)
    path = tmp_path_factory.mktemp("yaml") / "stereo.yaml"
    write_calibration(make_stereo(camera, make_camera()), path)
    assert StereoCamera.from_yaml(path).left == camera


def yaml_content():
    eye = {"width": 640, "height": 480, "fx": 500.0, "fy": 500, "cx": 320, "cy": 240}
    return {
        "left": dict(eye),
        "right": dict(eye),
        "T_left_right": [[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
    }


def change(path, value):
    content = yaml_content()
    *parents, key = path
    entry = content
    for parent in parents:
        entry = entry[parent]
    if value is None:
        del entry[key]
    else:
        entry[key] = value
    return content


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (["left"], None, "key 'left' is missing; expected a mapping"),
        (["right"], [1, 2], r"key 'right' must be a mapping, got \[1, 2\]"),
        (["right", "fx"], None, "key 'right.fx' is missing; expected a number"),
        (["left", "cy"], "wide", "key 'left.cy' must be a number, got wide"),
        (["left", "cy"], [1, 2], r"key 'left.cy' must be a number, got \[1, 2\] \(size 2\)"),
        (["left", "cy"], True, "key 'left.cy' must be a number, got True"),
        (["left", "width"], 640.5, "key 'left.width' must be a whole number, got 640.5"),
        (["left", "fx"], -500.0, "left: focal lengths must be positive"),
        (["left", "fx"], float("inf"), "key 'left.fx' must be a number, got inf"),
        (["left", "distortion_model"], "brown", "left: distortion_model is 'brown'"),
        (["left", "distortion"], [0.1], "left: distortion has 1 coefficients"),
        (["left", "distorsion"], [0.1], "left: unknown key distorsion; known are width"),
        (["sigma"], {"focal": 0.1}, "unknown key sigma; known are left, right, T_left_right, sigmas, covariance"),
        (["T_left_right"], None, "key 'T_left_right' is missing; expected 4x4 numbers"),
        (["T_left_right"], [[1, 0, 0], [0, 1, 0], [0, 0, 1]], r"must be 4x4 numbers in lists.*\(size 3x3\)"),
        (["T_left_right"], [[1, 0], [0]], "must be 4x4 numbers in lists"),
        (["T_left_right", 0, 3], -0.1, "look swapped"),
    ],
)
def test_yaml_errors_name_file_and_key(tmp_path, path, value, message):
    file = tmp_path / "stereo.yaml"
    file.write_text(yaml.safe_dump(change(path, value)))
    with pytest.raises(CalibrationError, match=message) as caught:
        StereoCamera.from_yaml(file)
    assert str(caught.value).count(str(file)) == 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("left: [1, 2", "not valid YAML"),
        ("- 1\n- 2\n", "expected keys with values, found a list"),
        ("", "found nothing"),
        ("left: {fx: 1,\n  fx: 2}\n", "key 'left.fx' stands twice, in lines 1 and 2: remove"),
        ("T_left_right: 1\nleft: {}\nT_left_right: 2\n", "key 'T_left_right' stands twice, in lines 1 and 3"),
    ],
)
def test_unparsable_yaml_is_refused(tmp_path: Path, text, message):
    file = tmp_path / "stereo.yaml"
    file.write_text(text)
    with pytest.raises(CalibrationError, match=message):
        StereoCamera.from_yaml(file)


def test_one_key_in_two_sections_and_merged_keys_are_no_duplicates(tmp_path: Path):
    file = tmp_path / "stereo.yaml"
    file.write_text("left: &eye {fx: 1.0, fy: 2.0}\nright: {<<: *eye, fx: 3.0}\n")
    right = CalibrationYaml.read(file).section("right")
    assert (right.number("fx"), right.number("fy")) == (3.0, 2.0)


def test_missing_or_binary_yaml_is_refused(tmp_path):
    with pytest.raises(CalibrationError, match="cannot read the calibration"):
        StereoCamera.from_yaml(tmp_path / "none.yaml")
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(CalibrationError, match="cannot read the calibration"):
        StereoCamera.from_yaml(tmp_path / "binary.yaml")


def test_yaml_optional_keys_and_exponents(tmp_path):
    file = tmp_path / "stereo.yaml"
    content = change(["left", "skew"], 0)
    file.write_text(
        "%YAML:1.0\n" + yaml.safe_dump(content | {"residuals": {"rms": 0.1}}).replace("skew: 0", "skew: 1e-3")
    )
    camera = StereoCamera.from_yaml(file)
    assert camera.left.skew == 1e-3
    assert camera.right == CameraModel(640, 480, 500.0, 500.0, 320.0, 240.0)


STEREO = RectifiedStereo(fx=720.0, fy=715.0, cx=600.0, cy=180.0, baseline=0.54, width=1242, height=375)


def test_triangulate_inverts_project_and_equals_two_pinholes():
    points = points_in_view().reshape(50, 10, 3)
    uvd = STEREO.project(points)
    np.testing.assert_allclose(STEREO.triangulate(uvd), points, rtol=1e-12, atol=1e-12)
    camera = CameraModel(1242, 375, 720.0, 715.0, 600.0, 180.0)
    np.testing.assert_allclose(camera.matrix, STEREO.matrix)
    left, right = camera.project(points), camera.project(points - [0.54, 0, 0])
    np.testing.assert_allclose(uvd[..., :2], left)
    np.testing.assert_allclose(uvd[..., 2], left[..., 0] - right[..., 0], rtol=1e-9)
    np.testing.assert_allclose(left[..., 1], right[..., 1])


def test_rays_times_depth_are_the_points():
    points = points_in_view().reshape(50, 10, 3)
    uvd = STEREO.project(points)
    depth = STEREO.focal_baseline / uvd[..., 2:]
    np.testing.assert_allclose(depth * STEREO.rays(uvd[..., :2]), points, rtol=1e-12, atol=1e-12)


def test_disparities_that_are_not_positive_are_counted():
    uvd = np.ones((2, 3, 3))
    uvd[0, 2, 2], uvd[1, 0, 2], uvd[1, 1, 2] = 0.0, -1.0, np.nan
    with pytest.raises(ValueError, match=r"3 of 6 disparities .* 0\.0 at index \(0, 2\)"):
        STEREO.triangulate(uvd)
    with pytest.raises(ValueError, match=r"1 of 3 .* at index 2"):
        STEREO.triangulate(uvd[0])
    assert STEREO.triangulate(np.ones((4, 3), np.float32)).dtype == np.float32


@pytest.mark.parametrize("name", ["width", "height", "fx", "fy", "cx", "cy", "skew", "distortion"])
@pytest.mark.parametrize("value", ["700", None, ("a", "b", "c", "d")], ids=repr)
def test_text_for_a_number_of_a_camera_is_refused(name: str, value: object):
    values = {"width": 640, "height": 480, "fx": 700.0, "fy": 700.0, "cx": 320.0, "cy": 240.0} | {name: value}
    with pytest.raises(CalibrationError, match="must be numbers, got"):
        CameraModel(**values)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["fx", "fy", "cx", "cy", "skew"])
def test_pixels_whose_squares_overflow_are_refused(name: str):
    values = {"fx": 700.0, "fy": 700.0, "cx": 320.0, "cy": 240.0} | {name: 1e300}
    with pytest.raises(CalibrationError, match=r"must be at most 1e\+09 pixels"):
        CameraModel(640, 480, **values)


def test_text_for_the_pose_of_the_right_camera_is_refused():
    eye = CameraModel(640, 480, 700.0, 700.0, 320.0, 240.0)
    with pytest.raises(CalibrationError, match="T_left_right must be a 4x4 matrix of numbers, got 'there'"):
        StereoCamera(eye, eye, "there")  # type: ignore[arg-type]
