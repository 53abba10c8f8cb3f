"""The program: `fogspec`, or `python -m fogspec`."""

import sys


def main() -> None:
    """Run the command line; Ctrl-C while it is being loaded ends without a traceback."""
    try:
        from fogspec.base.child import leave_working_folder

        leave_working_folder()
        from fogspec.cli import main as command_line
    except KeyboardInterrupt:
        sys.exit(130)
    command_line()


if __name__ == "__main__":
    main()
