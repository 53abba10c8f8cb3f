"""`python -m fogspec` is the same program as `fogspec`."""

from fogspec.cli import main

main()
