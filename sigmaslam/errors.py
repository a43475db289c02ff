"""Errors that a user can mend: each message says what is wrong, where, and what to do."""


class SigmaSlamError(Exception):
    """Base of every error that SigmaSLAM raises on purpose; the command line turns it into exit code 2."""


class InputError(SigmaSlamError):
    """A file, folder or option that was given cannot be used."""


class CalibrationError(InputError):
    """A calibration misses a key, has a wrong size, or does not fit the images."""


class OutputError(SigmaSlamError):
    """A result cannot be written."""


class FrameError(InputError):
    """One image cannot be read; the sequence around it can still be used."""


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error of Python, OpenCV or ONNX Runtime says that there is not enough memory."""
    if isinstance(error, MemoryError):
        return True
    text = str(error)
    said = ("bad_alloc", "Insufficient memory", "Failed to allocate memory", "can't start new thread")
    return isinstance(error, Exception) and any(words in text for words in said)
