"""Parameters with the types that launch_ros gives them, and the parameter files that launch would write."""

import os
import re
from collections.abc import Iterator
from functools import lru_cache, partial
from typing import Any

import yaml

from fogspec.importers.launch.found import WRITTEN
from fogspec.importers.launch.sandboxed.context import CONTEXT, FOUND, perform, said, truth
from fogspec.importers.launch.sandboxed.made import Made, applies, make, where
from fogspec.importers.launch.sandboxed.paths import FREE, content, opened, share, spelled
from fogspec.importers.launch.sandboxed.substitutions import Substitution, substitution
from fogspec.importers.launch.sandboxed.values import (
    CURRENT,
    Place,
    Refused,
    Stop,
    Unknown,
    attempt,
    marked,
    note,
    plain,
    unknown,
    why,
)

SCALARS = (bool, int, float, str)
TEMPORARY = re.compile(r"tmp[a-z0-9_]{8}|launch_params_\w+")
DEEPEST = 50
Pairs = tuple[tuple[str, str], ...]
KEPT = re.compile(r"\$\((find-pkg-share|find-pkg-prefix|env|command) ")

Parameter = make("launch_ros", "Parameter", "name", "value", "value_type")
ParameterValue = make("launch_ros", "ParameterValue", "value", "value_type")
ParameterValue.perform = lambda self, context: perform(self.value)


def value_of(value: Any) -> Any:
    """Return a parameter's value: substituted text is read as YAML unless it has a type; raise Refused."""
    if isinstance(value, Unknown):
        raise Refused(value._why, value._place)
    if isinstance(value, ParameterValue):
        return _with_type(value.value, value.given.get("value_type"))
    if hasattr(value, "perform"):
        return _yaml(value)
    if isinstance(value, str):
        return spelled(value)
    if isinstance(value, (bool, int, float)):
        return value
    if isinstance(value, (list, tuple)):
        return _list(list(value))
    if isinstance(value, os.PathLike):
        raise Refused("launch_ros refuses a path as a parameter: it must be a text")
    raise Refused("launch_ros refuses a value of this type")


def _with_type(value: Any, kind: Any) -> Any:
    if isinstance(value, Unknown):
        raise Refused(value._why, value._place)
    if kind is None:
        mixed = isinstance(value, list) and any(hasattr(one, "perform") for one in value)
        return _yaml(value) if mixed or isinstance(value, str) or hasattr(value, "perform") else value_of(value)
    inner = getattr(kind, "__args__", (None,))[0]
    if inner is not None:
        listed = isinstance(value, (list, tuple)) and not any(hasattr(one, "perform") for one in value)
        some = value if listed else _yaml(value)
        return [_converted(one, inner) for one in (some if isinstance(some, (list, tuple)) else [some])]
    if isinstance(value, (bool, int, float)):
        return _converted(value, kind)
    return said(value) if kind is str else _converted(read(perform(value)), kind)


def _converted(value: Any, kind: Any) -> Any:
    if kind is float and type(value) is int:
        return float(value)
    if kind is str and isinstance(value, SCALARS):
        return str(value)
    if type(value) is not kind:
        raise Refused(f"launch_ros refuses this value as {getattr(kind, '__name__', kind)}")
    return value


def _list(items: list[Any]) -> Any:
    if not items:
        raise Refused("launch_ros refuses an empty list")
    for one in items:
        if isinstance(one, Unknown):
            raise Refused(one._why, one._place)
    kinds = {Substitution if hasattr(one, "perform") else str if isinstance(one, str) else type(one) for one in items}
    if kinds <= {int, float} or kinds == {bool}:
        return [float(one) for one in items] if float in kinds else items
    if Substitution in kinds and kinds <= {str, Substitution}:
        return _yaml(items)
    found = [_item(one) for one in items]
    if len({type(one) for one in found}) > 1 or not isinstance(found[0], SCALARS):
        raise Refused("launch_ros refuses a list of values of several types")
    return found


def _item(one: Any) -> Any:
    if isinstance(one, str):
        return spelled(one)
    return _yaml(one) if hasattr(one, "__iter__") or hasattr(one, "perform") else one


def _yaml(value: Any) -> Any:
    return read(perform(value))


def read(text: str) -> Any:
    """Return the value that launch_ros reads of a text in YAML 1.1; raise Refused."""
    done = spelled(text)
    if done.startswith(("$(command ", "$(env ")):
        return done
    try:
        value = yaml.safe_load(plain(text) if not marked(text) else done) if text else ""
    except (yaml.YAMLError, ValueError, RecursionError):
        raise Refused(f"launch_ros refuses '{done[:60]}': it is not YAML") from None
    if isinstance(value, list):
        if not value or len({type(one) for one in value}) > 1 or not isinstance(value[0], SCALARS):
            raise Refused(f"launch_ros refuses '{done[:60]}': a list must have values of one type")
        return [spelled(one) if isinstance(one, str) else one for one in value]
    if not isinstance(value, SCALARS):
        raise Refused(f"launch_ros refuses '{done[:60]}' as a value")
    return spelled(value) if isinstance(value, str) else value


def flat(values: dict[Any, Any], place: Place, before: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the full name and the raw value of each parameter of a dictionary."""
    for key, value in values.items():
        name = attempt(partial(said, key), "a parameter is", place)
        if name is not None and isinstance(value, dict):
            yield from flat(value, place, f"{before}{name}.")
        elif name is not None:
            yield f"{before}{name}", value


def taken(values: dict[Any, Any], place: Place) -> dict[str, Any]:
    """Return a dictionary's parameters with their values; note those that are not taken over."""
    found = {}
    for name, value in flat(values, place):
        what = f"the parameter {name} is"
        done = attempt(partial(_listed, value), what, where(value) or place)
        if done is not None:
            found[name] = done[0]
    return found


def _listed(value: Any) -> list[Any]:
    return [value_of(value)]


def _file(value: Any) -> str:
    return file_of(perform(value))


def sequence(items: Any, place: Place, pushed: bool = True) -> list[Any]:
    """Return launch_ros' `parameters` in their order: paths of files, and dictionaries of values."""
    found = list(CONTEXT.launch_configurations.get("global_params", [])) if pushed else []
    if isinstance(items, Unknown):
        note(items._place, f"parameters are not taken over: {items._why}")
        return found
    for one in items if isinstance(items, (list, tuple)) else [] if items is None else [items]:
        if isinstance(one, Parameter):
            kind = one.value_type
            one = {one.name: ParameterValue(one.value, value_type=kind) if kind else one.value}
        if isinstance(one, dict):
            found.append(taken(one, place))
        elif isinstance(one, Unknown):
            note(one._place, f"parameters are not taken over: {one._why}")
        else:
            path = attempt(partial(_file, one), "a parameter file is", where(one) or place)
            found += [path] if path else []
    return found


def file_of(path: str) -> str:
    """Return a parameter file as a spec names it: one that is written, or is in no package, is kept beside the spec."""
    is_written = not marked(path) and path.startswith(FREE[-1])
    done = plain(path) if is_written else spelled(path)
    if done.startswith((WRITTEN, "$(find-pkg")) or not done.startswith(("/", "$", "~")):
        return done
    try:
        text = content(opened(path))
    except Refused:
        raise Refused(f"{os.path.basename(done)} is not in a package, and not here") from None
    name = os.path.basename(done)
    return written("launch.yaml" if TEMPORARY.match(name) else name, spelled(text))


def written(name: str, text: str) -> str:
    """Keep a file that launch would write, and return its path."""
    stem, dot, suffix = os.path.basename(name).rpartition(".")
    stem, suffix = (stem, f".{suffix}") if dot else (suffix, ".yaml")
    name, number = f"{stem}{suffix}", 1
    while FOUND.files.setdefault(name, text) != text:
        number += 1
        name = f"{stem}_{number}{suffix}"
    return f"{WRITTEN}{name}"


def text_of(path: str) -> str:
    """Return the text of a file, also of one that launch would write; raise Refused if it is not here."""
    if path.startswith(WRITTEN):
        return FOUND.files[path.removeprefix(WRITTEN)]
    if path.startswith("$(find-pkg-share "):
        name, _, below = path.removeprefix("$(find-pkg-share ").partition(")")
        path = f"{share(name)}{below}"
    return content(path if path.startswith("/") else os.path.join(os.path.dirname(CURRENT[0]), path))


def divided(some: list[Any], full_name: str, place: Place) -> dict[str, Any]:
    """Return a node's parameter files and values, in which later ones replace earlier ones."""
    files: list[str] = []
    values: dict[str, Any] = {}
    for one in some:
        if isinstance(one, dict):
            values |= one
            continue
        names = _set_by(one, full_name) if values else set()
        if names is None:
            note(
                place,
                f"{os.path.basename(one)} is given after parameters that it may set as well; the spec sets them after it",
            )
        for name in names or ():
            values.pop(name, None)
        files.append(one)
    substituted = any(one.startswith(WRITTEN) and KEPT.search(text_of(one)) for one in files)
    return {"parameters": values, "parameter_files": files, "allow_substs": bool(substituted)}


def applies_to(section: str, node: str) -> bool:
    """Whether a section of a parameter file is for the node with this full name."""
    words, own = section.strip("/").split("/"), node.strip("/").split("/")
    if words[0] == "**":
        return len(words) == 1 or words[1:] == own[-len(words[1:]) :]
    return len(words) == len(own) and all(one in ("*", other) for one, other in zip(words, own, strict=True))


def _set_by(path: str, node: str) -> set[str] | None:
    """Return the parameters that a file sets for a node; None if that is not known."""
    names: set[str] = set()

    def walk(value: Any, section: str, inside: bool, prefix: str) -> None:
        for key, below in value.items() if isinstance(value, dict) else ():
            if inside:
                names.add(f"{prefix}{key}")
                walk(below, section, True, f"{prefix}{key}.")
            elif key == "ros__parameters":
                walk(below, section, applies_to(section, node), "")
            else:
                walk(below, f"{section}/{key}".replace("//", "/"), False, "")

    try:
        walk(_loaded(text_of(path)), "", False, "")
    except (Refused, yaml.YAMLError, ValueError):
        return None
    return names


@substitution("ParameterFile", "param_file", "allow_substs", library="launch_ros")
def ParameterFile(self: Made) -> str:
    """Perform a parameter file's path; one in which launch substitutes is written as it would be."""
    path, allowed = perform(self.param_file), self.word("allow_substs", False)
    if marked(path) or not (allowed if isinstance(allowed, bool) else truth(allowed)):
        return path
    from fogspec.importers.launch.sandboxed.text import parsed

    return _made_of(self, path, lambda text: perform(parsed(text, self.place)) if "$(" in text else None)


ParameterFile.evaluate = ParameterFile.perform


def _made_of(self: Made, path: str, change: Any) -> str:
    """Return the path of a file that launch makes of another: what changes it returns None where it does not."""
    try:
        text = change(text_of(opened(path)))
        return path if text is None else written(os.path.basename(path), spelled(text))
    except Refused as refused:
        return unknown(refused.why, refused.place or self.place)
    except (yaml.YAMLError, RecursionError):
        return unknown(f"{os.path.basename(path)} cannot be read as YAML", self.place)


def _typed(text: str, convert: bool) -> Any:
    if convert:
        try:
            return float(text) if "." in text else int(text)
        except ValueError:
            pass
    return text.lower() == "true" if text.lower() in ("true", "false") else text


@substitution(
    "RewrittenYaml", "source_file", "param_rewrites", "root_key", "key_rewrites", "value_rewrites", "convert_types",
    library="nav2_common",
)  # fmt: skip
def _rewritten(self: Made) -> str:
    names = ("param_rewrites", "key_rewrites", "value_rewrites")
    values, keys, texts = ({key: perform(one) for key, one in self.word(name, {}).items()} for name in names)
    for one in (*values.values(), *keys.values(), *texts.values()):
        if marked(one):
            return unknown(why(one), self.place)
    convert, root, path = (
        self.word("convert_types", False) is True, perform(self.word("root_key", "")), perform(self.source_file),
    )  # fmt: skip
    some = [tuple(one.items()) for one in (values, keys, texts)]
    head = f"# {os.path.basename(path)} with the values that launch sets\n"
    return _made_of(self, path, lambda text: head + _changed(text, *some, convert, root))


@lru_cache
def _changed(text: str, values: Pairs, keys: Pairs, texts: Pairs, convert: bool, root: str) -> str:
    """Return a parameter file's text with values and keys replaced; each node of a launch file may rewrite the same one."""
    data = _loaded(text)
    if not isinstance(data, dict):
        raise Refused("the file that launch rewrites holds no parameters")
    data = _walked(data, "", dict(values), dict(keys), dict(texts), convert)
    for path, one in values:
        if "ros__parameters" in path.split("."):
            _set(data, path.split("."), _typed(one, convert))
    done: str = yaml.safe_dump({root: data} if root else data, sort_keys=False, width=1000, allow_unicode=True)
    return done


_loaded = lru_cache(yaml.safe_load)


def _walked(
    value: Any, at: str, values: dict[str, str], keys: dict[str, str], texts: dict[str, str], convert: bool
) -> Any:
    """Return parameters with values replaced by key or whole path, keys renamed, and values replaced by their text."""
    if isinstance(value, list):
        return [_walked(one, f"{at}.{i}", values, keys, texts, convert) for i, one in enumerate(value)]
    if not isinstance(value, dict):
        return _typed(texts[str(value)], convert) if str(value) in texts else value
    found = {}
    for key, below in value.items():
        deep = f"{at}.{key}" if at else str(key)
        new = values.get(str(key), values.get(deep))
        changed = _walked(below, deep, values, keys, texts, convert) if new is None else _typed(new, convert)
        found[keys.get(str(key)) or key] = changed
    return found


def _set(data: Any, names: list[str], value: Any) -> None:
    """Set a value that may be below maps that are not there yet."""
    for name in names[:-1]:
        data = data.setdefault(name, {})
        if not isinstance(data, dict):
            return
    data[names[-1]] = value


@substitution("ReplaceString", "source_file", "replacements", "condition", library="nav2_common")
def _replaced(self: Made) -> str:
    path = perform(self.source_file)
    if not applies(self):
        return path

    def change(text: str) -> str:
        for key, value in self.word("replacements", {}).items():
            text = text.replace(str(key), plain(perform(value)))
        return text

    return _made_of(self, path, change)


@substitution("HasNodeParams", "source_file", "node_name", library="nav2_common")
def _has_parameters(self: Made) -> str:
    try:
        data = _loaded(text_of(opened(perform(self.source_file))))
        return str(isinstance(data, dict) and perform(self.node_name) in data)
    except Refused as refused:
        raise Stop(refused.why, refused.place or self.place) from None
