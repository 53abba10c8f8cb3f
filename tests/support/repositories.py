"""Git repositories as tests make them."""

import subprocess
from pathlib import Path


def git(*words: str, folder: Path) -> str:
    """Return what a git command prints, also of someone without a name; raises CalledProcessError."""
    who = ("-c", "user.name=a", "-c", "user.email=a@example.org", "-c", "commit.gpgsign=false")
    return subprocess.run(["git", *who, *words], cwd=folder, check=True, capture_output=True, text=True).stdout.strip()
