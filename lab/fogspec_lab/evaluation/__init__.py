"""Replaying campaigns against full measurements: pure, arrays and small types."""
