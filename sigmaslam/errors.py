"""Errors that a user can mend: each message says what is wrong, where, and what to do."""

import errno


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


def describe_shortage(error: BaseException | None) -> str | None:
    """What the system lacks, in a sentence, where an error of Python or of a library, or its cause, says so."""
    while error is not None:
        if _is_out_of_memory(error):
            return (
                "there is not enough memory: end other programs, raise the limit (`ulimit -v`), or use smaller images; "
                "what was tracked until then is in the run folder"
            )
        if isinstance(error, OSError) and error.errno in (errno.EMFILE, errno.ENFILE):
            return "too many files are open: raise the limit (`ulimit -n 1024`), or end other programs"
        error = error.__cause__ or error.__context__
    return None


def _is_out_of_memory(error: BaseException) -> bool:
    if isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno == errno.ENOMEM):
        return True
    said = (
        "bad_alloc",
        "Insufficient memory",
        "Failed to allocate memory",
        "can't start new thread",
        # Libraries that are loaded.
        "failed to map segment",
        "Cannot allocate memory",
    )
    return isinstance(error, Exception) and any(words in str(error) for words in said)
