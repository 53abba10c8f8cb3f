"""An AWS account on one machine: moto's EC2, instances that answer SSH, and a SkyPilot, as long as a command runs."""
