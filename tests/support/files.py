"""Writing files as fogspec writes its own, in the place of what a test wants to be there."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fogspec.base.project_files import ProjectFiles


def write_yaml(path: Path, data: Mapping[str, Any], made: str) -> None:
    """Write a generated file."""
    ProjectFiles(path.parent).write_yaml(path, data, made)
