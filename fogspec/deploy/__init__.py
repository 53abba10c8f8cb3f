"""From an approved manifest to nodes that answer, how they stand, and nothing left behind."""
