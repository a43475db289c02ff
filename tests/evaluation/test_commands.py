"""Benchmarks of the table, as commands: what their functions are called with, and what their pages name."""

from __future__ import annotations

from importlib import import_module
from inspect import Parameter, signature
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import CliRunner

from sigmaslam.cli.commands import app
from sigmaslam.errors import InputError
from sigmaslam_benchmarks import commands
from sigmaslam_benchmarks.commands import BENCHMARKS

OFFERED = {"path", "figure", "command", "note", "workers"}


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """What `write_features` was called with."""
    taken: list[dict[str, Any]] = []

    def write_features(path, figure, data, weights, peers, workers, command, sets="all of them", rounds=1):
        taken.append(locals())
        return "the page"

    monkeypatch.setattr(commands, "import_module", lambda name: SimpleNamespace(write_features=write_features))
    monkeypatch.setattr(commands, "need_extra", lambda name: None)
    monkeypatch.delenv("SIGMASLAM_DATA", raising=False)
    return taken


def run_features(*words: object) -> None:
    result = CliRunner().invoke(app, ["benchmark", "features", *map(str, words)], catch_exceptions=False)
    assert (result.exit_code, result.stdout) == (0, "the page\n")


def test_what_is_given_reaches_the_function_and_the_page(calls: list[dict[str, Any]], tmp_path: Path):
    page = tmp_path / "page.md"
    words = f"--out {page} --weights a.onnx --weights b.onnx --sets boat,wall --rounds 2"
    run_features(*words.split(), "--data", tmp_path)
    (call,) = calls
    assert (call["path"], call["figure"], call["data"]) == (page, tmp_path / "page.png", tmp_path)
    assert (call["weights"], call["sets"], call["rounds"]) == ([Path("a.onnx"), Path("b.onnx")], ["boat", "wall"], 2)
    assert call["command"] == f"sigmaslam benchmark features {words}"
    assert call["workers"] >= 1


def test_what_is_not_given_is_as_the_function_has_it(calls: list[dict[str, Any]], tmp_path: Path):
    run_features("--out", tmp_path / "page.md", "--data", tmp_path)
    assert (calls[0]["weights"], calls[0]["sets"], calls[0]["rounds"]) == ([], "all of them", 15)


def test_a_benchmark_of_real_data_asks_for_them(calls: list[dict[str, Any]], tmp_path: Path):
    with pytest.raises(InputError, match="give --data, or set SIGMASLAM_DATA"):
        run_features("--out", tmp_path / "page.md")
    assert not calls


@pytest.mark.long
@pytest.mark.parametrize("name", BENCHMARKS)
def test_each_function_takes_its_options_and_needs_nothing_else(name: str):
    pytest.importorskip("torch")
    module = import_module(f"sigmaslam_benchmarks.{BENCHMARKS[name].module}")
    taken = signature(getattr(module, f"write_{name}")).parameters
    options = {option.name for option in BENCHMARKS[name].options}
    assert options <= taken.keys()
    assert {each for each, parameter in taken.items() if parameter.default is Parameter.empty} <= options | OFFERED
