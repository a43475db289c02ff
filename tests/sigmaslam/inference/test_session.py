"""Execution providers: those that are not installed, or do not start, are refused; the CPU is one like any other."""

from pathlib import Path

import numpy as np
import onnxruntime
import pytest
from typer.testing import CliRunner

from sigmaslam.cli.commands import app
from sigmaslam.errors import InputError
from sigmaslam.frontend.build import build_frontend
from sigmaslam.inference import session
from sigmaslam.inference.onnx_graph import OnnxGraph, shipped_weights
from sigmaslam.inference.session import PROVIDERS, check_provider, installed_providers

DEMO = Path(__file__).resolve().parents[3] / "synthetic" / "sigmaslam_synthetic" / "demo"
VERIFIER = shipped_weights("place_verifier.onnx")


@pytest.fixture
def only_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: ["CPUExecutionProvider"])


@pytest.mark.usefixtures("only_cpu")
@pytest.mark.parametrize(("name", "package"), [("cuda", "onnxruntime-gpu"), ("openvino", "onnxruntime-openvino")])
def test_a_provider_that_is_not_installed_is_refused_with_what_is(name: str, package: str):
    assert installed_providers() == ["cpu"]
    with pytest.raises(InputError, match=f"{name} is not installed, but cpu: put the package {package}"):
        OnnxGraph(VERIFIER, provider=name)
    with pytest.raises(InputError, match=f"{name} is not installed"):
        build_frontend("learned", 100, provider=name)


def test_a_provider_that_is_none_is_refused():
    with pytest.raises(InputError, match="provider is 'tpu': give one of cpu, cuda, openvino"):
        check_provider("tpu")


def test_torch_has_no_provider(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: list(PROVIDERS.values()))
    check_provider("cuda")
    check_provider("cpu", "torch")
    with pytest.raises(InputError, match="leave out the back-end torch"):
        check_provider("cuda", "torch")


def test_a_provider_that_does_not_start_is_no_silent_cpu(monkeypatch: pytest.MonkeyPatch):
    """ONNX Runtime leaves it out and goes on."""

    class WithoutCuda(onnxruntime.InferenceSession):
        def __init__(self, content: bytes, options: object, providers: list, **others: object) -> None:
            super().__init__(content, options, providers=["CPUExecutionProvider"], **others)

    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: list(PROVIDERS.values()))
    monkeypatch.setattr(session.onnxruntime, "InferenceSession", WithoutCuda)
    with pytest.raises(InputError, match="cuda is installed but does not start"):
        OnnxGraph(VERIFIER, provider="cuda")
    OnnxGraph(VERIFIER)


def test_operators_that_a_provider_lacks_run_on_the_cpu(monkeypatch: pytest.MonkeyPatch):
    asked = []

    class Noted(onnxruntime.InferenceSession):
        def __init__(self, content: bytes, options: object, providers: list, **others: object) -> None:
            asked.append([name for name, _ in providers])
            super().__init__(content, options, providers=["CPUExecutionProvider"], **others)

        def get_providers(self) -> list[str]:
            return asked[-1]

    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: list(PROVIDERS.values()))
    monkeypatch.setattr(session.onnxruntime, "InferenceSession", Noted)
    for name in PROVIDERS:
        OnnxGraph(VERIFIER, provider=name)
    cuda, openvino = ([PROVIDERS[name], "CPUExecutionProvider"] for name in ("cuda", "openvino"))
    assert asked == [["CPUExecutionProvider"], cuda, openvino]


@pytest.mark.usefixtures("only_cpu")
@pytest.mark.parametrize(
    "words",
    [
        ["track", str(DEMO), "--out", "OUT/run"],
        ["match", str(DEMO / "image_0" / "000000.png"), str(DEMO / "image_0" / "000001.png"), "--out", "OUT/a.npz"],
    ],
    ids=lambda words: words[0],
)
def test_commands_refuse_it_before_they_write(words: list[str], tmp_path: Path):
    words = [word.replace("OUT", str(tmp_path)) for word in words]
    result = CliRunner().invoke(app, [*words, "--provider", "cuda"])
    assert isinstance(result.exception, InputError)
    assert "the provider cuda is not installed, but cpu" in str(result.exception)
    assert not list(tmp_path.iterdir())


def test_the_installed_providers_give_what_the_cpu_gives():
    rng = np.random.default_rng(0)
    columns = rng.standard_normal((40, 12)).astype(np.float32)
    feed = {"columns": columns, "axes": np.tile(np.eye(2, dtype=np.float32), (40, 1, 1))}
    expected = OnnxGraph(VERIFIER)(feed)
    for name in installed_providers():
        for found, right in zip(OnnxGraph(VERIFIER, provider=name)(feed), expected, strict=True):
            np.testing.assert_allclose(found, right, rtol=1e-5, atol=1e-6)
