"""The command line: parses, calls, prints. Exit code 2 on bad input, 1 where `check` finds an error."""

from sigmaslam.cli.commands import app, main

__all__ = ["app", "main"]
