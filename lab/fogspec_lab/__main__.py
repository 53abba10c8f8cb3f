"""The program: `fogspec-lab`, or `python -m fogspec_lab`."""

from fogspec import __main__ as program


def main() -> None:
    """Run the command line of the lab."""
    program.main("fogspec_lab.cli")


if __name__ == "__main__":
    main()
