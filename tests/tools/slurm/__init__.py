"""A Slurm cluster on one machine with a SkyPilot engine of its own, for as long as a command runs: `make slurm-shell`."""
