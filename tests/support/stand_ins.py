"""What the commands on the pages read: a small recording under each of the names that they use."""

from pathlib import Path

import cv2
import numpy as np
import yaml
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore

from sigmaslam.geometry.camera import StereoCamera
from sigmaslam.geometry.se3 import se3_inverse
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.readers import open_sequence
from sigmaslam.readers.trajectory_files import write_tum
from tests.support.calibration_forms import write_kalibr, write_ros
from tests.support.calibration_yaml import write_calibration
from tests.support.simulated_board import CHESSBOARD, board_poses, draw_board, stereo_rig
from tests.support.videos import write_video
from tests.support.wheeled_world import World, drive, write_csv_folder

FRAMES, SECONDS = 8, 0.5
# The demo, enlarged until the box on the pages lies in its images.
ZOOM = 2.25
# Axes of a body, x ahead and z up, in a camera.
AHEAD = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


def write_stand_ins(demo: Path, folder: Path) -> None:
    """Writes the recording in the forms that `sigmaslam track` reads, truth, masks, readings, settings, two images.

    And a board before two cameras, calibrations in other forms, photographs, a film and a robot of one's own.
    """
    sequence = open_sequence(demo, "kitti")
    pairs = [(frame.left, frame.right) for frame, _ in zip(sequence.frames(), range(FRAMES), strict=False)]
    pairs = [tuple(cv2.resize(eye, None, fx=ZOOM, fy=ZOOM, interpolation=cv2.INTER_CUBIC) for eye in p) for p in pairs]
    poses = np.loadtxt(demo / "poses.txt")[:FRAMES]
    times = SECONDS * np.arange(FRAMES)
    projections = [_enlarge(line) for line in (demo / "calib.txt").read_text().splitlines() if line.startswith("P")]
    calibration = "".join(f"P{number}: {line}\n" for number, line in enumerate(projections))
    for name in ("KITTI_OR_EUROC_FOLDER", "FOLDER", "INPUT", "RECORDING"):
        _write_images(folder / name, ("image_0", "image_1"), pairs)
        (folder / name / "calib.txt").write_text(calibration)
        np.savetxt(folder / name / "times.txt", times)
    _write_images(folder / "my_folder", ("left", "right"), pairs)
    np.savetxt(folder / "my_folder" / "times.txt", times)
    np.savetxt(folder / "times.txt", times)
    np.savetxt(folder / "poses.txt", poses)
    matrices = np.tile(np.eye(4), (FRAMES, 1, 1))
    matrices[:, :3] = poses.reshape(-1, 3, 4)
    write_tum(folder / "gt.tum", Trajectory(times, AHEAD.T @ matrices @ AHEAD))
    camera = open_sequence(folder / "FOLDER", "kitti").camera
    write_calibration(camera, folder / "stereo.yaml")
    write_video(folder / "side_by_side.mp4", [np.hstack(pair) for pair in pairs], 1 / SECONDS)
    _write_bags(folder, pairs, times, camera)
    readings = np.column_stack([times, poses[:, [3, 7, 11]], np.full(FRAMES, 0.01)])
    for name in ("gps.csv", "tracker.csv"):
        np.savetxt(folder / name, readings, delimiter=",", header="timestamp,x,y,z,sigma_position", comments="")
    speeds = np.append(np.linalg.norm(np.diff(poses[:, [3, 7, 11]], axis=0), axis=1), 0.0) / SECONDS
    wheels = np.column_stack([times, speeds, np.zeros(FRAMES)])
    np.savetxt(folder / "wheels.csv", wheels, delimiter=",", header="timestamp,speed,yaw_rate", comments="")
    (folder / "wheels.yaml").write_text(yaml.safe_dump({"T_cam_base": AHEAD.tolist()}))
    (folder / "settings.yaml").write_text(yaml.safe_dump({"keyframe_ratio": 0.75}))
    mask = np.zeros_like(pairs[0][0])
    mask[200:450, 400:700] = 255
    cv2.imwrite(str(folder / "mask.png"), mask)
    bumper = np.full_like(mask, 255)
    bumper[-100:] = 0
    cv2.imwrite(str(folder / "bumper.png"), bumper)
    _write_images(folder, ("masks",), [(bumper,)] * FRAMES)
    write_kalibr(camera, folder).rename(folder / "camchain.yaml")
    write_ros(camera, folder)
    _write_board(folder / "IMAGES")
    write_csv_folder(folder / "my_robot", drive(World()))
    _write_points(folder)
    write_video(folder / "film.mp4", [left for left, _ in pairs], 1 / SECONDS)
    _write_images(folder / "folder_of_frames", (".",), pairs)
    cv2.imwrite(str(folder / "photo.png"), pairs[0][0])
    cv2.imwrite(str(folder / "one.jpg"), pairs[0][0])
    cv2.imwrite(str(folder / "two.png"), pairs[-1][0])


def _write_points(folder: Path) -> None:
    """Pixels in both images, and control points in two frames that are a metre apart."""
    (folder / "pixels.csv").write_text("id,u0,v0,u1,v1\na,300,200,270,200\nb,500,240,480,240.5\n")
    places = {"a": (0, 0, 1), "b": (1, 0, 2), "c": (0, 1, 2), "d": (1, 1, 3)}
    for name, shift in (("model.csv", 0), ("survey.csv", 1)):
        rows = [f"{key},{x + shift},{y},{z}" for key, (x, y, z) in places.items()]
        (folder / name).write_text("\n".join(["id,x,y,z", *rows]) + "\n")


def _write_board(folder: Path) -> None:
    """A chessboard in both eyes."""
    folder.mkdir()
    rig = stereo_rig()
    for k, pose in enumerate(board_poses(CHESSBOARD, 12, seed=11, depth=0.5)):
        cv2.imwrite(str(folder / f"left{k:02d}.png"), draw_board(CHESSBOARD, rig.eyes[0], pose))
        in_right = se3_inverse(rig.T_left_right) @ pose
        cv2.imwrite(str(folder / f"right{k:02d}.png"), draw_board(CHESSBOARD, rig.eyes[1], in_right))


def _enlarge(line: str) -> str:
    """A line of calib.txt for images that are larger by ZOOM."""
    projection = np.array(line.split(":")[1].split(), float).reshape(3, 4)
    # Pixel centres have whole coordinates.
    scale = np.array([[ZOOM, 0, (ZOOM - 1) / 2], [0, ZOOM, (ZOOM - 1) / 2], [0, 0, 1]])
    return " ".join(map(repr, (scale @ projection).ravel().tolist()))


def _write_images(folder: Path, names: tuple[str, ...], pairs: list) -> None:
    for eye, name in enumerate(names):
        (folder / name).mkdir(parents=True, exist_ok=True)
        for number, pair in enumerate(pairs):
            cv2.imwrite(str(folder / name / f"{number:06d}.png"), pair[eye])


def _write_bags(folder: Path, pairs: list, times: np.ndarray, camera: StereoCamera) -> None:
    """drive.bag of ROS 1 and drive.mcap of ROS 2."""
    ros1, ros2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.LATEST)
    _fill(rosbag1.Writer(folder / "drive.bag"), ros1, ros1.serialize_ros1, pairs, times, camera)
    made = folder / "recorded"
    writer = rosbag2.Writer(made, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP)
    _fill(writer, ros2, ros2.serialize_cdr, pairs, times, camera)
    next(made.glob("*.mcap")).rename(folder / "drive.mcap")


def _fill(writer, store, serialize, pairs: list, times: np.ndarray, camera: StereoCamera) -> None:
    """Images and calibrations of both eyes under /stereo/left and /stereo/right."""
    make = {name.removeprefix("sensor_msgs/msg/"): kind for name, kind in store.types.items()}
    is_ros1 = serialize == store.serialize_ros1
    lists = ("D", "K", "R", "P") if is_ros1 else ("d", "k", "r", "p")
    height, width = pairs[0][0].shape
    with writer:
        for eye, name in enumerate(("left", "right")):
            K = (camera.left, camera.right)[eye].matrix
            P = np.hstack([K, [[-K[0, 0] * camera.baseline * eye], [0], [0]]])
            arrays = dict(zip(lists, (np.zeros(5), K.ravel(), np.eye(3).ravel(), P.ravel()), strict=True))
            channels = {
                topic: writer.add_connection(f"/stereo/{name}/{topic}", f"sensor_msgs/msg/{kind}", typestore=store)
                for topic, kind in (("image_raw", "Image"), ("camera_info", "CameraInfo"))
            }
            for pair, seconds in zip(pairs, times, strict=True):
                stamp = 1_700_000_000 * 10**9 + round(seconds * 1e9)
                fields = {
                    "stamp": make["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9),
                    "frame_id": name,
                }
                header = make["std_msgs/msg/Header"](**fields, **({"seq": 0} if is_ros1 else {}))
                picture = make["Image"](
                    header=header,
                    height=height,
                    width=width,
                    encoding="mono8",
                    is_bigendian=0,
                    step=width,
                    data=pair[eye].ravel(),
                )
                roi = make["RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
                described = make["CameraInfo"](
                    header=header,
                    height=height,
                    width=width,
                    distortion_model="plumb_bob",
                    binning_x=0,
                    binning_y=0,
                    roi=roi,
                    **arrays,
                )
                for topic, message in (("image_raw", picture), ("camera_info", described)):
                    content = serialize(message, message.__msgtype__)
                    writer.write(channels[topic], stamp, content)
