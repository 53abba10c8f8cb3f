"""Score the reading of launch files: `python -m tests.tools.launch.score FOLDER [--oracle PYTHON] [--json FILE]`.

For each launch file below FOLDER: whether `fogspec init --from-launch` makes a valid spec of it, and, where PYTHON has ROS 2's
`launch` and `launch_ros`, whether that spec's compiled launch file starts exactly what the real launch starts. A file that the
real launch cannot play by itself (it needs an argument, a package or a device) counts for validity only. A difference
is silent if nothing was noted about the file.
"""

import argparse
import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from fogspec.base.diagnostics import DiagnosticError
from fogspec.base.templates import render
from fogspec.compile.launch_source import words
from fogspec.importers.launch import read_launch
from fogspec.importers.launch.found import LaunchImport
from fogspec.importers.launch.packages import Packages, package_of
from fogspec.importers.launch.sandboxed.parameters import applies_to
from fogspec.importers.scaffold import first_data, first_text
from fogspec.language.loader import check_file
from fogspec.language.schema import Node

ORACLE = Path(__file__).with_name("oracle.py")
NAMES = re.compile(r".*[._]?launch\.(py|xml|ya?ml)$")
INSTALLED = "/opt/ros/share"
LIBRARY = "/.*/lib/([^/]+)/([^/]+)"


@dataclass
class Score:
    """What became of one launch file."""

    path: str
    seconds: float = 0.0
    refused: str | None = None
    valid: bool = False
    nodes: int = 0
    notes: list[str] = field(default_factory=list)
    real: str | None = None
    equal: bool | None = None
    differences: list[str] = field(default_factory=list)
    facts: list[Any] = field(default_factory=list)

    @property
    def silent(self) -> bool:
        return self.equal is False and not self.notes


class Oracle:
    """The real launch, in another Python."""

    def __init__(self, python: Sequence[str]) -> None:
        self.child = subprocess.Popen([*python, str(ORACLE)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def ask(
        self, file: Path, packages: dict[str, str], arguments: dict[str, str], spec: Path | None = None
    ) -> dict[str, Any]:
        question = {"file": str(file), "packages": packages, "arguments": arguments, "spec": str(spec or "")}
        assert self.child.stdin is not None
        assert self.child.stdout is not None
        self.child.stdin.write(json.dumps(question) + "\n")
        self.child.stdin.flush()
        answer: dict[str, Any] = json.loads(self.child.stdout.readline())
        return answer

    def close(self) -> None:
        assert self.child.stdin is not None
        self.child.stdin.close()
        self.child.wait(600)


def score(path: Path, folder: Path, arguments: dict[str, str], oracle: Oracle | None) -> Score:
    """Read one launch file, and compare with what the real launch starts."""
    one = Score(str(path.relative_to(folder)))
    begun = time.monotonic()
    try:
        found = read_launch(path, arguments, [folder])
    except DiagnosticError as problem:
        one.refused, one.seconds = problem.diagnostics[0].message, time.monotonic() - begun
        one.notes = [one.refused]
        found = None
    one.seconds = time.monotonic() - begun
    if found is not None:
        one.notes = [f"{note.span.path}:{note.span.line}: {note.message}" for note in found.notes]
        one.nodes = len(found.cloud) + len(found.robot)
    with tempfile.TemporaryDirectory() as temporary:
        spec = Path(temporary)
        if found is not None:
            data = first_data("scored", found)
            (spec / "scored.yaml").write_text(first_text(data, "x.json", [], found), "utf-8")
            wrong = [problem for problem in check_file([spec / "scored.yaml"])[1] if problem.severity == "error"]
            one.valid = not wrong
            one.differences = [problem.message for problem in wrong][:5]
        if oracle is not None:
            packages = _packages(path, folder)
            real = oracle.ask(path, packages, arguments)
            one.real = real.get("failed")
            if one.valid and "started" in real:
                _compare(one, found, data, spec, packages, real["started"], oracle)
    return one


def _compare(
    one: Score, found: LaunchImport, data: dict[str, Any], spec: Path, packages: dict[str, str],
    real: list[dict[str, Any]], oracle: Oracle,
) -> None:  # fmt: skip
    for name, text in found.files.items():
        (spec / "scored.params").mkdir(exist_ok=True)
        (spec / "scored.params" / name).write_text(text, "utf-8")
    nodes = [Node.model_validate(node) for node in [*data["spec"]["cloud"], *data["spec"].get("robot", [])]]
    compiled = spec / "scored.launch.py"
    compiled.write_text(
        render("node.launch.py.j2", **words(nodes), together=True).replace("Path.cwd()", f"Path({str(spec)!r})")
    )
    ours = oracle.ask(compiled, packages, {}, spec)
    if "failed" in ours:
        one.equal, one.differences = False, [f"the compiled file fails: {ours['failed']}"]
        return
    expected, got = ([_plain(fact, packages, spec) for fact in facts] for facts in (real, ours["started"]))
    one.equal = sorted(expected) == sorted(got)
    one.facts = [json.loads(_portable(fact, packages)) for fact in sorted(expected)]
    if not one.equal:
        left = list(got)
        missing = [fact for fact in expected if not (fact in left and left.remove(fact) is None)]
        one.differences = _differences([json.loads(fact) for fact in missing], [json.loads(fact) for fact in left])


def _portable(text: str, packages: dict[str, str]) -> str:
    """Return a fact without the folders of this machine."""
    for name, folder in packages.items():
        text = text.replace(f'"{folder}/', f'"$(find-pkg-share {name})/').replace(folder, f"$(find-pkg-share {name})")
    return re.sub(rf"{INSTALLED}/([\w-]+)", r"$(find-pkg-share \1)", text)


def _differences(missing: list[dict[str, Any]], left: list[dict[str, Any]]) -> list[str]:
    """Return what differs, in short: by entry where the program is the same."""
    found: list[str] = []
    for fact in missing:
        named = [(one.get("executable"), one.get("name")) for one in left]
        key = (fact.get("executable"), fact.get("name"))
        if fact["kind"] != "node" or key not in named:
            found.append(f"launch: {json.dumps(fact)[:300]}")
            continue
        other = left.pop(named.index(key))
        for word in sorted(fact.keys() | other.keys()):
            a, b = fact.get(word), other.get(word)
            if isinstance(a, dict) and isinstance(b, dict):
                a, b = ({k: v for k, v in x.items() if k not in y or y[k] != v} for x, y in ((a, b), (b, a)))
            if a != b:
                found.append(f"{key[0]} {word}: launch {json.dumps(a)[:160]}, fogspec {json.dumps(b)[:160]}")
    return found + [f"fogspec: {json.dumps(fact)[:300]}" for fact in left]


def _packages(path: Path, folder: Path) -> dict[str, str]:
    known = Packages(path, [folder])
    return {name: str(at) for name, at in known.folders.items()}


def _plain(fact: dict[str, Any], packages: dict[str, str], spec: Path) -> str:
    """Return a fact in words in which equal facts are equal."""
    fact = _as_process(dict(fact), packages)
    for one in [fact, *fact.get("components", [])]:
        if one.get("namespace") in ("", "/"):
            del one["namespace"]
        if one.get("name") == "":
            del one["name"]
        if "remappings" in one:
            pairs = [pair if isinstance(pair, list) else list(pair.partition(":=")[::2]) for pair in one["remappings"]]
            one["remappings"] = sorted(dict(reversed(pairs)).items())
    if "components" in fact:
        fact["components"] = sorted(fact["components"], key=lambda one: json.dumps(one, sort_keys=True))
    if "sequence" in fact:
        node = f"{fact.get('namespace', '')}/{fact.get('name', '')}"
        fact |= _effect(fact.pop("sequence"), packages, node)
    return json.dumps(fact, sort_keys=True).replace(f"{spec}/", "")


def _as_process(fact: dict[str, Any], packages: dict[str, str]) -> dict[str, Any]:
    """Return a fact as that of the process which it is: an included file by `ros2 launch`, `ros2 run` as a node."""
    if fact["kind"] == "include":
        match = re.match(rf"{INSTALLED}/([^/]+)/", fact["file"])
        own = next((name for name, at in packages.items() if fact["file"].startswith(f"{at}/")), match and match[1])
        if own:
            argv = ["ros2", "launch", own, os.path.basename(fact["file"])]
            pairs = [f"{key}:={value}" for key, value in fact["arguments"]]
            fact = {"kind": "process", "argv": [*argv, *pairs], "env": fact.get("env", {})}
    if fact["kind"] == "process":
        if fact.pop("shell", False):
            fact["argv"] = ["sh", "-c", " ".join(fact["argv"])]
        program = re.fullmatch(LIBRARY, fact["argv"][0]) if fact["argv"] else None
        if program:
            empty = {"prefix": [], "remappings": [], "ros_arguments": [], "sequence": []}
            named = f"<{program[1]}>/{program[2]}"
            fact = {"kind": "node", "executable": named, "arguments": fact["argv"][1:], "env": fact["env"], **empty}
    if fact["kind"] == "node":
        if fact["executable"] == "ros2" and fact["arguments"][:1] == ["run"]:
            fact["executable"] = f"<{fact['arguments'][1]}>/{fact['arguments'][2]}"
            fact["arguments"] = fact["arguments"][3:]
        fact["executable"] = re.sub(f"^{LIBRARY}$", r"<\1>/\2", fact["executable"])
    return fact


def _effect(sequence: list[list[Any]], packages: dict[str, str], node: str | None) -> dict[str, Any]:
    """Return files and values in effect: a value that a later file sets for this node has none."""
    files: list[str] = []
    values: dict[str, Any] = {}
    for kind, content in sequence:
        if kind == "values":
            values |= content
            continue
        files.append(_content(content))
        for name in _names(content, node):
            values.pop(name, None)
    return {"files": files, "values": values}


def _content(file: str) -> str:
    """Return a file by what is in it, if it is here: the spec may hold a copy."""
    if file.startswith("{"):
        return file
    try:
        return json.dumps(yaml.safe_load(Path(file).read_text("utf-8")), sort_keys=True, default=str)
    except (OSError, ValueError, yaml.YAMLError):
        return file


def _names(content: str, node: str | None) -> set[str]:
    try:
        data = json.loads(content) if content.startswith("{") else yaml.safe_load(Path(content).read_text("utf-8"))
    except (OSError, ValueError, yaml.YAMLError):
        return set()
    names: set[str] = set()

    def walk(value: Any, section: str, inside: bool, prefix: str) -> None:
        for key, below in value.items() if isinstance(value, dict) else ():
            if inside:
                names.add(f"{prefix}{key}")
                walk(below, section, True, f"{prefix}{key}.")
            elif key == "ros__parameters":
                walk(below, section, applies_to(section, node or ""), "")
            else:
                walk(below, f"{section}/{key}", False, "")

    walk(data, "", False, "")
    return names


def files_of(folder: Path) -> Iterator[Path]:
    """Yield the launch files below a folder, sorted."""
    for path in sorted(folder.rglob("*")):
        named = NAMES.fullmatch(path.name) or (path.parent.name == "launch" and path.suffix in (".py", ".xml", ".yaml"))
        if named and path.is_file() and path.name != "__init__.py" and package_of(path) and is_launch(path):
            yield path


def is_launch(path: Path) -> bool:
    """Whether a file is a launch file, and not a module or a test beside one."""
    text = path.read_text("utf-8", "replace")
    return "def generate_launch_description" in text if path.suffix == ".py" else "launch" in text


def summary(scores: Sequence[Score]) -> dict[str, Any]:
    """Return the figures of a folder."""
    seconds = sorted(one.seconds for one in scores)
    played = [one for one in scores if one.equal is not None]
    return {
        "files": len(scores),
        "refused": sum(one.refused is not None for one in scores),
        "valid": sum(one.valid for one in scores),
        "real launch plays": sum(one.real is None for one in scores),
        "compared": len(played),
        "equal": sum(one.equal is True for one in played),
        "unequal, noted": sum(one.equal is False and not one.silent for one in played),
        "silent losses": sum(one.silent for one in played),
        "notes": sum(len(one.notes) for one in scores),
        "median_s": round(statistics.median(seconds), 3) if seconds else None,
        "p95_s": round(seconds[min(len(seconds) - 1, int(0.95 * len(seconds)))], 3) if seconds else None,
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Print a line for each file that is not equal, and the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--oracle", nargs="+", metavar="PYTHON", help="command of a Python with launch and launch_ros")
    parser.add_argument("--only", default="", help="only files whose path has this text")
    parser.add_argument("--json", type=Path, help="write each file's score here")
    parser.add_argument(
        "--golden", type=Path, help="write what the real launch started here, for the tests of a corpus"
    )
    options = parser.parse_args(argv)
    oracle = Oracle(options.oracle) if options.oracle else None
    scores = []
    for path in files_of(options.folder.absolute()):
        if options.only in str(path):
            scores.append(score(path, options.folder.absolute(), {}, oracle))
    if oracle is not None:
        oracle.close()
    for one in scores:
        if one.equal is False or not one.valid:
            print(one.path, "SILENT" if one.silent else "", one.refused or "", *one.differences, sep="\n    ")
    if options.golden:
        options.golden.write_text(
            json.dumps({one.path: one.facts for one in scores if one.real is None}, indent=1, sort_keys=True) + "\n",
            "utf-8",
        )
    if options.json:
        options.json.write_text(json.dumps([vars(one) for one in scores], indent=1), "utf-8")
    print(json.dumps(summary(scores), indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
