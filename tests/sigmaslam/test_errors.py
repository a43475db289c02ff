"""Errors of libraries that say that memory is out are told from others."""

import pytest

from sigmaslam.errors import is_out_of_memory


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (MemoryError(), True),
        (RuntimeError("can't start new thread"), True),
        (RuntimeError("[ONNXRuntimeError] : 6 : Failed to allocate memory for requested buffer of size 9"), True),
        (ValueError("(-4:Insufficient memory) Failed to allocate 9 bytes in function 'OutOfMemoryError'"), True),
        (ValueError("memory"), False),
        (KeyboardInterrupt("bad_alloc"), False),
    ],
)
def test_errors_of_memory_are_told(error: BaseException, expected: bool):
    assert is_out_of_memory(error) == expected
