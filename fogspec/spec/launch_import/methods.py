"""Methods of texts, lists, dictionaries and paths, as Python launch files call them."""

from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Any

from fogspec.spec.launch_import.found import Made, Place, Unknown
from fogspec.spec.launch_import.program import MOST_ITEMS, wide

if TYPE_CHECKING:
    from fogspec.spec.launch_import.interpreter import Interpreter

TEXT_METHODS = {
    "format", "join", "split", "strip", "lstrip", "rstrip", "lower", "upper", "replace", "startswith", "endswith", "title",
    "capitalize", "splitlines", "isdigit", "find", "count", "rsplit", "partition", "rpartition", "encode", "index",
    "removeprefix", "removesuffix", "isspace", "isalpha", "as_posix", "joinpath", "with_suffix", "with_name",
}  # fmt: skip
LIST_METHODS = {"append", "extend", "insert", "copy", "pop", "index", "count", "reverse", "remove", "clear"}
DICT_METHODS = {"get", "items", "keys", "values", "update", "copy", "pop", "setdefault", "clear"}


def method(of: Any, name: str, args: list[Any], words: dict[str, Any], place: Place, at: "Interpreter") -> Any:
    """Return what a method of a text, list, dictionary or path returns."""
    if isinstance(of, (str, PurePosixPath)):
        unknown = next((one for one in args if isinstance(one, Unknown)), None)
        return unknown or _of_text(of, name, args, words, place, at)
    if isinstance(of, (list, tuple)):
        return _of_list(of, name, args, place, at)
    if isinstance(of, dict) and name in DICT_METHODS:
        if name == "update" and args and isinstance(args[0], Unknown):
            at.found.note(args[0].place, f"not taken over: {args[0].why}")
            return None
        value = getattr(of, name)(*args, **(words if name == "update" else {}))
        return list(value) if name in ("items", "keys", "values") else value
    return Unknown(place, f"{name} is not read")


def _of_text(
    of: str | PurePosixPath, name: str, args: list[Any], words: dict[str, Any], place: Place, at: "Interpreter"
) -> Any:
    if isinstance(of, PurePosixPath) and name in ("resolve", "absolute", "expanduser"):
        return of
    if isinstance(of, PurePosixPath) and name in ("exists", "is_file", "is_dir", "read_text", "open"):
        return at.call_other(at, f"path.{name}", [of, *args], words, place)
    if name not in TEXT_METHODS:
        return Unknown(place, f"{name} is not read")
    if name == "format" and wide(str(of)):
        return Unknown(place, "its format is not read")
    known = (str, int, float, PurePosixPath)
    if name == "format" and any(not isinstance(one, known) for one in [*args, *words.values()]):
        return Unknown(place, "only a launch determines a part of this text")
    if name == "replace" and len(args) > 1 and str(of).count(str(args[0])) * len(str(args[1])) > MOST_ITEMS:
        return Unknown(place, "it is too large")
    if name == "join" and args and (unknown := next((one for one in args[0] if isinstance(one, Unknown)), None)):
        return unknown
    value = getattr(of, name)(*args, **words)
    at.found.spend(len(value) if isinstance(value, str) else 0)
    return value


def _of_list(of: list[Any] | tuple[Any, ...], name: str, args: list[Any], place: Place, at: "Interpreter") -> Any:
    if name not in (LIST_METHODS if isinstance(of, list) else ("index", "count")):
        return Unknown(place, f"{name} is not read")
    at.found.spend(len(of))
    if isinstance(of, list) and name == "extend" and args and isinstance(args[0], (Unknown, Made)):
        of.append(args[0])
        return None
    return getattr(of, name)(*args)
