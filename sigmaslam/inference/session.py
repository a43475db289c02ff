"""ONNX Runtime sessions: their options, and where they compute."""

import onnxruntime

from sigmaslam.errors import InputError

PROVIDERS = {"cpu": "CPUExecutionProvider", "cuda": "CUDAExecutionProvider", "openvino": "OpenVINOExecutionProvider"}
"""Execution providers of ONNX Runtime, by the names of `--provider`."""
RUNTIME_VERSION: str = onnxruntime.__version__
_PACKAGES = {"cuda": "onnxruntime-gpu", "openvino": "onnxruntime-openvino"}
# Without it OpenVINO may compute in bfloat16 where the processor has it.
_OPTIONS = {"openvino": {"device_type": "CPU", "precision": "ACCURACY"}}
# This fusion moves a constant factor into a float32 attribute of the product, even if the product is float64. The
# covariances of the filter would be wrong in the eighth digit.
_DISABLED = ["MatMulScaleFusion"]


def installed_providers() -> list[str]:
    """Names of `PROVIDERS` that the installed ONNX Runtime has."""
    available = onnxruntime.get_available_providers()
    return [name for name, provider in PROVIDERS.items() if provider in available]


def check_provider(provider: str, backend: str = "onnx") -> None:
    """Whether networks can run there; starts nothing.

    Args:
        provider: one of `PROVIDERS`.
        backend: that runs them.
    Raises:
        InputError: there is no such provider, it is not installed, or the back-end knows none.
    """
    if provider not in PROVIDERS:
        raise InputError(f"provider is {provider!r}: give one of {', '.join(PROVIDERS)}")
    installed = installed_providers()
    if provider not in installed:
        raise InputError(
            f"the provider {provider} is not installed, but {', '.join(installed)}: put the package "
            f"{_PACKAGES.get(provider, 'onnxruntime')} in place of the onnxruntime that is there, or choose among these"
        )
    if backend == "torch" and provider != "cpu":
        raise InputError(f"the provider {provider} is of ONNX Runtime: leave out the back-end torch")


def open_session(content: bytes, threads: int, provider: str = "cpu") -> onnxruntime.InferenceSession:
    """A session for a graph.

    Args:
        content: of the .onnx file.
        threads: within one operator, on the CPU.
        provider: one of `PROVIDERS`; operators that it does not have run on the CPU.
    Raises:
        InputError: the provider is not installed, or does not start.
    """
    check_provider(provider)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    # Several sessions take turns. A session that spins while it waits halves the speed of the others.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    # What a run of the largest network needs is given back: an arena would keep it beside what else a frame needs.
    options.enable_cpu_mem_arena = False
    options.log_severity_level = 3
    providers = [(PROVIDERS[provider], _OPTIONS.get(provider, {}))]
    if provider != "cpu":
        providers.append((PROVIDERS["cpu"], {}))
    session = onnxruntime.InferenceSession(content, options, providers=providers, disabled_optimizers=_DISABLED)
    # A provider whose libraries are missing is left out with no more than a line on the standard error.
    if PROVIDERS[provider] not in session.get_providers():
        raise InputError(
            f"the provider {provider} is installed but does not start: its driver or libraries are missing"
        )
    return session
