"""The program: `fogspec`, or `python -m fogspec`."""

import sys


def main() -> None:
    """The command line; Ctrl-C while it is still being loaded is no mistake to be shown."""
    try:
        from fogspec.cli import main as command_line
    except KeyboardInterrupt:
        sys.exit(130)
    command_line()


if __name__ == "__main__":
    main()
