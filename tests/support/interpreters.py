"""The Pythons of this machine."""

import functools
import os
import shutil
import subprocess
from pathlib import Path


@functools.cache
def python(version: str) -> str | None:
    """Return an interpreter of this version, from PATH or pyenv."""
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv"))
    for path in (shutil.which(f"python{version}"), *pyenv.glob(f"versions/{version}.*/bin/python")):
        # A shim of pyenv may be on PATH for a version that is not active.
        if path and subprocess.run([path, "-c", ""], capture_output=True, check=False).returncode == 0:
            return str(path)
    return None
