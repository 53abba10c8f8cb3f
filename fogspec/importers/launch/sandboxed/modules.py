"""The modules that a launch file can import: Python's own, those of packages that are here, and stand-ins for the rest."""

import datetime
import importlib
import importlib.abc
import importlib.machinery
import os
import sys
import time
import types
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from fogspec.importers.launch.sandboxed import guard, xacro
from fogspec.importers.launch.sandboxed.actions import as_module
from fogspec.importers.launch.sandboxed.context import perform
from fogspec.importers.launch.sandboxed.made import NAMES
from fogspec.importers.launch.sandboxed.paths import FOLDERS, PATH, folder_of, prefix, real, share
from fogspec.importers.launch.sandboxed.values import OWN, Text, Unknown, here, marked, plain, why

LIBRARIES = {
    "launch": (
        "actions", "conditions", "substitutions", "event_handlers", "launch_description_sources", "substitution", "condition",
        "action", "some_substitutions_type", "launch_description", "launch_context", "launch_description_source",
        "event_handler", "utilities", "utilities.type_utils", "events", "events.process", "events.lifecycle", "frontend",
    ),
    "launch_ros": (
        "actions", "descriptions", "substitutions", "parameter_descriptions", "event_handlers", "utilities", "events",
        "events.lifecycle", "parameters_type", "remap_rule_type",
    ),
    "nav2_common": ("launch",), "fogros2": (), "fogspec.ros": (),
}  # fmt: skip
BY_ITSELF = {"yaml", "_yaml", "fogspec"}
CHANGES = "only the machine determines what {}() returns"
CLOCK = ("time", "time_ns", "strftime", "localtime", "gmtime", "ctime", "asctime", "monotonic", "perf_counter")
OF_MACHINE = {
    "os": ("getpid", "getppid", "getlogin", "getuid", "getgid", "uname", "getcwd", "cpu_count", "urandom", "getloadavg"),
    "socket": ("gethostname", "getfqdn", "gethostbyname"), "platform": ("node", "machine", "processor", "platform", "uname"),
    "getpass": ("getuser",), "multiprocessing": ("cpu_count",), "shutil": ("which", "disk_usage"),
}  # fmt: skip
ALL_OF_MACHINE = ("random", "uuid", "secrets")


class Module(types.ModuleType):
    """A stand-in: what it does not have is unknown."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return Unknown(_reason(self.__name__, name))


def _reason(module: str, name: str) -> str:
    if module.partition(".")[0] in ALL_OF_MACHINE:
        return CHANGES.format(f"{module}.{name}")
    return f"only a launch determines what {module}.{name} gives"


def put(name: str, names: dict[str, Any]) -> None:
    """Make a stand-in importable."""
    made = Module(name)
    made.__dict__.update(names, __path__=[], __all__=[one for one in names if not one.startswith("_")])
    sys.modules[name] = made
    above, _, last = name.rpartition(".")
    if above:
        setattr(sys.modules[above], last, made)


def _index(function: Callable[[str], Any]) -> Callable[..., Any]:
    """Return a function of a package's name."""

    def do(package_name: Any, *_: Any, **__: Any) -> Any:
        if isinstance(package_name, Unknown):
            return Unknown(package_name._why, package_name._place)
        name = perform(package_name)
        return Unknown(why(name)) if marked(name) else function(plain(name))

    return do


class MoveIt:
    """MoveIt's builder: it reads parameters from a package while it launches, and is named in one line."""

    def __init__(self, robot_name: Any = None, *_: Any, package_name: Any = None, **__: Any) -> None:
        name = package_name or (f"{robot_name}_moveit_config" if isinstance(robot_name, str) else None)
        known = isinstance(name, str) and not isinstance(name, Text)
        self._why = (
            f"MoveItConfigsBuilder reads them from {f'the package {name}' if known else 'a package'} while it launches; "
            "'cmd: [ros2, launch, ...]' of this file keeps it"
        )
        self._place = here()

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return lambda *_, **__: Unknown(self._why, self._place)


def install() -> None:
    """Put the stand-ins in place; what is imported from now on is theirs, Python's own, or of a package that is here."""
    tools = {"perform_substitutions": lambda _, some: perform(some), "normalize_to_list_of_substitutions": _listed}
    for library, below in LIBRARIES.items():
        names = NAMES.get(library, NAMES["fogros2"]) | (tools if library == "launch" else {})
        for name in (library, *(f"{library}.{one}" for one in below)):
            put(name, names)
    put("launch_ros.parameters_type", {"SomeParameters": list, "SomeParametersDict": dict})
    put("launch.some_substitutions_type", {"SomeSubstitutionsType": str})
    sys.modules["launch"].__dict__["SomeSubstitutionsType"] = str
    put("launch.launch_description_sources", NAMES["launch"] | {"load_python_launch_file_as_module": as_module})
    put(
        "launch.launch_description_sources.python_launch_file_utilities",
        {"load_python_launch_file_as_module": as_module},
    )
    for front in ("launch_xml", "launch_yaml"):
        put(front, NAMES["launch"])
        put(f"{front}.launch_description_sources", NAMES["launch"])
    index = {
        "get_package_share_directory": _index(share), "get_package_share_path": _index(lambda name: Path(share(name))),
        "get_package_prefix": _index(prefix), "PackageNotFoundError": type("PackageNotFoundError", (KeyError,), {}),
        "get_packages_with_prefixes": lambda: {name: prefix(name) for name in FOLDERS},
    }  # fmt: skip
    for name in ("ament_index_python", "ament_index_python.packages"):
        put(name, index)
    put("moveit_configs_utils", {"MoveItConfigsBuilder": MoveIt})
    put("xacro", xacro.NAMES)
    _hide_the_machine()
    sys.meta_path.insert(0, Finder())


def _listed(value: Any) -> list[Any]:
    return list(value) if isinstance(value, (list, tuple)) else [value]


def _hide_the_machine() -> None:
    """Make unknown what differs from machine to machine, and from run to run."""
    for module, names in OF_MACHINE.items():
        of = importlib.import_module(module)
        for name in names:
            setattr(of, name, _changing(f"{module}.{name}", getattr(of, name) if name != "getcwd" else None))
    for name in ALL_OF_MACHINE:
        sys.modules[name] = Module(name)
    clock = types.ModuleType("time")
    clock.__dict__.update(vars(time), sleep=lambda _: None, **{name: _changing(f"time.{name}") for name in CLOCK})
    dates = types.ModuleType("datetime")
    dates.__dict__.update(vars(datetime))
    for name, changing in (("datetime", ("now", "utcnow", "today")), ("date", ("today",))):
        methods = {one: staticmethod(_changing(f"{name}.{one}")) for one in changing}
        dates.__dict__[name] = type(name, (getattr(datetime, name),), methods)
    sys.modules |= {"time": clock, "datetime": dates}


def _changing(name: str, own: Callable[..., Any] | None = None) -> Callable[..., Any]:
    """Return a function that gives nothing known to a launch file, and what it gave before to Python's own modules."""

    def do(*args: Any, **words: Any) -> Any:
        if own is not None and sys._getframe(1).f_code.co_filename not in OWN:
            return own(*args, **words)
        return Unknown(CHANGES.format(name))

    return do


class Finder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Finds modules of packages that are here, by their own name or beside launch files, and makes stand-ins for others."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: types.ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        """Return a module's file, or a stand-in."""
        top, last = fullname.partition(".")[0], fullname.rpartition(".")[2]
        if top in sys.stdlib_module_names or top in BY_ITSELF:
            return None
        for folder in self._folders(top, path):
            for tail, is_package in ((f"{last}/__init__.py", True), (f"{last}.py", False)):
                name = f"{folder}/{tail}"
                at = real(name)[0]
                if at and os.path.isfile(at) and at.endswith(f"/{tail}"):
                    spec = importlib.machinery.ModuleSpec(fullname, self, origin=name, is_package=is_package)
                    spec.loader_state = at
                    if is_package:
                        spec.submodule_search_locations = [os.path.dirname(name)]
                    return spec
        return importlib.machinery.ModuleSpec(fullname, self, is_package=True)

    def _folders(self, top: str, path: Sequence[str] | None) -> list[str]:
        if path:
            return list(path)
        found = [one for one in sys.path if PATH[0].match(one)]
        found += [os.path.dirname(name) for name in list(OWN)[-1:]]
        if folder_of(top) is not None:
            found += [share(top), f"{share(top)}/src"]
        return found + [share(one) for one, at in list(FOLDERS.items()) if one != top and os.path.isdir(f"{at}/{top}")]

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> types.ModuleType | None:
        """Return a stand-in where the module is not here."""
        return None if spec.loader_state else Module(spec.name)

    def exec_module(self, module: types.ModuleType) -> None:
        """Run a module that is here as the launch file runs."""
        assert module.__spec__ is not None
        at, name = module.__spec__.loader_state, module.__spec__.origin
        if not at or name is None:
            library = module.__name__.partition(".")[0]
            module.__dict__.update(NAMES.get(library, {}), __path__=[])  # a module of one class
            return
        module.__file__, OWN[name] = name, at
        with open(at, encoding="utf-8") as file:
            guard.run(file.read(), name, module.__dict__)
