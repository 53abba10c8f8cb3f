"""What people read: diagnostics, summaries, the menu, explanations, and the page of an application."""
