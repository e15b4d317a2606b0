"""`golfbench` and `python -m bench`: the command line, without a traceback after an early Ctrl-C."""

import sys


def main() -> None:
    """Import the command line and run it."""
    try:
        from bench.commands.cli import main as command_line

        command_line()
    except KeyboardInterrupt:
        sys.exit(130)  # ExitCode.INTERRUPTED


if __name__ == "__main__":
    main()
