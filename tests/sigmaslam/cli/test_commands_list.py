"""The list of commands, and what is loaded for it."""

from __future__ import annotations

import subprocess
import sys

import pytest
from typer.testing import CliRunner

from sigmaslam.cli.commands import build_app


@pytest.mark.parametrize("words", [["--help"], ["no-such-command"]])
def test_names_alone_answer_as_all_commands_do(words: list[str]):
    whole, names = (CliRunner().invoke(build_app(chosen), words) for chosen in (None, ""))
    assert (names.output, names.exit_code) == (whole.output, whole.exit_code)
    assert "track" in whole.output or whole.exit_code == 2


@pytest.mark.parametrize("words", [["match"], ["calibration", "show"]])
def test_a_chosen_command_is_whole(words: list[str]):
    whole, alone = (CliRunner().invoke(build_app(chosen), [*words, "--help"]) for chosen in (None, words[0]))
    assert alone.output == whole.output
    assert "--help" in alone.output


def test_the_list_loads_no_array():
    code = "import sys; from sigmaslam.cli.commands import build_app; build_app(''); print('numpy' in sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "False"
