"""README and docs are run as a reader would run them."""
