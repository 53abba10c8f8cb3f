"""Git repositories as tests make them."""

import subprocess
from pathlib import Path


def git(*words: str, folder: Path) -> str:
    """Return what a git command prints; raises CalledProcessError."""
    return subprocess.run(["git", *words], cwd=folder, check=True, capture_output=True, text=True).stdout.strip()
