"""By construction: what writes, removes or starts does so in one place each; every exception has its reason here."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]
PACKAGES = (ROOT / "fogspec", ROOT / "lab" / "fogspec_lab")
AGENT = "it runs on the machine that is measured, in the folder of its own output, and imports nothing of fogspec's"
WRITES = {
    "base/project_files.py": "the one place",
    "backends/local/limits.py": "cgroups, which are the kernel's and named by itself",
    "backends/local/launcher.py": "cgroups and maps of user ids, which are the kernel's and named by itself",
    "backends/skypilot/secrets_file.py": "a new file of a machine's launch in the runtime directory, for its owner alone",
    "backends/skypilot/client.py": "what the worker prints, in a file without a name",
    "base/sandbox.py": "a scratch folder of its own for a sandboxed program, which goes with the call, and the null device",
    "base/git.py": "what git complains of, in a file without a name",
    "backends/skypilot/backend.py": "a folder of its own for a log, which goes with the call",
    "deploy/git_store.py": "a repository of its own for an exchange, which goes with the command",
    "catalog/sources/cache.py": "the user's cache, by names that it made itself",
    "language/tree.py": "a snapshot, in a folder that ProjectFiles has just made: each file in it is new",
    "backends/local/backend.py": "a sample's copy of that snapshot, in a folder that ProjectFiles has just made",
    "cli/__init__.py": "the null device in place of a closed pipe",
    "cli/init_graph.py": "a temporary directory of its own for the agent and its observations, which goes with the call",
    "lab/cli/evaluate.py": "the file of the choices that the user names, a line as each campaign ends",
    "lab/cli/conformance.py": "a temporary project of its own, removed once nothing is left",
    "lab/conformance.py": "the log of a bench, in that temporary project",
    "lab/generated.py": "files of the repository, in its checkout alone",
    "lab/snapshot.py": "the bundled catalog, in its checkout alone",
    "agent": AGENT,
}
STARTS = {
    "base/sandbox.py": "a sandboxed program: this interpreter, without an environment, in a scratch folder",
    "base/git.py": "git, by base/child.py",
    "backends/skypilot/client.py": "the worker, by base/child.py",
    "backends/local/limits.py": "the launcher, isolated",
    "backends/local/launcher.py": "the workload, in the spec's folder",
    "backends/images/credentials.py": "docker's helper, by base/child.py",
    "deploy/link.py": "bash, by base/child.py",
    "base/workers.py": "processes of the standard library, with the environment of base/child.py",
    "cli/init_graph.py": "the agent's watcher, by base/child.py",
    "lab/conformance.py": "fogspec's own commands, by base/child.py",
    "ros/description.py": "part of the user's own launch on the robot",
    "agent": AGENT,
}
ANY = {"write_text", "write_bytes", "unlink", "rmdir", "makedirs", "mkdir", "touch", "renames", "symlink_to", "hardlink_to",
       "symlink", "chmod", "fchmod", "lchmod", "chown", "ftruncate", "removedirs", "rmtree", "copytree", "copyfile", "copy2",
       "mkstemp", "mkdtemp", "NamedTemporaryFile", "TemporaryFile", "TemporaryDirectory", "SpooledTemporaryFile",
       "unpack_archive", "extractall", "rename", "mkfifo", "mknod"}  # fmt: skip
OF_MODULES = {"remove", "replace", "link", "truncate", "copy", "move", "utime", "open"}
PROCESSES = {"Popen", "run", "call", "check_call", "check_output", "getoutput", "system", "popen", "execv", "execve", "execvp",
             "execvpe", "execl", "execlp", "spawnv", "spawnvp", "posix_spawn", "posix_spawnp", "ProcessPoolExecutor",
             "get_context", "run_module", "run_path"}  # fmt: skip


def trees() -> Iterator[tuple[str, ast.Module]]:
    """Yield each module with its path in fogspec; one of the lab's as lab/PATH."""
    for package in PACKAGES:
        prefix = "" if package.name == "fogspec" else "lab/"
        for path in sorted(package.rglob("*.py")):
            yield prefix + path.relative_to(package).as_posix(), ast.parse(path.read_text("utf-8"))


def base(call: ast.Call) -> str | None:
    value = call.func.value if isinstance(call.func, ast.Attribute) else None
    return value.id if isinstance(value, ast.Name) else None


def name_of(call: ast.Call) -> str:
    return call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")


def mode(call: ast.Call, place: int) -> str:
    given = [one.value for one in call.keywords if one.arg == "mode"] + call.args[place : place + 1]
    return given[0].value if given and isinstance(given[0], ast.Constant) and isinstance(given[0].value, str) else "r"


def writes(call: ast.Call) -> bool:
    name = name_of(call)
    if isinstance(call.func, ast.Name):
        return name == "open" and set(mode(call, 1)) & set("wax+") != set()
    if name == "open" and base(call) == "os":
        return any(flag in ast.dump(call) for flag in ("O_WRONLY", "O_RDWR", "O_CREAT", "O_TRUNC"))
    if name == "open":
        return set(mode(call, 0)) & set("wax+") != set() and base(call) != "files"
    if name in OF_MODULES:
        return base(call) in ("os", "shutil") or (name == "replace" and len(call.args) == 1 and not call.keywords)
    return name in ANY


def starts(call: ast.Call) -> bool:
    name = name_of(call)
    of = base(call) in ("subprocess", "os", "runpy", "multiprocessing")
    return name in PROCESSES and (of or name in ("ProcessPoolExecutor", "get_context"))


def listed(path: str, allowed: dict[str, str]) -> bool:
    return path in allowed or path.split("/")[0] in allowed


@pytest.mark.parametrize(("what", "allowed"), [(writes, WRITES), (starts, STARTS)])
def test_it_is_done_in_one_place(what, allowed) -> None:
    found = {
        f"{path}:{node.lineno}: {ast.unparse(node.func)}": path
        for path, tree in trees()
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and what(node)
    }
    outside = [where for where, path in found.items() if not listed(path, allowed)]
    assert not outside, "see fogspec/base/project_files.py and fogspec/base/child.py"
    unused = [name for name in allowed if not any(listed(path, {name: ""}) for path in found.values())]
    assert not unused, "an exception that nothing needs"


@pytest.mark.parametrize(
    ("line", "is_one"),
    [
        ("open(path, 'w')", True),
        ("open(path, mode='ab')", True),
        ("open(path)", False),
        ("path.open('wb')", True),
        ("path.write_text('')", True),
        ("os.open(path, os.O_RDONLY)", False),
        ("os.open(path, os.O_RDWR | os.O_CREAT)", True),
        ("path.replace(other)", True),
        ("text.replace('a', 'b')", False),
        ("names.remove(name)", False),
        ("os.remove(name)", True),
        ("shutil.rmtree(path)", True),
    ],
)
def test_what_counts_as_writing(line: str, is_one: bool) -> None:
    call = ast.parse(line).body[0].value  # type: ignore[attr-defined]
    assert writes(call) == is_one


def test_no_program_is_named_without_its_place() -> None:
    """A command's first word comes from `child`, or is this interpreter."""
    for path, tree in trees():
        if listed(path, {"agent": "", "ros": ""}):
            continue
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and starts(node) and node.args and isinstance(node.args[0], ast.List):
                first = node.args[0].elts[0]
                assert not isinstance(first, ast.Constant), f"{path}:{node.lineno}: {ast.unparse(first)}"
