"""Measurements from elsewhere: suites, sweeps, machine libraries, and replays of them."""
