"""Report changes to reviewers, and recompute and attest the chain behind a manifest."""
