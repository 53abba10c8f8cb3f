"""Small files that would take a reader for ever, or all memory; and a run of the command line within limits.

`python -m tests.support.hostile_files` prints what each of them takes.
"""

import gzip
import json
import os
import re
import resource
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.support.forking import Ended, forked
from tests.support.scenes import SPEC

MOST_MEMORY = 2 << 30  # bytes of address space, numpy's and scipy's libraries among them
MOST_SECONDS = 600  # of processor time: a bound against hangs, far above what any of them takes
# A slow computer has used up a sandbox's time before a launch file has used up its memory, or has been read.
SPENT = re.compile(r"it takes (more than 4 s of processor time|longer than 30 s)")
HEAD = "InstanceType,vCPUs,MemoryGiB,Price,Region,GpuInfo,Cloud\n"
POLICY = {"$schema": "https://json-schema.org/draft/2020-12/schema"}


def run_bounded(folder: Path, *words: str) -> Ended:
    """Run fogspec with limits on its memory and its processor time."""

    def limited() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (MOST_MEMORY, MOST_MEMORY))
        resource.setrlimit(resource.RLIMIT_CPU, (MOST_SECONDS, MOST_SECONDS))

    return forked(folder, words, {"XDG_CACHE_HOME": str(folder / "cache")}, limited)


@dataclass(frozen=True)
class Bomb:
    """What to write into a folder, the command that reads it, its exit code, and a part of what it says."""

    reader: str
    name: str
    write: Callable[[Path], tuple[str, ...]]
    code: int
    says: str

    def ended_as_said(self, ended: Ended) -> bool:
        """Whether the command ended with this code and sentence, or a launch file's with those of a slow computer."""
        said = ended.stdout + ended.stderr
        slow = self.reader == "launch files" and ended.returncode == 1 and SPENT.search(said) is not None
        return slow or (ended.returncode == self.code and self.says in said)


def written(folder: Path, name: str, content: str | bytes) -> str:
    """Write a file, and return its name."""
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return name


def _launch(name: str, text: str, code: int, says: str) -> Bomb:
    return Bomb(
        "launch files",
        name,
        lambda at: ("init", "mine", "--from-launch", written(at, f"a.launch.{name}", text)),
        code,
        says,
    )


def _doubled(start: str, join: str, use: str) -> str:
    return f"a0 = {start}\n" + "".join(f"a{i + 1} = {join.format(f'a{i}')}\n" for i in range(40)) + use


def _compile(at: Path, catalog: str, content: str | bytes) -> tuple[str, ...]:
    written(at, "specs/tiny.yaml", SPEC)
    written(at, "specs/work.py", "")
    return "compile", "tiny", "--catalog", written(at, catalog, content)


def _catalog(name: str, file: str, content: Callable[[], str | bytes], says: str, code: int = 1) -> Bomb:
    return Bomb("catalogs", name, lambda at: _compile(at, file, content()), code, says)


def _spec(name: str, text: Callable[[], str], says: str, code: int = 1) -> Bomb:
    return Bomb("specs", name, lambda at: ("validate", written(at, "specs/tiny.yaml", text())), code, says)


def _laughs() -> str:
    anchors = "".join(f"    a{i + 1}: &a{i + 1} [{', '.join([f'*a{i}'] * 10)}]\n" for i in range(12))
    return SPEC + "  defaults:\n    a0: &a0 x\n" + anchors


def _entities() -> str:
    values = (" ".join([f"&e{i};"] * 10) for i in range(12))
    entities = "".join(f'<!ENTITY e{i + 1} "{value}">' for i, value in enumerate(values))
    return f"<!DOCTYPE launch [{entities}]><launch/>"


def _policy(name: str, schema: object, says: str) -> Bomb:
    def write(at: Path) -> tuple[str, ...]:
        written(at, "policies/a.schema.json", json.dumps({**POLICY, **dict(schema)}))  # type: ignore[call-overload]
        long = SPEC.replace("[python3, work.py]", f"[python3, work.py, {'a' * 40}]")
        return "validate", written(at, "specs/tiny.yaml", long)

    return Bomb("policies", name, write, 1, says)


def _nested(*keys: Any) -> Any:
    return {keys[0]: _nested(*keys[1:])} if len(keys) > 1 else keys[0]


def _references() -> object:
    definitions = {f"d{i}": {"allOf": [{"$ref": f"#/$defs/d{i + 1}"}] * 2} for i in range(40)}
    return {"$defs": {**definitions, "d40": {}}, "$ref": "#/$defs/d0"}


def _fifo(at: Path) -> tuple[str, ...]:
    (at / "specs").mkdir()
    os.mkfifo(at / "specs/tiny.yaml")
    return "validate", "specs"


def _sparse(at: Path) -> tuple[str, ...]:
    written(at, "specs/tiny.yaml", "# fogspec\n")
    os.truncate(at / "specs/tiny.yaml", 1 << 40)
    return "validate", "specs/tiny.yaml"


def _proc(at: Path) -> tuple[str, ...]:
    written(at, "specs/tiny.yaml", SPEC)
    written(at, "specs/work.py", "")
    (at / "specs/proc").symlink_to("/proc")
    (at / "specs/loop").symlink_to(".")
    return "validate", "specs"


def _library(at: Path, content: Callable[[], bytes]) -> tuple[str, ...]:
    written(at, "specs/a.json.gz", gzip.compress(content(), 6))
    written(at, "specs/tiny.yaml", SPEC + "  library: a.json.gz\n")
    written(at, "specs/work.py", "")
    return "compile", "tiny"


VARIABLES = f'<launch><arg name="a" default="{"x" * 100_000}"/><node exec="{"$(var a)" * 15_000}"/></launch>'
START = "from launch_ros.actions import Node\ndef generate_launch_description(): return "
DOUBLED = _doubled("'x'", "{0} + {0}", START + "[Node(package='p', executable=a40)]")
LISTS = _doubled(
    "['x']",
    "[{0}, {0}]",
    START + "[Node(package='p', executable='e', arguments=a40)]",
)
SCALAR = f"  a: {'a' * ((1 << 20) - 2000)}\n"
PATTERNS = [f'a{i},1,1,1,r,"{i}{"SizeInMiB" * 1_800}",aws\n' for i in range(1_000)]
CATASTROPHE = {"cmd": {"items": {"pattern": "^(a+)+$x"}}}
BOMBS = (
    _launch("xml", "<launch>" + "<group>" * 20 + "</group>" * 20 + "</launch>", 0, "no node"),
    _launch("deep.xml", "<launch>" + "<group>" * 8000 + "</group>" * 8000 + "</launch>", 1, "at most 50 deep"),
    _launch(
        "outside.xml", '<!DOCTYPE l [<!ENTITY a SYSTEM "file:///etc/passwd">]><launch>&a;</launch>', 1, "no DOCTYPE"
    ),
    _launch("entities.xml", _entities(), 1, "no DOCTYPE"),
    _launch("variables.xml", VARIABLES, 0, "MemoryError"),
    _launch("doubled.py", DOUBLED, 0, "MemoryError"),
    _launch("lists.py", LISTS, 1, "processor time"),
    _launch("line.py", "Node();" * 5_000, 0, "no node"),
    _launch("loop.py", "while True:\n    x = 1\n", 1, "processor time"),
    _launch("deep.yaml", "launch: " + "[" * 9_000 + "]" * 9_000, 1, "nested too deep"),
    _launch("large.py", "x;" * 200_000, 1, "more than 256 KiB"),
    _catalog("gzip", "a.csv.gz", lambda: gzip.compress(b"\n" * (400 << 20), 6), "more than 65,536 KiB unpacked"),
    _catalog("fields", "a.csv", lambda: "a,b\n" * 5_000_001, "at most 10,000,000 fields"),
    _catalog("columns", "a.csv", lambda: ",".join(f"c{i}" for i in range(100_000)) + "\n", "at most 256 columns"),
    _catalog("rows", "a.csv", lambda: HEAD + "a,1,1,1,r,,aws\n" * 500_001, "at most 500,000 rows"),
    _catalog("cell", "a.csv", lambda: HEAD + f'a,1,1,1,r,"{"x" * 20_000}",aws\n', "field larger than field limit"),
    _catalog("pattern", "a.csv", lambda: HEAD + "".join(PATTERNS), "", 0),
    Bomb("machine libraries", "gzip", lambda at: _library(at, lambda: b" " * (200 << 20)), 1, "16,384 KiB unpacked"),
    Bomb("machine libraries", "nested", lambda at: _library(at, lambda: b"[" * (8 << 20)), 1, "not a machine library"),
    _spec("nesting", lambda: SPEC + "  a: " + "[" * 5_000 + "]" * 5_000 + "\n", "nested at most 64 deep"),
    _spec("laughs", _laughs, "at most 100000 values"),
    _spec("scalar", lambda: SPEC + SCALAR, "not a field"),
    _spec("values", lambda: SPEC + "  a: [" + "1," * 30_000 + "]\n", "not a field"),
    _spec("nodes", lambda: SPEC.replace("    - cmd: [python3, work.py]\n", "    - cmd: [a]\n" * 4_000), "", 0),
    Bomb("specs", "pipe", _fifo, 1, "it is a pipe, not a file"),
    Bomb("specs", "sparse", _sparse, 1, "at most 1 MiB"),
    Bomb("specs", "links", _proc, 0, "1 application"),
    _policy(
        "pattern",
        _nested("properties", "spec", "properties", "cloud", "items", "properties", CATASTROPHE),
        "takes too long",
    ),
    _policy("references", _references(), "takes too long"),
)


def main() -> None:
    """Print what each file takes."""
    for bomb in [b for b in BOMBS if not sys.argv[1:] or b.reader in sys.argv]:
        with tempfile.TemporaryDirectory() as folder:
            ended = run_bounded(Path(folder), *bomb.write(Path(folder)))
        took = f"{ended.cpu_s:5.1f} s {ended.memory_mib:5} MiB"
        print(f"{bomb.reader:<18} {bomb.name:<14} {took}  {'' if bomb.ended_as_said(ended) else ended}"[:600])


if __name__ == "__main__":
    main()
