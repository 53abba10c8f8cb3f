"""A first spec from a robot that runs: which requests and responses its nodes exchange, and what they weigh."""
