"""The command line: parses, calls, prints. Exit code 2 on bad input, 1 where `check` finds an error."""


def main() -> None:
    """Entry point of the console script."""
    # Packages that add commands import parts of this one, so it imports no command itself.
    from sigmaslam.cli.commands import main as run

    run()
