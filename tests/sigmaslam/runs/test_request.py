"""What `track` is asked for: each option reaches the request, and what does not go together is refused."""

from __future__ import annotations

import inspect
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest

from sigmaslam.cli.track import track
from sigmaslam.errors import InputError
from sigmaslam.readers import StereoSequence, open_sequence
from sigmaslam.runs.request import _REFUSED, InputOptions, LiveOptions, OutputOptions, TrackerOptions, TrackRequest

PARTS = (InputOptions, OutputOptions, TrackerOptions, LiveOptions)
RECORDING = InputOptions(Path("recording"))
RUN = Path("run")
# Of the command alone: one becomes settings, others are about a check before the run and help; and of Python alone.
OF_THE_COMMAND, OF_PYTHON = {"estimate", "strict", "help_all"}, {"findings", "on_estimate", "sinks"}


def test_options_of_the_command_are_the_fields_of_the_request():
    names = [field.name for part in PARTS for field in fields(part)]
    assert len(set(names)) == len(names)
    assert {*names} - OF_PYTHON == {*inspect.signature(track).parameters} - OF_THE_COMMAND


def test_defaults_of_the_command_are_those_of_the_request():
    defaults = {field.name: field.default for part in PARTS for field in fields(part)}
    for name, parameter in inspect.signature(track).parameters.items():
        if name not in OF_THE_COMMAND | {"out"}:
            assert parameter.default == defaults[name], name


def test_the_table_names_options_of_the_request():
    names = {"--" + field.name.replace("_", "-") for part in PARTS for field in fields(part)} | {"INPUT"}
    for option, others, _ in _REFUSED:
        assert {each.removeprefix("no ") for each in (option, *others)} <= names


@pytest.mark.parametrize(
    ("part", "words"),
    [
        ({}, r"give either INPUT, a recording, or --camera, live cameras$"),
        ({"source": Path("a"), "camera": "0,1"}, "not both"),
        ({"source": Path("a"), "seconds": 3.0}, "--seconds goes with --camera; a recording is tracked to its end"),
        ({"camera": "0,1"}, "--camera needs --calibration"),
        ({"camera": "0,1", "topic_left": "/left"}, "--camera needs --calibration"),
    ],
)
def test_an_input_that_cannot_be_is_refused(part: dict[str, Any], words: str):
    with pytest.raises(InputError, match=words):
        InputOptions(**part)


@pytest.mark.parametrize(
    "part", [{"format": "kitti"}, {"topic_right": "/right"}, {"start": 3}, {"frames": 1}, {"every": 2}, {"scale": 0.5}]
)
def test_live_cameras_have_no_parts_and_no_format(part: dict[str, Any]):
    with pytest.raises(InputError, match=r"^--\w+.*, .* and --.* go with INPUT, not with --camera$"):
        InputOptions(camera="0,1", calibration=Path("c.yaml"), **part)


@pytest.mark.parametrize(
    ("outputs", "tracker", "live", "words"),
    [
        ({"overwrite": True, "resume": True}, {}, {}, "give one of them"),
        ({"resume": True}, {}, {"video": Path("a.mp4")}, "go with --video, --viewer and --dense, of whole runs"),
        ({"resume": True}, {"map": Path("map.npz")}, {}, "--resume does not go with --map: leave one"),
        ({"resume": True, "tracks": True}, {}, {}, "--resume does not go with --tracks"),
        ({"resume": True}, {"realtime": True}, {}, "--resume does not go with --realtime"),
        ({"tracks": True}, {"track_object": "1,1,9,9"}, {}, "leave them out with --track-object"),
    ],
)
def test_options_of_different_parts_are_refused(
    outputs: dict[str, Any], tracker: dict[str, Any], live: dict[str, Any], words: str
):
    with pytest.raises(InputError, match=words):
        TrackRequest(RECORDING, OutputOptions(RUN, **outputs), TrackerOptions(**tracker), LiveOptions(**live))


def test_an_open_sequence_is_taken_as_it_is_and_its_cameras_cannot_resume(demo_sequence: Path):
    sequence = open_sequence(demo_sequence)
    assert InputOptions(sequence).open() is sequence
    assert InputOptions(sequence, start=2, frames=3).open().length == 3
    sequence.format = "camera"  # as `open_cameras` has it
    assert isinstance(InputOptions(sequence).source, StereoSequence)
    with pytest.raises(InputError, match="--resume does not go with --camera"):
        TrackRequest(InputOptions(sequence), OutputOptions(RUN, resume=True))
