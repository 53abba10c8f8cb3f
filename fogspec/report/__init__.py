"""Render output for people: diagnostics, summaries, the menu, explanations, and the report page of an application."""
