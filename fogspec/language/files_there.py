"""What a spec names beside itself and is not there: an error of every command that plans, pins or starts something with it."""

import ast
import contextlib
import os
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

from fogspec.agent.stopping import mistyped
from fogspec.base.errors import InvalidInput
from fogspec.base.files import PULL, read_file
from fogspec.base.repository import top_of
from fogspec.base.text import shell
from fogspec.base.yaml.positions import Path as FieldPath
from fogspec.base.yaml.positions import dotted
from fogspec.base.yaml.writer import flow
from fogspec.language.lockfile import some
from fogspec.language.named_files import named_files, nodes_on_machine, sends_files, words_of_commands
from fogspec.language.probe import absolute
from fogspec.language.rules.finding import Finding
from fogspec.language.schema import NO_LIBRARY, Application, Node, Spec
from fogspec.language.suggest import closest
from fogspec.language.tree import Tree

CODE = "FS545"
PACKAGE_NAME = re.compile(rb"<name>\s*([A-Za-z0-9_-]+)\s*</name>")
MOST_BYTES = 1 << 18
# What may install an executable under a name that is not written in CMakeLists.txt.
UNCERTAIN = re.compile(
    r"\b(foreach|macro|function|include|add_subdirectory|ament_auto_add_executable|ament_python_install_package|file)\s*\("
    r"|\bRENAME\b|\bOUTPUT_NAME\b|\binstall\s*\(\s*(DIRECTORY|FILES)[^)]*\blib/",
    re.IGNORECASE,
)
NO_PACKAGES = ("build", "install", "log")
MARKERS = ("COLCON_IGNORE", "AMENT_IGNORE")
MOST_FILES = 200
TOPIC = re.compile(
    r"topic_metadata:\s+name: ['\"]?(/[\w/]+)(?:(?:(?!topic_metadata:).)*?message_count: (\d+))?", re.DOTALL
)
EVENT = "/_service_event"
MODULE = re.compile(r"^[ \t]*path[ \t]*=[ \t]*\"?([^\"\n]+)", re.MULTILINE)  # of .gitmodules
STORED, PACKED = (".db3", ".mcap"), (".zst", ".zstd")  # files of a bag


def missing_files(application: Application, folder: Path, tree: Tree | None, measured: bool) -> Iterator[Finding]:
    """Find what is not in `folder`, the spec's own, or not in the `tree` that is sent from it, and must be on a machine.

    `measured` says whether requests are sent to it too.
    """
    spec = application.spec
    for path, name in (*_listed(spec), *named_files(spec, measured)):
        if not os.path.isabs(name) and not _exists(folder / name):
            message = f"{dotted(path)} names {name}, which is not there"
            yield Finding(CODE, path, message, "paths are relative to the spec's folder")
    for path, name in dict.fromkeys((*named_files(spec, measured), *words_of_commands(spec, measured))):
        at = os.path.normpath(name)
        if tree is not None and not os.path.isabs(name) and _exists(folder / name) and tree.excludes(at):
            fix = (
                f"rename it: {', '.join(tree.ignored)} are left out" if tree.holds(at) else f"add {name} to spec.files"
            )
            yield Finding(CODE, path, f"{dotted(path)} names {name}, which is not sent to machines", fix)
    yield from _not_checked_out(spec, folder, tree, measured) if tree is not None else ()
    yield from _packages(spec, folder, nodes_on_machine(spec, measured))
    yield from _recorded(spec, folder) if measured else ()


def shared_folder(application: Application, folder: Path, others: Iterable[str]) -> Iterator[Finding]:
    """Find that an application receives files from a directory that it shares with `others`, and does not name them.

    `others` are read only if they matter: to find them, files are opened.
    """
    spec = application.spec
    if spec.files is not None or not sends_files(spec) or not (names := list(others)):
        return
    message = f"the directory of {application.metadata.name} also holds {some(names, 3)}: name the files of each"
    yield Finding(
        "FS567", ("metadata", "name"), message, f"add '{flow({'files': files_used(spec, folder)})[1:-1]}' to spec"
    )


def files_used(spec: Spec, folder: Path) -> list[str]:
    """Return what the nodes of a spec use in its directory: what it names, and what Python programs import from there."""
    named = [name for _, name in named_files(spec, measured=True) if not os.path.isabs(name)]
    named += [word for _, word in words_of_commands(spec, measured=True) if _exists(folder / word)]
    found = [name for name in dict.fromkeys(map(os.path.normpath, named)) if name.split("/")[0] != ".."]
    for name in found:  # grows while it is walked
        if name.endswith(".py"):
            found += [one for one in _imports(folder, name) if one not in found]
    return [name for name in found if not any(name.startswith(f"{other}/") for other in found)]


def _imports(folder: Path, name: str) -> Iterator[str]:
    """Yield the modules and packages next to a Python program that it imports, relative to `folder`."""
    try:
        tree = ast.parse(read_file(folder / name, MOST_BYTES))
    except (OSError, SyntaxError, ValueError, RecursionError, MemoryError):
        return
    nodes = list(ast.walk(tree))
    modules = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    modules |= {node.module for node in nodes if isinstance(node, ast.ImportFrom) and node.module and not node.level}
    for module in sorted({one.partition(".")[0] for one in modules}):
        beside = os.path.join(os.path.dirname(name), module)
        yield from (one for one in (f"{beside}.py", beside) if _exists(folder / one))


def _listed(spec: Spec) -> Iterator[tuple[FieldPath, str]]:
    yield from ((("spec", "files", i), name) for i, name in enumerate(spec.files or []))
    if spec.library not in (None, NO_LIBRARY):
        yield ("spec", "library"), spec.library


def _not_checked_out(spec: Spec, folder: Path, tree: Tree, measured: bool) -> Iterator[Finding]:
    """Find files of Git LFS and folders of submodules that git has not filled."""
    found = [(path, "is a pointer of Git LFS, not the file", PULL) for path in _pointers(tree)]
    for path in _empty_submodules(folder):
        if not tree.excludes(path):
            found.append(
                (path, "is the empty folder of a submodule", f"run 'git submodule update --init {shell(path)}'")
            )
    named = [*_listed(spec), *named_files(spec, measured), *words_of_commands(spec, measured)]
    for path, what, fix in found:
        holders = [at for at, name in named if f"{path}/".startswith(f"{os.path.normpath(name)}/")]
        yield Finding(CODE, (holders or [("metadata", "name")])[0], f"{path}, which machines get, {what}", fix)


def _pointers(tree: Tree) -> list[str]:
    try:
        return list(tree.pointers())
    except InvalidInput:
        return []  # what cannot be sent is said where it is to be sent


def _empty_submodules(folder: Path) -> Iterator[str]:
    """Yield the folders of submodules below a directory that are there, and empty."""
    top, here = top_of(folder), os.path.realpath(folder)
    if top is None:
        return
    try:
        listed = read_file(top / ".gitmodules", MOST_BYTES).decode("utf-8", "replace")
    except OSError:
        return
    for name in MODULE.findall(listed):
        path = os.path.relpath(top / name.rstrip(), here)
        with contextlib.suppress(OSError):  # it is not there, or cannot be read
            if path.split("/")[0] not in ("..", ".") and not any((folder / path).iterdir()):
                yield path


def _packages(spec: Spec, folder: Path, nodes: list[tuple[FieldPath, Node]]) -> Iterator[Finding]:
    """Find packages of nodes that neither the workspace nor `ros.apt` has, and executables that a package surely lacks."""
    if spec.ros is None or spec.ros.workspace is None or not (folder / spec.ros.workspace).is_dir():
        return
    above, last = os.path.split(os.path.normpath(spec.ros.workspace))
    if last == "src" and above and not (folder / spec.ros.workspace / "src").is_dir():
        fix, at = f"write '{above}'", ("spec", "ros", "workspace")
        yield Finding(CODE, at, "spec.ros.workspace must be the directory that has src, not src itself", fix)
        return
    known = packages_of(folder / spec.ros.workspace / "src")
    for path, node in nodes:
        installed = node.package is None or any(
            name.endswith(f"-{node.package.replace('_', '-')}") for name in spec.ros.apt
        )
        if node.package in known:
            if node.executable and (made := executables_of(known[node.package])) and node.executable not in made:
                near = closest(node.executable, sorted(made))
                message = f"{dotted((*path, 'executable'))}: the package {node.package} has no {node.executable}"
                fix = f"write '{near}'" if near else f"it has: {', '.join(sorted(made))}"
                yield Finding(CODE, (*path, "executable"), message, fix)
            yield from _parameters(path, node, known[str(node.package)])
            continue
        if installed:
            continue
        near = closest(str(node.package), sorted(known))
        message = f"{dotted((*path, 'package'))} {node.package} is not in {spec.ros.workspace}/src"
        apt = f"ros-{spec.ros.distro}-{str(node.package).replace('_', '-')}"
        fix = f"write '{near}'" if near else f"add it there, or {apt} to spec.ros.apt"
        yield Finding(CODE, (*path, "package"), message, fix, (("spec", "ros"),))


def executables_of(package: Path) -> set[str]:
    """Return the executables that a package's setup.py or CMakeLists.txt installs; none where that is not certain."""
    try:
        if (package / "CMakeLists.txt").is_file():
            return _of_cmake(read_file(package / "CMakeLists.txt", MOST_BYTES).decode("utf-8", "replace"))
        tree = ast.parse(read_file(package / "setup.py", MOST_BYTES))
    except (OSError, SyntaxError, ValueError, RecursionError):
        return set()
    calls = [one for one in ast.walk(tree) if isinstance(one, ast.Call) and getattr(one.func, "id", "") == "setup"]
    words = {one.arg: one.value for call in calls for one in call.keywords}
    try:
        scripts = ast.literal_eval(words["entry_points"])["console_scripts"]
        return (
            {str(one).partition("=")[0].strip() for one in scripts}
            if words.keys().isdisjoint({"scripts", None})
            else set()
        )
    except (ValueError, KeyError, TypeError):
        return set()


def _of_cmake(text: str) -> set[str]:
    text = re.sub(r"#.*", "", text)
    if UNCERTAIN.search(text):
        return set()
    found = set(re.findall(r'(?:\badd_executable\s*\(|\bEXECUTABLE)\s*"?([^\s")]+)', text))
    for programs in re.findall(r"\binstall\s*\(\s*PROGRAMS\s+([^)]*?)\bDESTINATION\b", text):
        found |= {os.path.basename(one.strip('"')) for one in programs.split()}
    return found if not any("$" in one for one in found) else set()


def packages_of(folder: Path) -> dict[str, Path]:
    """Return the packages below a workspace's `src` by their names, as colcon finds them."""
    found: dict[str, Path] = {}
    for parent, folders, files in os.walk(folder):
        if any(name in files for name in MARKERS):
            folders.clear()
            continue
        folders[:] = [name for name in folders if not name.startswith(".") and name not in NO_PACKAGES]
        if "package.xml" in files:
            folders.clear()
            try:
                content = read_file(os.path.join(parent, "package.xml"), MOST_BYTES)
            except OSError:
                continue
            if (name := PACKAGE_NAME.search(content)) is not None:
                found[name[1].decode()] = Path(parent)
    return found


def _parameters(path: FieldPath, node: Node, package: Path) -> Iterator[Finding]:
    """Find parameters whose names are slips of ones that a package's Python declares, and that no text in it has.

    What else is not declared is known once the node runs: a parameter may be declared by code of another package.
    """
    names = [name for name in node.parameters if "." not in name]
    if not names or _exists(package / "CMakeLists.txt"):
        return
    texts, declared = set[str](), set[str]()
    for file in sorted(package.rglob("*.py"))[:MOST_FILES]:
        try:
            tree = ast.parse(read_file(file, MOST_BYTES))
        except (OSError, SyntaxError, ValueError, RecursionError, MemoryError):
            return
        for one in ast.walk(tree):
            if isinstance(one, ast.Constant) and isinstance(one.value, str):
                texts.add(one.value)
            if (
                isinstance(one, ast.Call)
                and isinstance(one.func, ast.Attribute)
                and one.func.attr == "declare_parameter"
            ):
                declared |= {
                    arg.value for arg in one.args[:1] if isinstance(arg, ast.Constant) and isinstance(arg.value, str)
                }
    for name in names:
        near = next((other for other in sorted(declared) if name not in texts and mistyped(name, other)), None)
        if near is not None:
            at = (*path, "parameters", name)
            yield Finding(CODE, at, f"{node.package} declares no parameter {name}", f"write '{near}'", at_key=True)


def _recorded(spec: Spec, folder: Path) -> Iterator[Finding]:
    """Find that a bag of rosbag2 has no message of what is to be sent; a file of MCAP alone is not read here."""
    bag, probe = spec.benchmark.workload.bag, spec.probe
    at: FieldPath = ("spec", "benchmark", "workload", "bag")
    wanted = f"{probe.service}{EVENT}" if probe.service else probe.request
    if bag is None or wanted is None:
        return
    try:
        kinds = {one.suffix for one in (folder / bag).iterdir()}
        if kinds.intersection(PACKED) and not kinds.intersection(STORED):
            message = f"spec.benchmark.workload.bag names {bag}, which is compressed file by file, and is not played so"
            yield Finding(CODE, at, message, f"run 'zstd -d --rm {bag}/*.zst*' in the spec's folder")
            return
        listed = read_file(folder / bag / "metadata.yaml", MOST_BYTES).decode("utf-8", "replace")
    except OSError:
        return
    topics, wanted = sorted({name for name, count in TOPIC.findall(listed) if count != "0"}), absolute(wanted)
    if not topics or wanted in topics:
        return
    message = f"spec.benchmark.workload.bag names {bag}, which has no message of {wanted}"
    near = closest(wanted, topics)
    fix = f"the bag has {near}: name it in spec.probe, or record {wanted}" if near else f"the bag has {some(topics)}"
    yield Finding(CODE, at, message, fix, (("spec", "probe"),))


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except OSError:
        return False
