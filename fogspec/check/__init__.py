"""Decide whether an application is what its inputs say."""
