"""The step that spends: a campaign of samples within a budget, journaled, watched and collected."""
