"""A Slurm cluster on one machine with a SkyPilot engine of its own: `make slurm-up`, `make slurm-down`."""
