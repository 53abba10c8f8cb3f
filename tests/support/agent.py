"""The agent as machines have it: the zip application that compile writes."""

import atexit
import shutil
import tempfile
from pathlib import Path

from fogspec.compile.agent_archive import agent_archive


def _written() -> Path:
    folder = Path(tempfile.mkdtemp(prefix="fogspec-agent-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    (folder / "agent.pyz").write_bytes(agent_archive())
    return folder / "agent.pyz"


AGENT = _written()
