"""Errors that say that the system lacks memory or files are told from others."""

import errno
import subprocess
import sys

import pytest

from sigmaslam.errors import describe_shortage


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (MemoryError(), True),
        (RuntimeError("can't start new thread"), True),
        (RuntimeError("[ONNXRuntimeError] : 6 : Failed to allocate memory for requested buffer of size 9"), True),
        (ValueError("(-4:Insufficient memory) Failed to allocate 9 bytes in function 'OutOfMemoryError'"), True),
        (ImportError("libopenblas.so: failed to map segment from shared object"), True),
        (OSError(errno.ENOMEM, "Cannot allocate memory"), True),
        (ValueError("memory"), False),
        (OSError(errno.ENOENT, "No such file"), False),
        (KeyboardInterrupt("bad_alloc"), False),
    ],
)
def test_errors_of_memory_are_told(error: BaseException, expected: bool):
    said = describe_shortage(error)
    assert (said is not None and "not enough memory" in said) == expected


def test_what_caused_an_error_counts():
    error = ImportError("read the instructions")
    error.__cause__ = OSError(errno.EMFILE, "Too many open files")
    assert "too many files are open" in str(describe_shortage(error))


@pytest.mark.skipif(sys.platform != "linux", reason="no limit of address space")
def test_too_little_memory_to_load_libraries_is_a_sentence():
    command = f"ulimit -v 250000 && exec {sys.executable} -m sigmaslam track none --out none"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("error: there is not enough memory")
    assert len(done.stderr.splitlines()) == 1
