"""The command line: parses, calls, prints. Exit code 2 on bad input, 1 where `check` finds an error."""

import sys

from sigmaslam.errors import describe_shortage


def main() -> None:
    """Entry point of the console script."""
    try:
        # Packages that add commands import parts of this one, so it imports no command itself. Libraries that are
        # loaded take memory and files, too.
        from sigmaslam.cli.commands import main as run

        run()
    except Exception as error:
        shortage = describe_shortage(error)
        if shortage is None:
            raise
        sys.stderr.write(f"error: {shortage}\n")
        sys.exit(2)
