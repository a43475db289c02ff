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
