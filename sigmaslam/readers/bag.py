"""ROS 1 and ROS 2 bags: two image topics, calibrated by their CameraInfo."""

import logging
import re
from collections.abc import Collection, Generator, Iterator
from contextlib import closing, contextmanager
from itertools import islice
from pathlib import Path, PurePosixPath
from typing import Any

from sigmaslam.bounded_files import shorten
from sigmaslam.calibration_files.calibration import read_calibration
from sigmaslam.errors import CalibrationError, FrameError, InputError, SigmaSlamError
from sigmaslam.geometry.camera import StereoCamera
from sigmaslam.readers.images import PairSource, RawPair, SkippedFrame
from sigmaslam.readers.kitti import common_size
from sigmaslam.readers.pairing import STAMP_TOLERANCE_NS, Stamped, pair_streams
from sigmaslam.readers.ros_messages import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    image_array,
    stamp_ns,
    stereo_from_messages,
)
from sigmaslam.readers.stereo_sequence import StereoSequence

logger = logging.getLogger(__name__)

Topics = tuple[str | None, str | None]

LOOKED_FOR = "a ROS bag *.bag, *.mcap or *.db3, or a folder with metadata.yaml"
_SUFFIXES = (".bag", ".mcap", ".db3")
# These words in a topic's name identify the eye.
_EYES = tuple(
    re.compile(rf"(?<![a-z])({words})(?![a-z0-9])")
    for words in (r"left|cam0|infra(?:red_)?1", r"right|cam1|infra(?:red_)?2")
)


def is_bag(path: Path) -> bool:
    """Whether this is a bag by its name, or a folder that ROS 2 recorded."""
    return (path.is_file() and path.suffix in _SUFFIXES) or (path / "metadata.yaml").is_file()


def open_bag(path: Path, calibration: Path | None = None, topics: Topics = (None, None)) -> StereoSequence:
    """Open a bag: images paired by the time stamps of their headers, to 5 ms.

    Args:
        path: *.bag (ROS 1), *.mcap, *.db3 or a folder with metadata.yaml (ROS 2).
        calibration: instead of the CameraInfo beside the images.
        topics: left and right image topic; None finds the only one whose name has the eye in it.

    Raises:
        InputError: rosbags is not installed, the bag cannot be read, or the topics are not clear (lists them).
        CalibrationError: no or no stereo CameraInfo, or it does not fit.
    """
    if not is_bag(path):
        raise InputError(f"{path}: no ROS bag; looked for {LOOKED_FOR}")
    with open_reader(path) as bag:
        chosen = _choose_topics(bag, topics)
        camera = _read_infos(bag, chosen) if calibration is None else None
    pairs = BagPairs(path, chosen)
    if camera is None:
        assert calibration is not None
        camera = read_calibration(calibration, common_size(pairs.first_pair))
    return StereoSequence(pairs, camera, path, "bag")


class BagReader:
    """An open bag.

    Attributes:
        topics: (message type, number of messages) by topic; topics without messages are left out.
    """

    def __init__(self, path: Path, reader: Any, deserialize: Any) -> None:
        self.path = path
        self.topics: dict[str, tuple[str, int]] = {}
        for connection in reader.connections:
            if connection.msgcount:
                count = self.topics.get(connection.topic, ("", 0))[1] + connection.msgcount
                self.topics[connection.topic] = (connection.msgtype, count)
        self._reader = reader
        self._deserialize = deserialize

    def messages(self, topics: Collection[str]) -> Generator[tuple[str, int, Any], None, None]:
        """Topic, time of recording in nanoseconds and message, in that order of time, one at a time from disk."""
        connections = [connection for connection in self._reader.connections if connection.topic in topics]
        for connection, recorded, content in self._reader.messages(connections):
            yield connection.topic, recorded, self._deserialize(content, connection.msgtype)

    def list_topics(self, *types: str) -> str:
        """The topics of these types, for messages to the user."""
        lines = [f"\n  {topic}: {kind}, {count}" for topic, (kind, count) in self.topics.items() if kind in types]
        return "".join(lines) or " none"


@contextmanager
def open_reader(path: Path) -> Iterator[BagReader]:
    """Open a bag; every error of rosbags becomes an InputError.

    Raises:
        InputError: rosbags is not installed, or the bag cannot be read.
    """
    try:
        from rosbags import rosbag1, rosbag2
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise InputError(
            f"{path}: a ROS bag, and {error.name} is not installed: pip install 'sigmaslam[bag]'"
        ) from error
    try:
        # All versions of ROS 2 have the same image messages; other types are not read.
        if path.suffix == ".bag":
            reader: Any = rosbag1.Reader(path)
            deserialize: Any = get_typestore(Stores.ROS1_NOETIC).deserialize_ros1
        else:
            reader = rosbag2.Reader(path)
            deserialize = get_typestore(Stores.LATEST).deserialize_cdr
        with reader:
            yield BagReader(path, reader, deserialize)
    except SigmaSlamError:
        raise
    except Exception as error:
        raise InputError(
            f"{path}: cannot be read as a ROS bag ({shorten(str(error), 300) or type(error).__name__}); where a "
            "recording was cut off, `rosbag reindex` or `ros2 bag reindex` may mend it"
        ) from error


def _choose_topics(bag: BagReader, topics: Topics) -> tuple[str, str]:
    images = [topic for topic, (kind, _) in bag.topics.items() if kind in (IMAGE, COMPRESSED_IMAGE)]
    chosen: list[str] = []
    for eye, name, words, others in zip(("left", "right"), topics, _EYES, _EYES[::-1], strict=True):
        if name is not None:
            matching = [topic for topic in images if topic.strip("/") == name.strip("/")]
            problem = f"no image topic {name}"
        else:
            matching = [topic for topic in images if words.search(topic.lower()) and not others.search(topic.lower())]
            problem = f"{len(matching) or 'no'} image topics are {eye} by their name"
        if len(matching) != 1:
            raise InputError(
                f"{bag.path}: {problem}; choose with --topic-left and --topic-right; image topics and their number "
                f"of messages:{bag.list_topics(IMAGE, COMPRESSED_IMAGE)}"
            )
        chosen += matching
    if chosen[0] == chosen[1]:
        raise InputError(f"{bag.path}: {chosen[0]} is given for both eyes")
    return chosen[0], chosen[1]


def _read_infos(bag: BagReader, image_topics: tuple[str, str]) -> StereoCamera:
    infos = [_info_topic(bag, topic) for topic in image_topics]
    if infos[0] is None or infos[1] is None or infos[0] == infos[1]:
        missing = image_topics[0] if infos[0] is None else image_topics[1]
        raise CalibrationError(
            f"{bag.path}: no CameraInfo that belongs to {missing} (looked for camera_info beside and above it); "
            f"give --calibration; there are:{bag.list_topics(CAMERA_INFO)}"
        )
    first: dict[str, Any] = {}
    with closing(bag.messages([infos[0], infos[1]])) as messages:
        for topic, _, message in messages:
            first.setdefault(topic, message)
            if len(first) == 2:
                break
    return stereo_from_messages(first[infos[0]], first[infos[1]], image_topics, (infos[0], infos[1]))


def _info_topic(bag: BagReader, image_topic: str) -> str | None:
    for folder in PurePosixPath(image_topic).parents:
        topic = str(folder / "camera_info")
        if bag.topics.get(topic, ("", 0))[0] == CAMERA_INFO:
            return topic
    return None


class BagPairs(PairSource):
    """Images of two topics, as a source of pairs that is read from disk as it goes; as many as the scarcer eye has."""

    def __init__(self, path: Path, topics: tuple[str, str]) -> None:
        self.source = self._path = path
        self._topics = topics
        with open_reader(path) as bag, closing(bag.messages(topics)) as messages:
            self.length = min(bag.topics[topic][1] for topic in topics)
            # Drivers without a clock leave the stamps of the headers at zero.
            self._by_recording = all(stamp_ns(message) == 0 for _, _, message in islice(messages, 4))
        if self._by_recording:
            logger.warning("%s: images have no time stamps; the times of recording are used", path)

    def __iter__(self) -> Iterator[RawPair | SkippedFrame]:
        index, alone, alone_since = 0, 0, 0
        with open_reader(self._path) as bag, closing(bag.messages(self._topics)) as messages:
            for left, right in pair_streams(self._stamped(messages)):
                if left is None or right is None:
                    one = left or right
                    alone_since = one.stamp if one is not None and not alone else alone_since
                    alone += 1
                    continue
                if alone and not index:
                    logger.warning("%s: %s at the beginning are left out", self._path, _without_partner(alone))
                elif alone:
                    yield SkippedFrame(index, _seconds(alone_since), _without_partner(alone))
                    index += 1
                alone = 0
                yield self._pair(index, left, right)
                index += 1
        if not index:
            raise InputError(
                f"{self._path}: {_without_partner(alone)} in {self._topics[0]} and {self._topics[1]}, and no pair: "
                "do they belong together, and are the cameras synchronised?"
            )
        if alone:
            yield SkippedFrame(index, _seconds(alone_since), _without_partner(alone))

    def _stamped(self, messages: Iterator[tuple[str, int, Any]]) -> Iterator[tuple[int, Stamped[Any]]]:
        for topic, recorded, message in messages:
            yield self._topics.index(topic), Stamped(recorded if self._by_recording else stamp_ns(message), message)

    def _pair(self, index: int, left: Stamped[Any], right: Stamped[Any]) -> RawPair | SkippedFrame:
        # A float does not hold 19 digits; dividing Python integers rounds only once.
        names = [
            f"{topic} at {_seconds(image.stamp):.6f} s"
            for topic, image in zip(self._topics, (left, right), strict=True)
        ]
        try:
            images = [image_array(image.item, name) for image, name in zip((left, right), names, strict=True)]
        except FrameError as error:
            return SkippedFrame(index, _seconds(left.stamp), str(error))
        return RawPair(index, _seconds(left.stamp), images[0], images[1], names[0], names[1])


def _seconds(stamp: int) -> float:
    return stamp / 1_000_000_000


def _without_partner(count: int) -> str:
    return f"{count} images without a partner within {STAMP_TOLERANCE_NS / 1e6:g} ms"
