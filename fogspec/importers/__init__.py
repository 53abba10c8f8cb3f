"""What a spec is proposed from: launch files, robot graphs, answers. Only `init` uses it."""
