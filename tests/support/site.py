"""The documentation site, built once for all tests that look at it."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.once import once

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="session")
def site() -> Path:
    """The folder of the built site, to be read only."""

    def build(folder: Path) -> None:
        built = subprocess.run(
            [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)],
            cwd=ROOT, capture_output=True, text=True, timeout=1200, check=False,
            env={"PATH": "/usr/bin:/bin", "NO_MKDOCS_2_WARNING": "1"},
        )  # fmt: skip
        assert built.returncode == 0, built.stdout + built.stderr

    return once("site", build)
