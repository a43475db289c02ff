"""The same rig in every form gives the same camera; what is wrong is named."""

import json
import logging
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from sigmaslam.calibration_files.calibration import FOLDER_FILES, calibrated_size, find_calibration, read_calibration
from sigmaslam.calibration_files.calibration_writer import describe_calibration, write_calibration
from sigmaslam.errors import CalibrationError
from sigmaslam.geometry.camera import StereoCamera
from sigmaslam.geometry.rectification import StereoRectifier
from tests.support import calibration_forms as forms
from tests.support.calibration_forms import RAW_FORMS, RECTIFIED_FORMS, SIZE, assert_same_rig, raw_rig, rectified_rig

# Forms with five coefficients, or none for a fisheye lens.
NOT_FISHEYE = {"KITTI raw", "ORB-SLAM2"}


@pytest.mark.parametrize("form", RAW_FORMS)
def test_one_radtan_rig_in_every_form(tmp_path: Path, form: str):
    rig = raw_rig("radtan")
    assert_same_rig(read_calibration(RAW_FORMS[form](rig, tmp_path), SIZE), rig)


@pytest.mark.parametrize("form", sorted(RAW_FORMS.keys() - NOT_FISHEYE))
def test_one_fisheye_rig_in_every_form(tmp_path: Path, form: str):
    rig = raw_rig("equidistant")
    assert_same_rig(read_calibration(RAW_FORMS[form](rig, tmp_path), SIZE), rig)


@pytest.mark.parametrize("form", RECTIFIED_FORMS)
def test_one_rectified_rig_in_every_form(tmp_path: Path, form: str):
    rig = rectified_rig()
    assert_same_rig(read_calibration(RECTIFIED_FORMS[form](rig, tmp_path), SIZE), rig)


@pytest.mark.parametrize("form", ["ROS", "ORB-SLAM2"])
def test_rectified_images_have_the_cameras_of_p(tmp_path: Path, form: str):
    rig = raw_rig("radtan")
    camera = read_calibration(RAW_FORMS[form](rig, tmp_path), rectified=True)
    assert camera.is_rectified
    assert camera.baseline == pytest.approx(rig.baseline, rel=1e-9)
    assert camera.left.fx != rig.left.fx


@pytest.mark.parametrize("form", RAW_FORMS)
def test_what_is_written_is_read_back_exactly(tmp_path: Path, form: str):
    camera = read_calibration(RAW_FORMS[form](raw_rig("radtan"), tmp_path), SIZE)
    write_calibration(tmp_path / "written.yaml", camera)
    again = StereoCamera.from_yaml(tmp_path / "written.yaml")
    assert (again.left, again.right, again.sigmas) == (camera.left, camera.right, camera.sigmas)
    np.testing.assert_array_equal(again.T_left_right, camera.T_left_right)


def test_zed_rectification_is_that_of_opencv_with_the_numbers_of_the_file(tmp_path: Path):
    """Stereolabs' calibration tool writes what cv2.stereoCalibrate found, with the sign of T[0] turned."""
    rig = raw_rig("radtan")
    camera = read_calibration(forms.write_zed(rig, tmp_path), SIZE)
    lines = dict(line.split("=") for line in (tmp_path / "SN12345.conf").read_text().splitlines() if "=" in line)
    R = cv2.Rodrigues(np.array([float(lines[f"{axis}_VGA"]) for axis in ("RX", "CV", "RZ")]))[0]
    T = np.array([-float(lines["Baseline"]), float(lines["TY"]), float(lines["TZ"])])[:, None]
    K = [eye.matrix for eye in (rig.left, rig.right)]
    D = [np.array(eye.distortion) for eye in (rig.left, rig.right)]
    R1, R2 = cv2.stereoRectify(K[0], D[0], K[1], D[1], SIZE, R, T)[:2]
    rectifier = StereoRectifier(camera)
    np.testing.assert_allclose(rectifier.R_rectified_left, R1, atol=1e-9)
    np.testing.assert_allclose(rectifier.R_rectified_right, R2, atol=1e-9)


def test_euroc_agrees_with_what_others_publish_of_it(real_data: Path, tmp_path: Path):
    """Stereo.T_c1_c2 of ORB-SLAM3's EuRoC settings, in single precision, is of the same two sensor.yaml."""
    published = [
        [0.999997256477797, -0.002317135723275, -0.000343393120620, 0.110074137800478],
        [0.002312067192432, 0.999898048507103, -0.014090668452683, -0.000156612054392],
        [0.000376008102320, 0.014089835846691, 0.999900662638081, 0.000889382785432],
        [0, 0, 0, 1],
    ]
    camera = read_calibration(real_data / "euroc_mh01_f000_099")
    np.testing.assert_allclose(camera.T_left_right, published, atol=1e-7)
    cameras = {
        f"cam{k}": {
            "camera_model": "pinhole",
            "intrinsics": [eye.fx, eye.fy, eye.cx, eye.cy],
            "distortion_model": "radtan",
            "distortion_coeffs": list(eye.distortion),
            "resolution": [eye.width, eye.height],
        }
        for k, eye in enumerate((camera.left, camera.right))
    }
    cameras["cam1"]["T_cn_cnm1"] = np.linalg.inv(camera.T_left_right).tolist()
    (tmp_path / "camchain.yaml").write_text(yaml.safe_dump(cameras))
    assert_same_rig(read_calibration(tmp_path / "camchain.yaml"), camera)


def test_raw_and_rectified_kitti_are_told_apart_by_the_size(real_data: Path):
    path = real_data / "kitti_raw_0926_0039_a" / "calib_cam_to_cam.txt"
    assert read_calibration(path, (1392, 512)).left.distortion_model == "radtan"
    with pytest.raises(CalibrationError, match=r"is for S_rect_00 .*, S_00 1392x512; give --size"):
        read_calibration(path)


def test_a_real_fisheye_camchain_can_be_rectified(tmp_path: Path):
    """Published numbers of TUM-VI at 512x512; the borders are beyond 60 degrees from the axis."""
    (tmp_path / "camchain.yaml").write_text("""cam0:
  camera_model: pinhole
  distortion_coeffs: [0.0034823894022493434, 0.0007150348452162257, -0.0020532361418706202, 0.00020293673591811182]
  distortion_model: equidistant
  intrinsics: [190.97847715128717, 190.9733070521226, 254.93170605935475, 256.8974428996504]
  resolution: [512, 512]
cam1:
  camera_model: pinhole
  distortion_coeffs: [0.0034003170790442797, 0.001766278153469831, -0.00266312569781606, 0.0003299517423931039]
  distortion_model: equidistant
  intrinsics: [190.44236969414825, 190.4344384721956, 252.59949716835982, 254.91723064636983]
  resolution: [512, 512]
  T_cn_cnm1: [[1, 0, 0, -0.101], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
""")
    camera = read_calibration(tmp_path / "camchain.yaml")
    assert camera.baseline == pytest.approx(0.101)
    rectified = StereoRectifier(camera).rectified
    assert 2 * np.degrees(np.arctan(256 / rectified.fx)) > 90
    assert "lens equidistant (4), field of view 15" in describe_calibration(camera)


@pytest.mark.parametrize("form", ["Kalibr", "ROS", "EuRoC", "OpenCV in two files", "ZED", "OAK", "KITTI raw"])
def test_a_folder_with_a_calibration_is_one(tmp_path: Path, form: str):
    rig = raw_rig("radtan")
    RAW_FORMS[form](rig, tmp_path)
    assert_same_rig(read_calibration(tmp_path, SIZE), rig)
    found = find_calibration(tmp_path)
    assert found is not None
    assert_same_rig(read_calibration(found, SIZE), rig)


def test_folders_may_have_commas_in_their_names(tmp_path: Path):
    (tmp_path / "one, two").mkdir()
    RAW_FORMS["ROS"](raw_rig("radtan"), tmp_path / "one, two")
    found = find_calibration(tmp_path / "one, two")
    assert found is not None
    assert_same_rig(read_calibration(found), raw_rig("radtan"))


def test_of_4seasons_the_undistorted_calibration_is_taken(tmp_path: Path):
    forms.write_kalibr(raw_rig("equidistant"), tmp_path)
    forms.write_four_seasons(rectified_rig(), tmp_path)
    assert_same_rig(read_calibration(tmp_path), rectified_rig())


def test_a_folder_without_a_calibration_says_what_it_looked_for(tmp_path: Path):
    assert find_calibration(tmp_path) is None
    with pytest.raises(CalibrationError) as caught:
        read_calibration(tmp_path)
    for names in FOLDER_FILES:
        assert names[0] in str(caught.value)


def test_the_size_of_the_images_is_known_or_asked_for(tmp_path: Path):
    assert calibrated_size(forms.write_kalibr(rectified_rig(), tmp_path)) == SIZE
    for write in (forms.write_kitti, forms.write_opencv_xml, forms.write_zed):
        path = write(rectified_rig() if write is forms.write_kitti else raw_rig("radtan"), tmp_path)
        assert calibrated_size(path) is None
        with pytest.raises(CalibrationError, match="give --size"):
            read_calibration(path)


def edited(path: Path, old: str, new: str) -> Path:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    return path


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("camera_model: pinhole", "camera_model: omni", "cam0: camera_model is 'omni', the omnidirectional model"),
        ("camera_model: pinhole", "camera_model: ds", "'ds', the double-sphere model, which is not supported"),
        ("camera_model: pinhole", "camera_model: orthographic", "cam0: camera_model is 'orthographic'"),
        ("distortion_model: radtan", "distortion_model: fov", "cam0: distortion_model is 'fov', the field-of-view"),
        ("distortion_model: radtan", "distortion_model: cubic", "cam0: distortion_model is 'cubic'; known are"),
        ("T_cn_cnm1", "T_other", "cam1: T_cn_cnm1 is missing: the cameras were calibrated one by one"),
        ("intrinsics: [358.6,", "intrinsics: [358.6, 1.0,", "key 'cam0.intrinsics' must be 4 numbers"),
        ("cam1:", "cam7:", r"no stereo calibration of a known form \(keys: cam0, cam7\)"),
    ],
)
def test_kalibr_errors(tmp_path: Path, old: str, new: str, message: str):
    path = edited(forms.write_kalibr(raw_rig("radtan"), tmp_path), old, new)
    with pytest.raises(CalibrationError, match=message) as caught:
        read_calibration(path)
    assert str(caught.value).startswith(str(path))


def test_a_calibration_of_one_camera_is_named(tmp_path: Path):
    path = tmp_path / "one.yaml"
    path.write_text(
        "camera: {fx: 500}\nresiduals: {}\nparameters: {}\n"
    )  # as `sigmaslam calibrate` of one eye's images
    with pytest.raises(CalibrationError, match=r"one\.yaml: of one camera: calibrate with images of both eyes"):
        read_calibration(path)


def test_kalibr_cameras_in_the_wrong_order(tmp_path: Path):
    path = forms.write_kalibr(raw_rig("radtan"), tmp_path)
    content = yaml.safe_load(path.read_text())
    content["cam1"]["T_cn_cnm1"] = np.linalg.inv(content["cam1"]["T_cn_cnm1"]).tolist()
    path.write_text(yaml.safe_dump(content))
    with pytest.raises(CalibrationError, match="left and right look swapped"):
        read_calibration(path)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"K2": None}, r"no stereo calibration; looked for K1 \+ K2"),
        ({"D2": None}, "key 'D2' is missing; expected a mapping"),
        ({"T": None}, r"R and T .* P1, P2, R1, R2 missing"),
        ({"K1": np.eye(4)}, "key 'K1' must be a matrix of 3x3 numbers"),
        ({"D1": np.full((1, 14), 0.1)}, "D1: thin prism and tilt .* are not supported"),
        ({"D1": np.full((1, 4), np.nan)}, r"key 'D1\.data' must be a list of numbers"),
        ({"R": np.zeros((3, 3))}, "R and T: a matrix has no inverse"),
        ({"T": np.array([[0.12], [0.0], [0.0]])}, "left and right look swapped"),
    ],
)
def test_opencv_errors(tmp_path: Path, values: dict[str, np.ndarray | None], message: str):
    path = forms.write_opencv(raw_rig("radtan"), tmp_path)
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    kept = {key: storage.getNode(key).mat() for key in ("K1", "D1", "K2", "D2", "R", "T")} | values
    storage.release()
    forms.store(path, **{key: value for key, value in kept.items() if value is not None})
    with pytest.raises(CalibrationError, match=message) as caught:
        read_calibration(path, SIZE)
    assert str(caught.value).startswith(str(path))


@pytest.mark.parametrize(
    "text", ["%YAML:1.0\na: [1, 2", "%YAML:1.0\n---\nK1: !!opencv-matrix\n   rows: 3\n", "%YAML:1.0\n"]
)
def test_a_broken_file_of_opencv_is_named(tmp_path: Path, text: str):
    path = tmp_path / "broken.yml"
    path.write_text(text)
    with pytest.raises(CalibrationError, match=r"broken\.yml: (not valid YAML|key .K1. |expected keys|no stereo)"):
        read_calibration(path, SIZE)


def test_opencv_with_four_coefficients_is_warned_about(tmp_path: Path, caplog):
    rig = raw_rig("equidistant")
    path = forms.write_opencv_xml(rig, tmp_path)
    edited(path, "distortion_model", "comment")
    edited(path, "/distortion_model", "/comment")
    T = np.linalg.inv(rig.T_left_right)[:3, 3:]
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    kept = {
        key: storage.getNode(key).mat() for key in ("cameraMatrix1", "distCoeffs1", "cameraMatrix2", "distCoeffs2", "R")
    }
    storage.release()
    forms.store(path, **kept, T=T)
    with caplog.at_level(logging.WARNING):
        assert read_calibration(path, SIZE).left.distortion_model == "radtan"
    assert "4 coefficients, taken as k1 k2 p1 p2" in caplog.text


def test_a_blank_after_the_comma_is_no_part_of_a_name(tmp_path: Path):
    forms.write_ros(raw_rig("radtan"), tmp_path)
    pair = f"{tmp_path / 'left.yaml'},{tmp_path / 'right.yaml'}"
    spaced = read_calibration(pair.replace(",", ", "))
    np.testing.assert_array_equal(spaced.T_left_right, read_calibration(pair).T_left_right)


def test_one_eye_alone_is_refused(tmp_path: Path):
    forms.write_ros(raw_rig("radtan"), tmp_path)
    with pytest.raises(CalibrationError, match=r"of one eye; .* left.yaml,right.yaml"):
        read_calibration(tmp_path / "left.yaml")
    forms.write_euroc(raw_rig("radtan"), tmp_path)
    with pytest.raises(CalibrationError, match="of one eye; give both"):
        read_calibration(tmp_path / "cam0" / "sensor.yaml")
    with pytest.raises(CalibrationError, match="not the calibrations of two eyes"):
        read_calibration(Path(f"{tmp_path / 'left.yaml'},{forms.write_kalibr(rectified_rig(), tmp_path)}"))


def test_ros_eyes_that_were_calibrated_one_by_one_are_refused(tmp_path: Path):
    path = forms.write_ros(rectified_rig(), tmp_path)
    content = yaml.safe_load((tmp_path / "right.yaml").read_text())
    content["projection_matrix"]["data"][3] = 0.0
    (tmp_path / "right.yaml").write_text(yaml.safe_dump(content))
    with pytest.raises(CalibrationError, match=r"right.yaml: no baseline \(P\[0, 3\] is 0\)"):
        read_calibration(path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("LEFT_CAM_VGA", "LEFT_CAM_HD", r"images are 672x376, the calibration is for 1280x720"),
        ("RX_VGA", "RX_HD", "key 'STEREO.rx_vga' is missing; expected a number"),
        ("Baseline=", "Baseline=long", "key 'STEREO.baseline' must be a number, got long"),
        ("Baseline=", "Baseline=-", r"\[STEREO\]: left and right look swapped"),
        ("[STEREO]", "STEREO]", "cannot read the calibration"),
    ],
)
def test_zed_errors(tmp_path: Path, old: str, new: str, message: str):
    path = edited(forms.write_zed(raw_rig("radtan"), tmp_path), old, new)
    with pytest.raises(CalibrationError, match=message) as caught:
        read_calibration(path, SIZE)
    assert str(caught.value).startswith(str(path))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda content: content.pop("cameraData"), "no key 'cameraData'"),
        (lambda content: content["cameraData"].pop(), "no camera of socket 1; it has"),
        (lambda content: content["cameraData"][2][1].pop("intrinsicMatrix"), "key 'cameraData 1.intrinsicMatrix'"),
        (lambda content: content["cameraData"][2][1].update(cameraType=2), "cameraData 1: cameraType is 2"),
        (lambda content: content["cameraData"][2][1]["extrinsics"].update(toCameraSocket=-1), "no camera in common"),
        (lambda content: content["cameraData"][2][1]["extrinsics"].update(toCameraSocket=9), "no camera of socket 9"),
        (lambda content: content["cameraData"][2][1]["distortionCoeff"].__setitem__(13, 0.1), "thin prism and tilt"),
        (lambda content: content.update(cameraData=[1, 2]), "must be a list of"),
    ],
)
def test_oak_errors(tmp_path: Path, change, message: str):
    path = forms.write_oak(raw_rig("radtan"), tmp_path)
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
    with pytest.raises(CalibrationError, match=message) as caught:
        read_calibration(path)
    assert str(caught.value).startswith(str(path))


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("undistorted_calib_0.txt", "RadTan 1 2 3 4\n10 10\n", "must begin with a line 'Pinhole"),
        ("undistorted_calib_1.txt", "Pinhole 1 2 3 4 0.1\n10 10\n", "then zeros as the images are undistorted"),
        ("undistorted_calib_stereo.txt", "1 0 0\n", "must be 4 lines of 4 numbers"),
        ("undistorted_calib_stereo.txt", "one\n", "could not convert"),
    ],
)
def test_four_seasons_errors(tmp_path: Path, name: str, text: str, message: str):
    forms.write_four_seasons(rectified_rig(), tmp_path)
    (tmp_path / name).write_text(text)
    with pytest.raises(CalibrationError, match=message) as caught:
        read_calibration(tmp_path)
    assert str(caught.value).startswith(str(tmp_path / name))


def test_rectified_goes_with_forms_that_have_p(tmp_path: Path):
    with pytest.raises(CalibrationError, match="--rectified goes with"):
        read_calibration(forms.write_kalibr(raw_rig("radtan"), tmp_path), rectified=True)
    with pytest.raises(CalibrationError, match="P1, P2 missing"):
        read_calibration(forms.write_opencv(raw_rig("radtan"), tmp_path), rectified=True)
