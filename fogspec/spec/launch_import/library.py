"""Functions that Python launch files call and that are not their own: what each returns, without doing it."""

import json
import os.path
from collections.abc import Callable
from pathlib import PurePosixPath
from typing import Any

from fogspec.base.yaml.reader11 import NotYaml, read11
from fogspec.spec.launch_import.found import SHARE, Made, Place, Unknown
from fogspec.spec.launch_import.interpreter import Interpreter
from fogspec.spec.launch_import.program import MOST_ITEMS, Function, Named, Raised
from fogspec.spec.launch_import.substitutions import Context

TYPES: dict[str, type] = {
    "str": str,
    "int": int,
    "float": float,
    "bool": bool,
    "list": list,
    "dict": dict,
    "tuple": tuple,
}
BUILDERS = {"MoveItConfigsBuilder": 1, "ParameterBuilder": 0}  # the place of the package among their arguments
QUIET = ("print", "logging", "sys", "warnings", "super", "lifecycle")
Args = list[Any]
Do = Callable[["Library", Interpreter, Args, dict[str, Any], Place], Any]


class Library:
    """What a launch file's calls of other modules return, over one context."""

    def __init__(self, context: Context) -> None:
        self.context = context

    def __call__(self, at: Interpreter, name: str, args: Args, words: dict[str, Any], place: Place) -> Any:
        """Return what the function of this dotted name returns."""
        if args and isinstance(args[0], Made) and args[0].kind in BUILDERS:
            return _built(args[0])
        do = CALLS.get(name) or CALLS.get(name.removeprefix("builtins.")) or CALLS.get(f"*.{name.rpartition('.')[2]}")
        if do is None:
            what = name.removeprefix("builtins.").lstrip(".")
            return Unknown(place, f"only a launch determines what {what}() returns")
        for one in [*args, *words.values()]:
            if isinstance(one, Unknown) and name not in TAKES_UNKNOWN:
                return one
        return do(self, at, args, words, place)

    def text(self, value: Any, place: Place) -> str:
        """Return a text or path, or raise TypeError."""
        if not isinstance(value, (str, PurePosixPath)):
            raise TypeError("it is not a string")
        return str(value)

    def environment(self, name: Any, default: Any, place: Place) -> Any:
        """Return an environment variable that the launch file set, or the default."""
        value = self.context.environment.get(str(name))
        if isinstance(value, (str, Unknown)):
            return value
        if default is not None:
            self.context.found.defaults.setdefault(f"${name}", str(default))
        return default

    def file(self, path: Any, place: Place) -> Any:
        """Return an open file, if it is here."""
        text = self.context.read(str(path))
        return Unknown(place, f"{path} is not here") if text is None else Made("file", [text], {}, place)

    def exists(self, path: Any, place: Place) -> Any:
        """Return whether a file or folder of a package that is here is there."""
        text = str(path)
        match = SHARE.match(text)
        if match is None and not text.startswith("@"):
            return Unknown(place, f"only the machine can tell whether {text[:80]} is there")
        folder = self.context.packages.share(match[1]) if match else None
        if match is not None and folder is None:
            return Unknown(place, f"{match[1]} is not here, so neither is what it has")
        if self.context.read(text) is not None:
            return True
        return folder is not None and match is not None and (folder / text[match.end() :].lstrip("/")).exists()


def _built(made: Made) -> Unknown:
    """Return what a builder of parameters makes: a package's files, which it reads while it launches."""
    package = made.word("package_name", BUILDERS[made.kind])
    if package is None and isinstance(robot := made.word("robot_name", 0), str):
        package = f"{robot}_moveit_config"
    of = f"the package {package}" if isinstance(package, str) else "a package"
    why = f"{made.kind} reads them from {of} while it launches; 'cmd: [ros2, launch, ...]' of this file keeps them"
    return Unknown(made.place, why)


def _path(function: Callable[..., Any]) -> Do:
    def do(library: Library, at: Interpreter, args: Args, words: dict[str, Any], place: Place) -> Any:
        return function(*(library.text(one, place) for one in args))

    return do


def _type(kind: type) -> Do:
    def do(library: Library, at: Interpreter, args: Args, words: dict[str, Any], place: Place) -> Any:
        if args and isinstance(args[0], (Made, Named, Function)):
            return Unknown(place, "only a launch determines this value")
        if kind is list or kind is tuple:
            return kind(args[0]) if args else kind()
        if kind is dict:
            return dict(*args, **words)
        if kind is str and args and isinstance(args[0], (list, dict)) and any(isinstance(one, Made) for one in args[0]):
            return Unknown(place, "only a launch determines this value")
        if kind is int and args and isinstance(args[0], str) and len(args[0]) > 1000:
            return Unknown(place, "it is too large")
        return kind(*args)

    return do


def _plain(function: Callable[..., Any]) -> Do:
    def do(library: Library, at: Interpreter, args: Args, words: dict[str, Any], place: Place) -> Any:
        if any(isinstance(one, (Made, Named, Function)) for one in args):
            return Unknown(place, "only a launch determines this value")
        at.found.spend(sum(len(one) for one in args if hasattr(one, "__len__")))
        value = function(*args)
        return list(value) if not isinstance(value, (str, int, float, bool)) and hasattr(value, "__iter__") else value

    return do


def _range(library: Library, at: Interpreter, args: Args, words: dict[str, Any], place: Place) -> Any:
    numbers = range(*args)
    return list(numbers) if len(numbers) <= MOST_ITEMS else Unknown(place, "it is too large")


def _map(library: Library, at: Interpreter, args: Args, words: dict[str, Any], place: Place) -> Any:
    return [at.call(args[0], [one], {}, place) for one in list(args[1])]


def _share(library: Library, at: Interpreter, args: Args, words: dict[str, Any], place: Place) -> Any:
    return f"$(find-pkg-share {library.text(args[0] if args else words['package_name'], place)})"


def _prefix(library: Library, at: Interpreter, args: Args, words: dict[str, Any], place: Place) -> Any:
    return f"$(find-pkg-prefix {library.text(args[0] if args else words['package_name'], place)})"


def _load(parse: Callable[[str], Any]) -> Do:
    def do(library: Library, at: Interpreter, args: Args, words: dict[str, Any], place: Place) -> Any:
        value = args[0] if args else None
        text = value.args[0] if isinstance(value, Made) and value.kind == "file" else value
        if not isinstance(text, str):
            return Unknown(place, "only a launch determines this value")
        try:
            return parse(text)
        except (NotYaml, ValueError, RecursionError):
            return Unknown(place, "the file cannot be parsed")

    return do


def _xacro(library: Library, at: Interpreter, args: Args, words: dict[str, Any], place: Place) -> Any:
    mappings = words.get("mappings", args[1] if len(args) > 1 else None) or {}
    path = library.text(args[0] if args else words.get("input_file_name"), place)
    if not isinstance(mappings, dict) or any(isinstance(one, (Made, Unknown)) for one in mappings.values()):
        return Unknown(place, "only a launch determines what xacro is given")
    given = "".join(f" {key}:={value}" for key, value in mappings.items())
    return Made("xacro", [f"$(command 'xacro {path}{given}')"], {}, place)


def _perform(library: Library, at: Interpreter, args: Args, words: dict[str, Any], place: Place) -> Any:
    return library.context.perform(args[0], place)


def _performed(library: Library, at: Interpreter, args: Args, words: dict[str, Any], place: Place) -> Any:
    return library.context.perform(args[1], place)


def _evaluate(library: Library, at: Interpreter, args: Args, words: dict[str, Any], place: Place) -> Any:
    made = args[0]
    if made.kind not in ("IfCondition", "UnlessCondition"):
        return _perform(library, at, args, words, place)
    value = library.context.truth(made.word("predicate_expression", 0), place)
    return value if isinstance(value, Unknown) or made.kind == "IfCondition" else not value


def _add(library: Library, at: Interpreter, args: Args, words: dict[str, Any], place: Place) -> Any:
    made, items = args[0], [*args[1:], *words.values()]
    if made.kind == "LaunchContext":
        return None
    made.words.setdefault("_added", []).extend(items)
    return None


def _configuration(library: Library, at: Interpreter, args: Args, words: dict[str, Any], place: Place) -> Any:
    of, key = args[0], args[1]
    if of.kind != "LaunchContext":
        default = args[2] if len(args) > 2 else None
        return (
            library.environment(key, default, place)
            if of.kind == "environ"
            else Unknown(place, f"{of.kind} is not read")
        )
    if key in library.context.configurations:
        return library.context.configurations[key]
    return args[2] if len(args) > 2 else None


def _context_get(library: Library, at: Interpreter, args: Args, words: dict[str, Any], place: Place) -> Any:
    if args[1] not in library.context.configurations:
        raise Raised(place, f"there is no launch configuration {args[1]}")
    return library.context.configurations[args[1]]


def _context_set(library: Library, at: Interpreter, args: Args, words: dict[str, Any], place: Place) -> Any:
    library.context.configurations[str(args[1])] = args[2] if isinstance(args[2], (str, Unknown)) else str(args[2])


def _environ_get(library: Library, at: Interpreter, args: Args, words: dict[str, Any], place: Place) -> Any:
    value = library.environment(args[1], None, place)
    return f"$(env {args[1]})" if value is None else value


def _environ_set(library: Library, at: Interpreter, args: Args, words: dict[str, Any], place: Place) -> Any:
    library.context.environment[str(args[0])] = args[1] if isinstance(args[1], (str, Unknown)) else str(args[1])


def _getenv(library: Library, at: Interpreter, args: Args, words: dict[str, Any], place: Place) -> Any:
    return library.environment(args[0], args[1] if len(args) > 1 else words.get("default"), place)


def _docker(library: Library, at: Interpreter, args: Args, words: dict[str, Any], place: Place) -> Any:
    args[0].words.setdefault("_dockers", []).append(Made("docker", args[1:], words, place))


def _items(library: Library, at: Interpreter, args: Args, words: dict[str, Any], place: Place) -> Any:
    if args[0].kind == "LaunchContext":
        some = {key: one for key, one in library.context.configurations.items() if isinstance(one, str)}
        return list(some.items())
    if args[0].kind == "dict_items":
        return args[0].args[0]
    return Unknown(place, "only a launch determines this value")


def _isinstance(library: Library, at: Interpreter, args: Args, words: dict[str, Any], place: Place) -> Any:
    kind = TYPES.get(args[1].last) if isinstance(args[1], Named) else None
    return Unknown(place, "this type is not read") if kind is None else isinstance(args[0], kind)


def _typing(library: Library, at: Interpreter, args: Args, words: dict[str, Any], place: Place) -> Any:
    return Named(f"list.{args[1].last}") if isinstance(args[1], Named) else Unknown(place, "this type is not read")


def _first(library: Library, at: Interpreter, args: Args, words: dict[str, Any], place: Place) -> Any:
    return args[0].args[0] if args[0].kind in ("file", "xacro") else Unknown(place, f"{args[0].kind} is not read")


PLAIN: dict[str, Callable[..., Any]] = {
    "len": len, "sorted": sorted, "min": min, "max": max, "sum": sum, "abs": abs, "round": round, "any": any, "all": all,
    "enumerate": enumerate, "zip": zip, "set": lambda *some: sorted(set(*some), key=repr), "reversed": reversed,
}  # fmt: skip
CALLS: dict[str, Do] = {
    **{name: _type(kind) for name, kind in TYPES.items()},
    **{name: _plain(function) for name, function in PLAIN.items()},
    "range": _range,
    "map": _map,
    "open": lambda library, at, args, words, place: library.file(args[0], place),
    "isinstance": _isinstance,
    "print": lambda library, at, args, words, place: None,
    "*.get_package_share_directory": _share,
    "*.get_package_share_path": lambda *given: PurePosixPath(_share(*given)),
    "*.get_package_prefix": _prefix,
    "os.path.join": _path(os.path.join),
    "os.path.dirname": _path(os.path.dirname),
    "os.path.basename": _path(os.path.basename),
    "os.path.splitext": _path(os.path.splitext),
    "os.path.split": _path(os.path.split),
    "os.path.normpath": _path(os.path.normpath),
    "os.path.abspath": _path(os.path.normpath),
    "os.path.realpath": _path(os.path.normpath),
    "os.path.isabs": _path(os.path.isabs),
    "os.path.expanduser": _path(lambda text: f"$(env HOME){text[1:]}" if text == "~" or text.startswith("~/") else text),
    "os.path.exists": lambda library, at, args, words, place: library.exists(args[0], place),
    "os.path.isfile": lambda library, at, args, words, place: library.exists(args[0], place),
    "os.path.isdir": lambda library, at, args, words, place: library.exists(args[0], place),
    "path.exists": lambda library, at, args, words, place: library.exists(args[0], place),
    "path.is_file": lambda library, at, args, words, place: library.exists(args[0], place),
    "path.is_dir": lambda library, at, args, words, place: library.exists(args[0], place),
    "path.read_text": lambda library, at, args, words, place: getattr(library.file(args[0], place), "args", [None])[0]
    or library.file(args[0], place),
    "path.open": lambda library, at, args, words, place: library.file(args[0], place),
    "os.getenv": _getenv,
    "os.environ.set": _environ_set,
    "environ.get": _environ_get,
    ".get": _configuration,
    "LaunchContext.get": _context_get,
    "LaunchContext.set": _context_set,
    "*.Path": lambda library, at, args, words, place: PurePosixPath(*(library.text(one, place) for one in args)),
    "*.PurePath": lambda library, at, args, words, place: PurePosixPath(*(library.text(one, place) for one in args)),
    "yaml.safe_load": _load(read11),
    "yaml.load": _load(read11),
    "yaml.full_load": _load(read11),
    "json.load": _load(json.loads),
    "json.loads": _load(json.loads),
    "xacro.process_file": _xacro,
    "xacro.process": lambda *given: getattr(_xacro(*given), "args", [None])[0],
    ".toxml": _first,
    ".toprettyxml": _first,
    ".read": _first,
    ".close": lambda library, at, args, words, place: None,
    ".perform": _perform,
    ".perform_substitution": _performed,
    "*.perform_substitutions": _performed,
    ".evaluate": _evaluate,
    ".items": _items,
    ".add_action": _add,
    ".add_entity": _add,
    ".add_docker_container": _docker,
    "typing.List.get": _typing,
    "builtins.list.get": _typing,
}  # fmt: skip
TAKES_UNKNOWN = {
    ".add_action", ".add_entity", "builtins.print", "builtins.isinstance", "builtins.dict", "builtins.list", "builtins.len",
    "builtins.enumerate", "builtins.zip",
}  # fmt: skip
