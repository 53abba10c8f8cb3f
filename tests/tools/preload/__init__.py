"""The timing library around a node that has no middleware: what it writes, and what it costs."""

import json
import os
import subprocess
from pathlib import Path
from typing import Any

from fogspec.agent.preload import compiled_library

HERE = Path(__file__).parent
ASKED = {"FOGSPEC_PRELOAD_SERVICE": "/plan"}


def build(folder: Path) -> Path:
    """Compile node and stand-in librcl; returns the program."""
    flags = ["-O2", "-Wall", "-Wextra", "-Werror"]
    subprocess.run(
        [
            "cc",
            *flags,
            "-shared",
            "-fPIC",
            "-Wl,-Bsymbolic-functions",
            str(HERE / "rcl.c"),
            "-o",
            str(folder / "librcl.so"),
        ],
        check=True,
    )
    words = [str(HERE / "node.c"), "-o", str(folder / "node"), f"-L{folder}", "-lrcl", f"-Wl,-rpath,{folder}"]
    subprocess.run(["cc", *flags, *words], check=True)
    return folder / "node"


def play(node: Path, commands: str, asked: dict[str, str] | None = None) -> tuple[list[dict[str, Any]], str]:
    """Have the node do this with the library in its process; records and other names, and what the node said."""
    records, said = played(node, commands, asked)
    return [one for one in records if "none is answered" not in one.get("note", "")], said


def played(node: Path, commands: str, asked: dict[str, str] | None = None) -> tuple[list[dict[str, Any]], str]:
    """All that was written, and what the node said."""
    timings = node.parent / "timings.jsonl"
    timings.unlink(missing_ok=True)
    environment = {
        **os.environ,
        "FOGSPEC_TIMINGS": str(timings),
        "LD_PRELOAD": str(compiled_library(node.parent)),
        **(asked or ASKED),
    }
    ran = subprocess.run(
        [node], input=commands, text=True, env=environment, capture_output=True, timeout=600, check=True
    )
    lines = timings.read_text().splitlines() if timings.exists() else []
    return [json.loads(line) for line in lines], ran.stdout


def cost_s(node: Path, count: int = 200_000) -> float:
    """Seconds of CPU that the library takes for one request: with it, minus without it."""
    bare = subprocess.run(
        [node], input=f"loop {count}\n", text=True, capture_output=True, timeout=600, check=True
    ).stdout
    return (int(play(node, f"loop {count}\n")[1]) - int(bare)) / 1e9
