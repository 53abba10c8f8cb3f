"""Figures of the runner through SkyPilot's own AWS provisioner, on a simulated EC2: `make aws-figures`."""

from tests.aws.site import AwsSite
from tests.slurm.figures import main

TYPES = ("c6i.large", "m6i.large", "c6i.xlarge", "m6i.xlarge")

if __name__ == "__main__":
    main(AwsSite, TYPES)
