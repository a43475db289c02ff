"""Stubs of ROS 2's Python, in one process without a network: enough for a node to be tested where there is no ROS.

Messages are made of the real definitions (rosbags has them), and refuse unknown fields and wrong types as rclpy does.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import ModuleType, SimpleNamespace
from typing import Any

from rosbags.typesys import Stores, get_typestore

PACKAGES = ("builtin_interfaces", "diagnostic_msgs", "geometry_msgs", "nav_msgs", "sensor_msgs", "std_msgs")
_BASE, _NAME, _ARRAY = 1, 2, 3
_TYPES = {"string": str, "bool": bool, "byte": bytes, "float32": float, "float64": float}
_DEFINITIONS = get_typestore(Stores.LATEST).fielddefs
_CLASSES: dict[str, type] = {}


def message_class(name: str) -> type:
    """The class of a message by its full name, such as sensor_msgs/msg/Image."""
    if name not in _CLASSES:
        constants, fields = _DEFINITIONS[name]
        members = {key: bytes([value]) if kind == "byte" else value for key, kind, value in constants}
        slots = tuple(field for field, _ in fields)
        _CLASSES[name] = type(
            name.split("/")[-1], (_Message,), {**members, "__slots__": slots, "definitions": dict(fields)}
        )
    return _CLASSES[name]


class _Message:
    __slots__ = ()
    definitions: dict[str, Any] = {}  # noqa: RUF012

    def __init__(self, **given: Any) -> None:
        for field, definition in self.definitions.items():
            setattr(self, field, given.pop(field) if field in given else _default(definition))
        if given:
            raise AttributeError(f"{type(self).__name__} has no {', '.join(given)}")

    def __setattr__(self, field: str, value: Any) -> None:
        _check(f"{type(self).__name__}.{field}", self.definitions[field], value)
        object.__setattr__(self, field, value)


def _default(definition: Any) -> Any:
    kind, detail = definition
    if kind == _NAME:
        return message_class(detail)()
    if kind == _BASE:
        return b"\0" if detail[0] == "byte" else _TYPES.get(detail[0], int)()
    return [_default(detail[0]) for _ in range(detail[1])] if kind == _ARRAY else []


def _check(where: str, definition: Any, value: Any) -> None:
    kind, detail = definition
    if kind in (_BASE, _NAME):
        expected = message_class(detail) if kind == _NAME else _TYPES.get(detail[0], int)
        assert isinstance(value, expected), f"{where} is {value!r} and must be {expected.__name__}"
        return
    assert kind != _ARRAY or len(value) == detail[1], f"{where} has {len(value)} values and must have {detail[1]}"
    for each in [] if where == "Image.data" else value:
        _check(where, detail[0], each)


class StubNode:
    """In place of rclpy's.

    Attributes:
        given: parameters that the command line would set; for all nodes.
        remapped: topics that it would remap, likewise.
        published: messages by topic; transforms under "/tf".
    """

    given: dict[str, Any] = {}  # noqa: RUF012
    remapped: dict[str, str] = {}  # noqa: RUF012

    def __init__(self, name: str) -> None:
        self._stub_name = name
        self.published: dict[str, list[Any]] = {"/tf": []}
        self.subscribers: dict[str, list[Callable[[Any], None]]] = {}
        self.timers: list[Callable[[], None]] = []
        self.logged: list[str] = []

    def get_name(self) -> str:
        return self._stub_name

    def resolve_topic_name(self, topic: str, only_expand: bool = False) -> str:
        return topic if only_expand else self.remapped.get(topic, topic)

    def get_logger(self) -> Any:
        return SimpleNamespace(fatal=self.logged.append, warning=self.logged.append)

    def get_clock(self) -> Any:
        return SimpleNamespace(now=lambda: SimpleNamespace(to_msg=message_class("builtin_interfaces/msg/Time")))

    def declare_parameter(self, name: str, default: Any) -> Any:
        value = self.given.get(name, default)
        assert type(value) is type(default), f"parameter {name} is {value!r} and must be {type(default).__name__}"
        return SimpleNamespace(value=value)

    def create_publisher(self, kind: type, topic: str, depth: int) -> Any:
        sent = self.published.setdefault(topic, [])

        def publish(message: Any) -> None:
            assert isinstance(message, kind)
            sent.append(message)

        return SimpleNamespace(publish=publish)

    def create_subscription(self, kind: type, topic: str, take: Callable[[Any], None], qos_profile: Any) -> None:
        self.subscribers.setdefault(topic, []).append(take)

    def create_timer(self, seconds: float, call: Callable[[], None]) -> None:
        self.timers.append(call)

    def destroy_node(self) -> None:
        self.subscribers.clear()

    def deliver(self, topic: str, message: Any) -> None:
        """What the executor does with a message that comes."""
        for take in self.subscribers.get(topic, []):
            take(message)


class StubSubscriber:
    """In place of message_filters'."""

    def __init__(self, node: StubNode, kind: type, topic: str, qos_profile: Any) -> None:
        self._calls: list[Callable[[Any], None]] = []
        node.create_subscription(kind, topic, lambda message: [call(message) for call in self._calls], qos_profile)

    def registerCallback(self, call: Callable[[Any], None]) -> None:  # noqa: N802
        self._calls.append(call)


class StubSynchronizer:
    """In place of ApproximateTimeSynchronizer: of two topics the pair nearest in time, if that is near enough."""

    def __init__(self, filters: list[StubSubscriber], queue_size: int, slop: float) -> None:
        self._waiting: tuple[dict[int, Any], dict[int, Any]] = ({}, {})
        self._size, self._slop = queue_size, int(slop * 1e9)
        self._calls: list[Callable[[Any, Any], None]] = []
        for eye, each in enumerate(filters):
            each.registerCallback(lambda message, eye=eye: self._add(eye, message))

    def registerCallback(self, call: Callable[[Any, Any], None]) -> None:  # noqa: N802
        self._calls.append(call)

    def _add(self, eye: int, message: Any) -> None:
        stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        own, other = self._waiting[eye], self._waiting[1 - eye]
        own[stamp] = message
        near = [each for each in other if abs(each - stamp) < self._slop]  # as the real one
        if near:
            partner = other.pop(min(near, key=lambda each: abs(each - stamp)))
            del own[stamp]
            for call in self._calls:
                call(*((partner, message) if eye else (message, partner)))
        while len(own) > self._size:
            del own[min(own)]


class TransformException(Exception):  # noqa: N818
    """As of tf2_ros."""


class ShutDownFromOutside(Exception):  # noqa: N818
    """As rclpy's, of a signal."""


class StubBuffer:
    """In place of tf2_ros'.

    Attributes:
        transforms: `Transform` by target and source; for all buffers.
    """

    transforms: dict[tuple[str, str], Any] = {}  # noqa: RUF012

    def lookup_transform(self, target: str, source: str, time: Any) -> Any:
        if (target, source) not in self.transforms:
            raise TransformException(f'"{source}" passed to lookupTransform argument source_frame does not exist.')
        stamped = message_class("geometry_msgs/msg/TransformStamped")
        return stamped(child_frame_id=source, transform=self.transforms[target, source])


@contextmanager
def stubbed_ros() -> Iterator[None]:
    """Imports of ROS find these stubs."""
    modules = {
        "rclpy": {"init": None, "ok": lambda: True, "spin_once": None, "try_shutdown": None},
        "rclpy.executors": {"ExternalShutdownException": ShutDownFromOutside},
        "rclpy.node": {"Node": StubNode},
        "rclpy.qos": {"qos_profile_sensor_data": "sensor data"},
        "rclpy.time": {"Time": _Time},
        "message_filters": {"Subscriber": StubSubscriber, "ApproximateTimeSynchronizer": StubSynchronizer},
        "tf2_ros": {
            "Buffer": StubBuffer,
            "TransformListener": lambda buffer, node: None,
            "TransformBroadcaster": lambda node: SimpleNamespace(sendTransform=node.published["/tf"].extend),
            "TransformException": TransformException,
        },
    }
    for package in PACKAGES:
        names = [name for name in _DEFINITIONS if name.startswith(f"{package}/msg/")]
        modules[package] = {}
        modules[f"{package}.msg"] = {name.split("/")[-1]: message_class(name) for name in names}
    made = {name: ModuleType(name) for name in modules}
    for name, members in modules.items():
        vars(made[name]).update(members)
        parent, _, child = name.rpartition(".")
        if parent:
            setattr(made[parent], child, made[name])
    sys.modules.update(made)
    try:
        yield
    finally:
        for name in made:
            del sys.modules[name]


class _Time:
    """In place of rclpy.time.Time."""

    @classmethod
    def from_msg(cls, stamp: Any) -> _Time:
        return cls()
