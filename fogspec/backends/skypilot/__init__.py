"""SkyPilot, kept in a process of its own: importing it takes seconds, its calls block, and it prints."""
