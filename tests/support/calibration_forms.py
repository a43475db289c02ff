"""One stereo rig written in the forms of other programs, from their documentation and without the package's readers."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import yaml

from sigmaslam.geometry.camera import CameraModel, StereoCamera
from tests.support.calibration_yaml import write_calibration

SIZE = (672, 376)


def raw_rig(lens: str) -> StereoCamera:
    """Two cameras that differ, turned by about a degree; lens is 'radtan' or 'equidistant'."""
    coefficients = {
        "radtan": ((-0.283, 0.0739, 0.00019, 1.76e-5, 0.0021), (-0.2836, 0.0745, -0.0001, -3.5e-5, 0.0013)),
        "equidistant": ((0.0034, 0.0007, -0.0021, 0.0002), (0.0036, 0.0008, -0.0020, 0.0001)),
    }[lens]
    left = CameraModel(*SIZE, 358.6, 357.3, 330.2, 190.4, 0.0, lens, coefficients[0])  # type: ignore[arg-type]
    right = CameraModel(*SIZE, 357.5, 356.1, 338.0, 185.2, 0.0, lens, coefficients[1])  # type: ignore[arg-type]
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(np.array([0.0141, -0.0036, 0.0023]))[0]
    T[:3, 3] = [0.1199, 0.0004, -0.0012]
    return StereoCamera(left, right, T)


def rectified_rig() -> StereoCamera:
    """Two equal pinhole cameras beside each other."""
    eye = CameraModel(*SIZE, 358.6, 358.6, 330.25, 190.5)
    T = np.eye(4)
    T[0, 3] = 0.125
    return StereoCamera(eye, eye, T)


def assert_same_rig(read: StereoCamera, rig: StereoCamera, tolerance: float = 1e-9) -> None:
    """Sizes, projections of points all over the image, and the pose of the right camera agree."""
    np.testing.assert_allclose(read.T_left_right, rig.T_left_right, rtol=0, atol=tolerance)
    x, y = np.meshgrid(np.linspace(-0.8, 0.8, 9), np.linspace(-0.5, 0.5, 7))
    points = np.stack([x, y, np.ones_like(x)], axis=-1)
    for one, other in ((read.left, rig.left), (read.right, rig.right)):
        assert (one.width, one.height) == (other.width, other.height)
        np.testing.assert_allclose(one.project(points), other.project(points), rtol=0, atol=1e3 * tolerance)
    assert read.is_rectified == rig.is_rectified


def _intrinsics(eye: CameraModel) -> list[float]:
    return [eye.fx, 0.0, eye.cx, 0.0, eye.fy, eye.cy, 0.0, 0.0, 1.0]


def _right_left(rig: StereoCamera) -> np.ndarray:
    """T_right_left (4, 4), by the formula."""
    R, t = rig.T_left_right[:3, :3], rig.T_left_right[:3, 3]
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R.T, -R.T @ t
    return T


def _rectification(rig: StereoCamera) -> tuple[np.ndarray, ...]:
    """R1, R2, P1, P2 of OpenCV; the lens does not matter for what they say of the pose."""
    T = _right_left(rig)
    K = [np.array(_intrinsics(eye)).reshape(3, 3) for eye in (rig.left, rig.right)]
    return cv2.stereoRectify(K[0], np.zeros(5), K[1], np.zeros(5), SIZE, T[:3, :3], T[:3, 3:])[:4]


def _dump(path: Path, content: object) -> Path:
    path.write_text(yaml.safe_dump(content, sort_keys=False, default_flow_style=None))
    return path


def store(path: Path, **values: object) -> Path:
    """Values in a file of OpenCV's FileStorage; the suffix says which of its forms."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in values.items():
        storage.write(key, value)
    storage.release()
    return path


def write_own(rig: StereoCamera, folder: Path) -> Path:
    write_calibration(rig, folder / "own.yaml")
    return folder / "own.yaml"


def _kalibr_cameras(rig: StereoCamera) -> dict[str, dict[str, object]]:
    return {
        name: {
            "cam_overlaps": [1 - k],
            "camera_model": "pinhole",
            "distortion_coeffs": list(eye.distortion) or [0.0] * 4,
            "distortion_model": "equidistant" if eye.distortion_model == "equidistant" else "radtan",
            "intrinsics": [eye.fx, eye.fy, eye.cx, eye.cy],
            "resolution": [eye.width, eye.height],
            "rostopic": f"/cam{k}/image_raw",
        }
        for k, (name, eye) in enumerate((("cam0", rig.left), ("cam1", rig.right)))
    }


def write_kalibr(rig: StereoCamera, folder: Path) -> Path:
    cameras = _kalibr_cameras(rig)
    cameras["cam1"]["T_cn_cnm1"] = _right_left(rig).tolist()
    return _dump(folder / "camchain.yaml", cameras)


def write_kalibr_imu(rig: StereoCamera, folder: Path) -> Path:
    """Without T_cn_cnm1: both cameras relative to an IMU."""
    cameras = _kalibr_cameras(rig)
    T_left_imu = np.eye(4)
    T_left_imu[:3, :3] = cv2.Rodrigues(np.array([0.3, -1.2, 0.7]))[0]
    T_left_imu[:3, 3] = [0.05, -0.02, 0.01]
    cameras["cam0"]["T_cam_imu"] = T_left_imu.tolist()
    cameras["cam1"]["T_cam_imu"] = (_right_left(rig) @ T_left_imu).tolist()
    return _dump(folder / "camchain-imucam.yaml", cameras)


def _opencv_values(rig: StereoCamera, K: str, D: str) -> dict[str, object]:
    T = _right_left(rig)
    values: dict[str, object] = {}
    for k, eye in ((1, rig.left), (2, rig.right)):
        values[f"{K}{k}"] = np.array(_intrinsics(eye)).reshape(3, 3)
        values[f"{D}{k}"] = np.array([eye.distortion or [0.0] * 5])
    return values | {"R": T[:3, :3].copy(), "T": T[:3, 3:].copy()}


def _opencv_lens(rig: StereoCamera) -> dict[str, object]:
    return {"distortion_model": "equidistant"} if rig.left.distortion_model == "equidistant" else {}


def write_opencv(rig: StereoCamera, folder: Path) -> Path:
    values = _opencv_values(rig, "K", "D") | _opencv_lens(rig)
    return store(folder / "stereo.yml", image_width=SIZE[0], image_height=SIZE[1], **values)


def write_opencv_xml(rig: StereoCamera, folder: Path) -> Path:
    values = _opencv_values(rig, "cameraMatrix", "distCoeffs") | _opencv_lens(rig)
    return store(folder / "stereo.xml", **values)


def write_opencv_pair(rig: StereoCamera, folder: Path) -> Path:
    """As OpenCV's stereo_calib writes them: intrinsics and extrinsics, without the size of the images."""
    values = _opencv_values(rig, "M", "D") | _opencv_lens(rig)
    extrinsics = {key: values.pop(key) for key in ("R", "T")}
    first = store(folder / "intrinsics.yml", **values)
    return Path(f"{first},{store(folder / 'extrinsics.yml', **extrinsics)}")


def _opencv_matrix(key: str, matrix: np.ndarray) -> str:
    """With no space before the list, as in ORB-SLAM2's own files, which YAML alone does not allow."""
    numbers = ", ".join(repr(float(value)) for value in np.ravel(matrix))
    rows, columns = np.atleast_2d(matrix).shape
    return f"{key}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data:[{numbers}]\n"


def write_orb_slam2(rig: StereoCamera, folder: Path) -> Path:
    R1, R2, P1, P2 = _rectification(rig)
    text = f"%YAML:1.0\n\nCamera.fx: {P1[0, 0]}\nCamera.bf: 47.9\nLEFT.height: {SIZE[1]}\nLEFT.width: {SIZE[0]}\n"
    for name, eye, R, P in (("LEFT", rig.left, R1, P1), ("RIGHT", rig.right, R2, P2)):
        D = np.array([eye.distortion or [0.0] * 5])
        for key, matrix in (("D", D), ("K", np.array(_intrinsics(eye)).reshape(3, 3)), ("R", R), ("P", P)):
            text += _opencv_matrix(f"{name}.{key}", matrix)
    (folder / "EuRoC.yaml").write_text(text)
    return folder / "EuRoC.yaml"


def write_orb_slam3(rig: StereoCamera, folder: Path) -> Path:
    kind = {"radtan": "PinHole", "equidistant": "KannalaBrandt8", "none": "Rectified"}[rig.left.distortion_model]
    names = ("k1", "k2", "k3", "k4") if kind == "KannalaBrandt8" else ("k1", "k2", "p1", "p2", "k3")
    text = f'%YAML:1.0\n\nFile.version: "1.0"\n\nCamera.type: "{kind}"\n\n'
    for k, eye in ((1, rig.left), (2, rig.right)):
        values = {name: getattr(eye, name) for name in ("fx", "fy", "cx", "cy")}
        values |= dict(zip(names, eye.distortion, strict=False))
        text += "".join(f"Camera{k}.{name}: {value!r}\n" for name, value in values.items())
    text += f"Camera.width: {SIZE[0]}\nCamera.height: {SIZE[1]}\nCamera.fps: 20\nStereo.ThDepth: 60.0\n"
    if kind == "Rectified":
        text += f"Stereo.b: {rig.baseline!r}\n"
    else:
        text += _opencv_matrix("Stereo.T_c1_c2", rig.T_left_right)
    (folder / "orb3.yaml").write_text(text)
    return folder / "orb3.yaml"


def write_orb_bf(rig: StereoCamera, folder: Path) -> Path:
    """Settings of rectified images alone."""
    eye = rig.left
    text = "%YAML:1.0\n" + "".join(f"Camera.{name}: {getattr(eye, name)!r}\n" for name in ("fx", "fy", "cx", "cy"))
    text += f"Camera.width: {SIZE[0]}\nCamera.height: {SIZE[1]}\nCamera.bf: {eye.fx * rig.baseline!r}\n"
    (folder / "KITTI.yaml").write_text(text)
    return folder / "KITTI.yaml"


def write_ros(rig: StereoCamera, folder: Path) -> Path:
    R1, R2, P1, P2 = _rectification(rig)
    model = "equidistant" if rig.left.distortion_model == "equidistant" else "plumb_bob"

    def matrix(values: np.ndarray, rows: int) -> dict[str, object]:
        return {"rows": rows, "cols": values.size // rows, "data": values.ravel().tolist()}

    for name, eye, R, P in (("left", rig.left, R1, P1), ("right", rig.right, R2, P2)):
        content = {
            "image_width": eye.width,
            "image_height": eye.height,
            "camera_name": f"narrow_stereo/{name}",
            "camera_matrix": matrix(np.array(_intrinsics(eye)), 3),
            "distortion_model": model,
            "distortion_coefficients": matrix(np.array(eye.distortion or [0.0] * 5), 1),
            "rectification_matrix": matrix(R, 3),
            "projection_matrix": matrix(P, 3),
        }
        _dump(folder / f"{name}.yaml", content)
    return Path(f"{folder / 'left.yaml'},{folder / 'right.yaml'}")


def write_euroc(rig: StereoCamera, folder: Path) -> Path:
    T_body_left = np.eye(4)
    T_body_left[:3, :3] = cv2.Rodrigues(np.array([0.1, 0.2, 1.6]))[0]
    T_body_left[:3, 3] = [-0.02, -0.06, 0.01]
    names = {"radtan": "radial-tangential", "equidistant": "equidistant", "none": "none"}
    for name, eye, T in (
        ("cam0", rig.left, T_body_left),
        ("cam1", rig.right, T_body_left @ rig.T_left_right),
    ):
        (folder / name).mkdir()
        content = {
            "sensor_type": "camera",
            "T_BS": {"cols": 4, "rows": 4, "data": T.ravel().tolist()},
            "resolution": list(SIZE),
            "camera_model": "pinhole",
            "intrinsics": [eye.fx, eye.fy, eye.cx, eye.cy],
            "distortion_model": names[eye.distortion_model],
            "distortion_coefficients": list(eye.distortion),
        }
        path = _dump(folder / name / "sensor.yaml", content)
        path.write_text("%YAML:1.0\n" + path.read_text())
    return folder


def write_kitti_raw(rig: StereoCamera, folder: Path) -> Path:
    """calib_cam_to_cam.txt; both cameras stand in a frame of their own."""
    T_left_world = np.eye(4)
    T_left_world[:3, :3] = cv2.Rodrigues(np.array([0.01, 0.02, -0.01]))[0]
    T_left_world[:3, 3] = [0.01, 0.0, 0.02]
    lines = ["calib_time: 09-Jan-2012 13:57:47"]
    for k, (eye, T) in enumerate(((rig.left, T_left_world), (rig.right, _right_left(rig) @ T_left_world))):
        for key, values in (
            ("S", SIZE),
            ("K", _intrinsics(eye)),
            ("D", eye.distortion),
            ("R", T[:3, :3]),
            ("T", T[:3, 3]),
            ("S_rect", (600, 300)),
            ("R_rect", np.eye(3)),
            ("P_rect", np.eye(3, 4)),
        ):
            lines.append(f"{key}_{k:02d}: " + " ".join(repr(float(value)) for value in np.ravel(values)))
    (folder / "calib_cam_to_cam.txt").write_text("\n".join(lines))
    return folder / "calib_cam_to_cam.txt"


def write_kitti(rig: StereoCamera, folder: Path) -> Path:
    """calib.txt of rectified images."""
    lines = []
    for k, x in enumerate((0.0, rig.baseline)):
        P = np.hstack([np.array(_intrinsics(rig.left)).reshape(3, 3), np.zeros((3, 1))])
        P[0, 3] = -rig.left.fx * x
        lines.append(f"P{k}: " + " ".join(repr(float(value)) for value in P.ravel()))
    (folder / "calib.txt").write_text("\n".join(lines))
    return folder / "calib.txt"


def write_zed(rig: StereoCamera, folder: Path) -> Path:
    """As Stereolabs' calibration tool does: OpenCV's R and T with the sign of T[0] turned, millimetres."""
    T = _right_left(rig)
    vector = cv2.Rodrigues(T[:3, :3])[0].ravel()
    text = ""
    for name, eye in (("LEFT", rig.left), ("RIGHT", rig.right)):
        text += f"[{name}_CAM_VGA]\n" + "".join(f"{key}={getattr(eye, key)!r}\n" for key in ("fx", "fy", "cx", "cy"))
        if eye.distortion_model == "radtan":
            pairs = zip(("k1", "k2", "p1", "p2", "k3"), eye.distortion, strict=True)
        else:
            text += f"\n[{name}_DISTO]\n"
            pairs = zip(("k1", "k2", "k3", "k4"), eye.distortion, strict=True)
        text += "".join(f"{key} = {value!r}\n" for key, value in pairs) + "\n"
    x, y, z = (1e3 * T[:3, 3]).tolist()
    text += f"[STEREO]\nBaseline={-x!r}\nTY={y!r}\nTZ={z!r}\n"
    text += "".join(f"{key}_VGA={float(value)!r}\n" for key, value in zip(("RX", "CV", "RZ"), vector, strict=True))
    (folder / "SN12345.conf").write_text(text)
    return folder / "SN12345.conf"


def write_oak(rig: StereoCamera, folder: Path) -> Path:
    """Left to right to the colour camera between them, in centimetres."""
    T_colour_right = np.eye(4)
    T_colour_right[:3, 3] = [0.0375, 0.0, 0.0]

    def camera(eye: CameraModel, T: np.ndarray, target: int) -> dict[str, object]:
        x, y, z = (1e2 * T[:3, 3]).tolist()
        fisheye = eye.distortion_model == "equidistant"
        return {
            "cameraType": int(fisheye),
            "distortionCoeff": [*eye.distortion, *[0.0] * (14 - len(eye.distortion))],
            "extrinsics": {
                "rotationMatrix": T[:3, :3].tolist() if target >= 0 else [],
                "specTranslation": {"x": 7.5, "y": 0.0, "z": 0.0},
                "toCameraSocket": target,
                "translation": {"x": x, "y": y, "z": z},
            },
            "height": SIZE[1],
            "intrinsicMatrix": np.array(_intrinsics(eye)).reshape(3, 3).tolist(),
            "lensPosition": 0,
            "specHfovDeg": 71.86,
            "width": SIZE[0],
        }

    content = {
        "boardName": "BW1098OBC",
        "cameraData": [
            [0, camera(rig.left, np.eye(4), -1)],
            [2, camera(rig.right, T_colour_right, 0)],
            [1, camera(rig.left, _right_left(rig), 2)],
        ],
        "stereoRectificationData": {"leftCameraSocket": 1, "rightCameraSocket": 2},
        "version": 7,
    }
    (folder / "calib.json").write_text(json.dumps(content))
    return folder / "calib.json"


def write_four_seasons(rig: StereoCamera, folder: Path) -> Path:
    """Undistorted images: two pinhole files and the matrix from left to right."""
    for k, eye in enumerate((rig.left, rig.right)):
        line = f"Pinhole {eye.fx!r} {eye.fy!r} {eye.cx!r} {eye.cy!r} 0.0 0.0 0.0 0.0\n"
        size = f"{SIZE[0]} {SIZE[1]}\n"
        (folder / f"undistorted_calib_{k}.txt").write_text(f"{line}{size}crop\n{size}")
    rows = [" ".join(repr(float(value)) for value in row) for row in _right_left(rig)]
    (folder / "undistorted_calib_stereo.txt").write_text("\n".join(rows) + "\n")
    return folder


RAW_FORMS: dict[str, Callable[[StereoCamera, Path], Path]] = {
    "own": write_own,
    "Kalibr": write_kalibr,
    "Kalibr with an IMU": write_kalibr_imu,
    "OpenCV": write_opencv,
    "OpenCV XML": write_opencv_xml,
    "OpenCV in two files": write_opencv_pair,
    "ORB-SLAM2": write_orb_slam2,
    "ORB-SLAM3": write_orb_slam3,
    "ROS": write_ros,
    "EuRoC": write_euroc,
    "KITTI raw": write_kitti_raw,
    "ZED": write_zed,
    "OAK": write_oak,
}
RECTIFIED_FORMS: dict[str, Callable[[StereoCamera, Path], Path]] = {
    "own": write_own,
    "Kalibr": write_kalibr,
    "OpenCV": write_opencv,
    "ORB-SLAM2": write_orb_slam2,
    "ORB-SLAM3": write_orb_slam3,
    "ORB-SLAM, bf": write_orb_bf,
    "ROS": write_ros,
    "EuRoC": write_euroc,
    "KITTI": write_kitti,
    "OAK": write_oak,
    "4Seasons": write_four_seasons,
}
