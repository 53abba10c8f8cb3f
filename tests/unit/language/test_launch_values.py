"""What launch files compute with paths of packages and with texts that are not known: equal to the machine's, or refused."""

import json
import os
import pathlib
import random
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from fogspec.importers.launch import read_launch
from fogspec.importers.launch.sandboxed.values import Stop, Text, Unknown, kept, marked, text, unknown

PACKAGE, OTHER = "demo_robot", "demo.robot-2"
# Where machines have packages: all in one prefix, or each in its own.
MACHINES = ("/opt/ros/humble", "/root/ws/install", "/home/me/dev_ws/install/*")
METHODS = [name for name in dir(str) if not name.startswith("_") and name != "maketrans"]
ARGUMENTS = (
    "", "'/'", "'s'", "'install'", "'share', 'lib'", "'install', 'src'", "'/', '_'", "60", "'ros', 3", "'/', 2", "['a', 'b']",
    "{47: '_'}", "'demo_robot'", "'demo_robot', 'x'",
)  # fmt: skip
OF_PATHS = (
    'join(it, "config", "a.yaml")', 'join(it, "/etc/a")', 'join("maps", it)', "dirname(it)", "basename(it)",
    "normpath(it)", "splitext(it)[0]", "splitext(it)[1]", "split(it)[0]", "split(it)[1]",
    'relpath(it, os.path.dirname(it) or "/")', 'relpath(it, "/")', 'relpath(it, "/home/me/maps")',
    'relpath("/opt/x", it)', "relpath(it, OTHER)", 'commonpath([it, it + "/x"])',
    'commonpath([os.path.join("/", it), "/opt/ros"])', "commonpath([it, OTHER])", "commonprefix([it, OTHER])",
    "isabs(it)", "normcase(it)", "splitdrive(it)[1]", "expanduser(it)", "expandvars(it)",
    "abspath(os.path.join('/', it))",
)  # fmt: skip
OF_PATHLIB = (
    ".parent", ".parent.parent", ".parents[1]", ".parents[2]", ".name", ".stem", ".suffix", ".parts[-1]", ".parts[2]",
    ".parts", ".as_posix()", ".as_uri()", ".is_absolute()", ".root", ".anchor", ".with_suffix('.c')", ".with_name('x')",
    ".with_stem('x')", ".joinpath('a', 'b')", " / 'launch' / 'x.py'", ".relative_to('/')", ".relative_to('/opt')",
    ".is_relative_to('/opt/ros')", ".match('*/share/*')", ".match('/opt/*/*/*/*')", " == pathlib.PurePosixPath(OTHER)",
    " < pathlib.PurePosixPath('/m')", ".joinpath('..', 'x')", ".parts.index('share')", ".parents.__len__()",
    ".__hash__() % 9", ".as_posix()[6:]",
)  # fmt: skip
OTHERS = (
    "os.fspath(it)", "os.sep.join(it.split(os.sep)[:-1])", "os.path.normpath(it + '/..')",
    "(lambda one: f'file://{one}/a')(it)", "len(it)", "it[5:]", "it[40:]", "it[-3:]", "it[1]", "it[:5]", "it[::2]",
    "it[::-1]", "''.join(reversed(it))", "sorted(it)", "max(it, '/p')", "sorted([it, '/m'])", "it < '/m'",
    "it == '/opt/ros/humble/share/demo_robot'", "'ros' in it", "'install' in it", "'/' in it", "hash(it) % 7",
    "it.split('/')[2]", "it.split('/')[5]", "it.split('/')[-1]", "it + ':' + it", "it * 2", "'%s/x' % it",
    "re.sub('install|ros', 'src', it)", "re.findall('[a-z]+', it)[0]", "re.match('/opt', it) is None", "ord(it[2])",
    "{it: 1}", "repr(it)", "[one for one in it.split('/')][3]", "it.encode().decode()", "list(enumerate(it))[4]",
    "dict(a=it)['a']", "sum(map(ord, it))", "bytes(it, 'ascii')[9]", "ascii(it)", "format(it, '>60')", "json.dumps(it)",
    "any(one == 'x' for one in it)", "'{0}/{0}'.format(it)", "it + '_more'", "it.rsplit('/', 2)[0]",
    "it.rpartition('/')[2]", "it.replace('demo_robot', 'demo.robot-2')", "it.removesuffix('demo_robot')",
    "it.strip('/')", "len(it) > 90", "it.count('/') > 6", "it if len(it) < 30 else 'long'",
)  # fmt: skip
FILE = """\
import json, os, pathlib, re
from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch_ros.actions import Node

OTHER = get_package_share_directory({other!r})


def done(do):
    try:
        return str(do(get_package_share_directory({package!r})))
    except Exception as problem:
        return type(problem).__name__


def generate_launch_description():
    return LaunchDescription([Node(package='a', executable='b', name='n', parameters=[{{
{parameters}
    }}])])
"""


def operations(seed: int) -> list[str]:
    """Each operation on the path `it`, and chains of two and three of them."""
    some = [f"it.{name}({words})" for name in METHODS for words in ARGUMENTS]
    some += (
        [f"os.path.{one}" for one in OF_PATHS]
        + [f"pathlib.PurePosixPath(it){one}" for one in OF_PATHLIB]
        + list(OTHERS)
    )
    drawn = random.Random(seed)
    chains = [drawn.choices(some, k=drawn.choice((2, 3))) for _ in range(300)]
    return some + [inner_first(chain) for chain in chains]


def inner_first(chain: list[str]) -> str:
    made = chain[0]
    for one in chain[1:]:
        made = re.sub(r"\bit\b", lambda _, made=made: f"str({made})", one)  # type: ignore[misc]
    return made


def at_machine(said: str, machine: str) -> str:
    """Return a text of a spec as launch makes it on the machine."""
    said = re.sub(r"\$\(find-pkg-share ([\w.-]+)\)", rf"{machine}/share/\1".replace("*", r"\1"), said)
    return plain(re.sub(r"\$\(find-pkg-prefix ([\w.-]+)\)", machine.replace("*", r"\1"), said))


def plain(path: str) -> str:
    """Return a text in which no package's directory is entered and left again."""
    return re.sub(r"/share/[\w.-]+/\.\.(?![\w.-])", "/share", path)


def done(operation: str, machine: str) -> str:
    """Return what the machine makes of its path, or the name of Python's refusal."""
    it, other = (f"{machine.replace('*', name)}/share/{name}" for name in (PACKAGE, OTHER))
    try:
        return str(eval(operation, {"json": json, "os": os, "pathlib": pathlib, "re": re, "it": it, "OTHER": other}))
    except Exception as problem:
        return type(problem).__name__


@pytest.mark.parametrize("seed", range(3))
def test_what_is_computed_of_a_packages_path_is_the_machines_or_noted(tmp_path: Path, seed: int) -> None:
    some = operations(seed)
    lines = "\n".join(f"        'p{i}': done(lambda it: {one})," for i, one in enumerate(some))
    path = tmp_path / "x.launch.py"
    path.write_text(FILE.format(package=PACKAGE, other=OTHER, parameters=lines))
    found = read_launch(path)
    (node,) = [*found.cloud, *found.robot]
    silent, said = [], {message.partition(" is ")[0] for _, _, message in found.noted}
    for i, one in enumerate(some):
        value: Any = node["parameters"].get(f"p{i}")
        if value is None:
            assert f"the parameter p{i} of n" in said, one
        else:
            silent += [(one, value) for machine in MACHINES if at_machine(value, machine) != plain(done(one, machine))]
    assert not silent, "\n".join(map(repr, silent))
    assert len(node["parameters"]) > 250, "most of what a launch file does with a path needs no note"


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("make", [kept, unknown])
def test_a_text_that_is_not_known_goes_on_as_one_or_stops_what_looks_into_it(
    make: Callable[[str], Text], name: str
) -> None:
    played = 0
    for args in ((), ("xy",), ("x", "y"), (9,), (["a", "b"],), ({1: "x"},)):
        try:
            given = text(getattr(make("$(env X)") + "/tail", name)(*args))
        except Stop:
            played += 1
        except (TypeError, AttributeError):
            continue
        else:
            played += 1
            # What stands behind the part that is not known decides alone whether a text ends so.
            assert marked(given) or (name, given) in (("endswith", False), ("endswith", True)), (args, given)
    assert played


UNKNOWN: dict[str, Callable[[Unknown], object]] = {
    "if": bool, "for": lambda one: list(one), "len": len, "==": lambda one: one == 1, "<": lambda one: one < 1, "int": int,
    "in": lambda one: "a" in one, "float": float, "index": lambda one: [1, 2][one],
    "isinstance": lambda one: isinstance(1, one), "sorted": lambda one: sorted([one, one]), "max": lambda one: max(one, 1),
}  # fmt: skip


@pytest.mark.parametrize("name", sorted(UNKNOWN))
def test_what_decides_by_an_unknown_object_stops(name: str) -> None:
    with pytest.raises(Stop, match="only a launch"):
        UNKNOWN[name](Unknown("only a launch has it"))
