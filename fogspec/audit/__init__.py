"""A change told to whoever approves it, and the chain behind a manifest recomputed and attested."""
