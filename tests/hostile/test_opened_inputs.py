"""The inputs of an application are the files that were opened, whatever the program says that it read.

Each opened file of the project is changed: every verb refuses it. It is put back: every verb accepts it. A neighbour's files
move nothing. `test_tampering` has what each verb says of other edits, `test_sent_files` which files are sent.
"""

import contextlib
import fnmatch
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from fogspec.deploy import checks
from fogspec_lab import cli as lab
from tests.corners.test_chain import with_timings
from tests.e2e.test_check import AT, git
from tests.e2e.test_policies import about
from tests.support.once import once
from tests.support.running import CATALOG, Shell, measure, shell, spec  # noqa: F401

BOTH = frozenset({"demo", "demo@prod"})  # the application, and its environment
OWN = frozenset({"of the manifest in whose directory it is"})
COMMANDS = (
    ("compile", "demo"),
    ("check", "demo"),
    ("check", "--since", "HEAD"),
    ("status", "demo"),
    ("diff", "demo"),
    ("bench", "demo", "--dry-run"),
    ("apply", "compiled/demo/manifest.yaml", "--dry-run"),
    ("apply", "compiled/demo@prod/manifest.yaml", "--dry-run"),
)


def longer(content: bytes) -> bytes:
    return content + b"\n"


def value(old: str, new: str) -> Callable[[bytes], bytes]:
    """Return a change of the first value that matches."""

    def change(content: bytes) -> bytes:
        changed = re.sub(old.encode(), new.encode(), content, count=1, flags=re.MULTILINE)
        assert changed != content, old
        return changed

    return change


@dataclass(frozen=True)
class Role:
    """How files of a role are changed, whose manifest that moves, and whether the next measurement is another one."""

    change: Callable[[bytes], bytes]
    moves: frozenset[str] = BOTH
    measured: bool = False


# By the pattern of the path; the first that matches counts.
ROLES = {
    "specs/demo/demo.yaml": Role(value(r"apt: \[curl\]", "apt: [wget]"), measured=True),
    "specs/demo/demo.lock": Role(value("sha256:.{4}", "sha256:0000"), measured=True),
    "specs/demo/*": Role(longer, measured=True),
    "environments/prod.yaml": Role(value("alpha: 1", "alpha: 0"), frozenset({"demo@prod"})),
    # A policy judges the manifest, which names those that it was made under; no bench is another one.
    "policies/*": Role(value(r'"maximum": 10\b', '"maximum": 0.01')),
    "offers.csv": Role(value("0.40", "0.41"), measured=True),
    "library.json": Role(longer),
    "results/demo/*.yaml": Role(value("mean: .*", "mean: 0.1"), measured=True),
    "results/demo/timings/*": Role(longer),
    "compiled/agent.pyz": Role(longer, measured=True),
    "compiled/demo/plan.yaml": Role(value("^  duration: .*", "  duration: 9min"), measured=True),
    "compiled/demo/tasks/*": Role(value("max_hourly_cost: .*", "max_hourly_cost: 9"), measured=True),
    "compiled/demo/scripts/measure.sh": Role(longer, measured=True),
    "compiled/demo/scripts/setup.sh": Role(longer, measured=True),
    "compiled/demo*/scripts/deploy.sh": Role(longer, OWN),
    "compiled/demo*/models.yaml": Role(value("statistic: mean", "statistic: p95"), OWN),
    "compiled/demo*/menu.yaml": Role(value("predicted|measured", "seen"), OWN),
    "compiled/demo*/manifest.yaml": Role(value("instance: .*", "instance: a.huge"), OWN),
    "compiled/demo*/deploy.sky.yaml": Role(value("run: ", "run: curl evil; "), OWN),
    "compiled/demo*/cloud.launch.py": Role(longer, OWN),
}
# What is opened and moves nothing.
NOTHING = {
    "compiled/*.svg": "a chart is no link of the chain: verbs warn of another one",
    "fogspec.yaml": "where the live state is, not what is deployed",
    "specs/other/*": "a neighbour's, opened to find the application by its name",
}


def build(shell: Shell) -> None:
    """A committed application with all kinds of inputs, and a neighbour; both locked, measured and compiled."""
    shapes = {
        name: row.split(",")[3:6]
        for row in CATALOG.splitlines()[1:]
        if not (name := row.partition(",")[0]).startswith("g")
    }
    machines = "".join(f"aws,{name},{','.join(shape)}\n" for name, shape in shapes.items())
    latencies = [f"w{w},s{w},aws,{name},{1 + (w + 1) / int(c)}\n" for w in range(6) for name, (c, *_) in shapes.items()]
    suite = shell.folder.parent / "suite"
    shell.write("../suite/machines.csv", f"Cloud,InstanceType,vCPUs,MemoryGiB,Price\n{machines}")
    shell.write("../suite/latencies.csv", f"workload,suite,cloud,instance_type,latency_s\n{''.join(latencies)}")
    shell("library", "--from", str(suite), "--out", "library.json", run=lab.main)
    shell.write("offers.csv", CATALOG)
    shell.write("fogspec.yaml", "apiVersion: fogspec.dev/v1alpha1\nkind: Project\nspec: {state: folder}\n")
    shell.write("environments/prod.yaml", "metadata: {name: demo}\nspec: {objective: {alpha: 1}}\n")
    price: dict[str, object] = {"maximum": 10, "description": "a machine costs at most $10 per hour"}
    shell.write("policies/team.schema.json", about("DeploymentManifest", {"price": price}))
    for name in ("demo", "other"):
        at = f"specs/{name}"
        text = spec(
            name=name,
            cloud="[{cmd: [python3, work.py]}, {package: arm, executable: plan, parameter_files: [parameters.yaml]}]",
            probe="{request: /image, response: /grasp}",
            library="../../library.json",
            ros="{distro: humble, apt: [curl]}",
            benchmark="{budget: $5, stop: {requests: 20, duration: 1min}, ready_timeout: 1min, workload: {bag: run.mcap}}",
        )
        shell.write(f"{at}/{name}.yaml", text)
        shell.write(f"{at}/work.py", "import helper\n")
        shell.write(f"{at}/helper/__init__.py", "")
        shell.write(f"{at}/parameters.yaml", "/**: {ros__parameters: {a: 1}}\n")
        shell.write(f"{at}/run.mcap", "a recorded bag\n")
    shell("lock", *AT)
    shell("compile")
    for name in ("demo", "other"):
        measure(shell, name=name)
        with_timings(shell, [2.0, 2.1, 2.2], f"specs/{name}/{name}.yaml", "/grasp")
    shell("compile")
    git(shell, "init", "-q")
    git(shell, "add", "-A")
    git(shell, "commit", "-qm", "all")


OPENED: list[set[str]] = []  # the set that is being filled
BELOW: list[str] = []  # the directory that a path is relative to, while `os.open` has one
HOOKS: list[Callable[..., None]] = []


def _on_open(event: str, arguments: tuple[Any, ...]) -> None:
    if event == "open" and OPENED and not isinstance(arguments[0], int):
        path, _, flags = arguments
        if flags & os.O_ACCMODE != os.O_WRONLY:
            OPENED[-1].add(os.path.join(*(BELOW or [os.getcwd()]), os.fsdecode(path)))


@contextlib.contextmanager
def recorded(monkeypatch: pytest.MonkeyPatch) -> Iterator[set[str]]:
    """Yield the paths that this process opens to read."""
    if not HOOKS:
        sys.addaudithook(_on_open)
        HOOKS.append(_on_open)
    real = os.open

    def opened(path: Any, flags: int, mode: int = 0o777, *, dir_fd: int | None = None) -> int:
        if dir_fd is None:
            return real(path, flags, mode)
        BELOW[:] = [os.readlink(f"/proc/self/fd/{dir_fd}")]  # of which the hook is not told
        try:
            return real(path, flags, mode, dir_fd=dir_fd)
        finally:
            BELOW.clear()

    found: set[str] = set()
    with monkeypatch.context() as patch:
        patch.setattr(os, "open", opened)
        OPENED.append(found)
        try:
            yield found
        finally:
            OPENED.pop()


def below(folder: Path, paths: set[str]) -> set[str]:
    """Return the files that are below the folder, by their paths from there."""
    root = os.path.realpath(folder)
    files = {os.path.relpath(os.path.realpath(path), root) for path in paths if os.path.isfile(path)}
    return {path for path in files if not path.startswith("..")}


@pytest.fixture
def whole(shell: Shell) -> Shell:
    """A copy of what `build` made, with the files that were opened in `../opened.json`."""

    def fill(folder: Path) -> None:
        build(shell)
        with recorded(shell.monkeypatch) as found:
            for words in COMMANDS:
                shell(*words)
        shell.write("../opened.json", json.dumps(sorted(below(shell.folder, found))))
        shutil.copytree(shell.folder, folder / "project")
        shutil.copy(shell.folder / "../opened.json", folder)
        shutil.rmtree(shell.folder)

    made = once("tests/hostile/test_opened_inputs.py", fill)
    shutil.copytree(made / "project", shell.folder, dirs_exist_ok=True)
    shutil.copy(made / "opened.json", shell.folder.parent)
    # SkyPilot's access to clouds, which it takes seconds to look for, is no file of the project.
    shell.monkeypatch.setattr(checks, "_skypilot", lambda _places, _backend_for: iter(()))
    return shell


def opened(shell: Shell) -> list[str]:
    found: list[str] = json.loads(shell.read("../opened.json"))
    return found


def matching(path: str, patterns: dict[str, Any]) -> str | None:
    return next((one for one in patterns if fnmatch.fnmatchcase(path, one)), None)


def red(shell: Shell) -> dict[str, set[str]]:
    """Return by verb the applications that it refuses or reports."""

    def data(*words: str) -> Any:
        return json.loads(shell(*words, "-o", "json", code=None).out)

    judged = {name: data(*words)["applications"] for name, words in (("check", COMMANDS[1]), ("since", COMMANDS[2]))}
    found = {verb: {one["name"] for one in some if one["problems"]} & BOTH for verb, some in judged.items()}
    found["status"] = {
        one["name"]
        for one in data("status", "demo")
        if one["refused"] or any(stage["state"] != "fresh" for stage in one["stages"])
    }
    found["diff"] = {
        one["name"]
        for one in data("diff", "demo")["applications"]
        if not one["fresh"] or one["refused"] or one["policies"]["broken"]
    }
    manifests = {name: ("apply", f"compiled/{name}/manifest.yaml", "--dry-run") for name in BOTH}
    found["apply"] = {name for name, words in manifests.items() if shell(*words, code=None).code}
    found["bench"] = {"demo"} if shell(*COMMANDS[5], code=None).code else set()
    return found


GREEN: dict[str, set[str]] = {verb: set() for verb in ("check", "since", "status", "diff", "apply", "bench")}


def test_every_opened_file_has_one_role_and_every_role_a_file(whole: Shell) -> None:
    found = opened(whole)
    roles = {path: matching(path, ROLES) or matching(path, NOTHING) for path in found}
    assert [path for path, role in roles.items() if role is None] == [], "how is it changed, and what must move?"
    assert [one for one in (*ROLES, *NOTHING) if one not in roles.values()] == [], "no longer opened"
    assert red(whole) == GREEN


@pytest.mark.parametrize("place", dict.fromkeys(one.partition("/")[0] for one in ROLES))
def test_a_changed_input_is_red_in_every_verb_and_green_when_it_is_put_back(whole: Shell, place: str) -> None:
    for name in [one for one in opened(whole) if one.partition("/")[0] == place]:
        pattern = matching(name, ROLES)
        if pattern is None:
            continue  # NOTHING has it
        role, path = ROLES[pattern], whole.folder / name
        moves = {name.split("/")[1]} if role.moves is OWN else role.moves
        before = path.read_bytes()
        path.write_bytes(role.change(before))
        expected = dict.fromkeys(GREEN, moves)
        assert red(whole) == expected | {"bench": {"demo"} if role.measured else set()}, name
        path.write_bytes(before)
        os.utime(path, (1, 1))
    assert red(whole) == GREEN


def test_what_is_opened_and_is_no_input_moves_nothing(whole: Shell) -> None:
    for name in opened(whole):
        if matching(name, ROLES) is None:
            path = whole.folder / name
            path.write_bytes(longer(path.read_bytes()))
    assert red(whole) == GREEN


def another(shell: Shell) -> None:
    shell.write("specs/other/other.yaml", shell.read("specs/other/other.yaml").replace("python3", "python4"))


def own_files(shell: Shell) -> list[Path]:
    """Return all files of the neighbour."""
    folders = ("specs/other", "results/other", "compiled/other")
    return [path for folder in folders for path in sorted((shell.folder / folder).rglob("*")) if path.is_file()]


def lengthen(shell: Shell) -> None:
    for path in own_files(shell):
        path.write_bytes(longer(path.read_bytes()))


def remove(shell: Shell) -> None:
    for path in own_files(shell):
        path.unlink()


def touch(shell: Shell) -> None:
    for path in shell.folder.rglob("*"):
        if ".git" not in path.parts:
            os.utime(path, (1, 1))


def add(shell: Shell) -> None:
    for name in (
        "specs/other/more.py",
        "specs/other/helper/more.py",
        "results/other/notes.txt",
        "compiled/other/a.svg",
    ):
        shell.write(name, "more\n")


def pin(shell: Shell) -> None:
    name = "specs/other/other.lock"
    shell.write(name, value("sha256:.{4}", "sha256:0000")(shell.read(name).encode()).decode())


NEIGHBOURS: dict[str, Callable[[Shell], object]] = {
    "its spec": another,
    "its spec is no YAML": lambda shell: shell.write("specs/other/other.yaml", "kind: [Application\n"),
    "its lock": pin,
    "each of its files": lengthen,
    "its files are gone": remove,
    "all timestamps": touch,
    "more files of its own": add,
    "the message of the commit": lambda shell: git(shell, "commit", "-q", "--amend", "-m", "another message"),
}


@pytest.mark.parametrize("what", NEIGHBOURS)
def test_a_neighbour_moves_nothing(whole: Shell, what: str) -> None:
    words = (COMMANDS[1], *COMMANDS[3:5])
    before = [whole(*one) for one in words]
    NEIGHBOURS[what](whole)
    assert [whole(*one) for one in words] == before
    assert red(whole) == GREEN


def test_the_hook_misses_no_file_that_the_kernel_opens(whole: Shell) -> None:
    """The same commands in processes of their own; git, which they start, reads the project by its own rules."""
    if shutil.which("strace") is None:
        pytest.skip("needs strace: apt-get install strace")
    if subprocess.run(["strace", "-o", os.devnull, "true"], capture_output=True, check=False).returncode:
        pytest.skip("needs strace that may trace its children, which is forbidden here")
    logs = whole.folder.parent / "traced"
    logs.mkdir()
    for number, words in enumerate(COMMANDS[:3] + COMMANDS[5:6]):
        line = ["strace", "-ff", "-y", "-z", "-s", "4096", "-o", str(logs / str(number)), "-e", "trace=/^open|^execve$"]
        subprocess.run(
            [*line, sys.executable, "-m", "fogspec", *words], cwd=whole.folder, capture_output=True, check=True
        )
    found = set[str]()
    for log in logs.iterdir():
        text = log.read_text("utf-8")
        if '/git"' in text.partition("\n")[0]:
            continue
        read = [line for line in text.splitlines() if line.startswith("open") and "O_WRONLY" not in line]
        found |= {one[1] for line in read if (one := re.search(r" = \d+<(.*)>$", line))}
    with recorded(whole.monkeypatch) as hooked:
        for words in COMMANDS[:3] + COMMANDS[5:6]:
            whole(*words)
    assert below(whole.folder, found) == below(whole.folder, hooked) != set()
