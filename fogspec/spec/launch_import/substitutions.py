"""Substitutions performed as `launch` does, over what is known without launching.

What only the machine can tell stays as launch's own substitution in the text: `$(find-pkg-share P)`, `$(find-pkg-prefix P)`,
`$(env X)`, `$(command '…')`.
"""

import ast
import math
import os.path
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from fogspec.base.files import read_bounded
from fogspec.base.yaml.reader11 import NotYaml, read11, read11_text
from fogspec.base.yaml.writer import yaml_text
from fogspec.spec.launch_import.found import DEEPEST, MOST_DATA_BYTES, LaunchImport, Made, Place, Unknown
from fogspec.spec.launch_import.packages import Packages

KEPT = re.compile(r"\$\((find-pkg-share|find-pkg-prefix|env|command) ")
OF_TEXT = 20  # what performing a substitution counts as, in characters handled
WRITTEN = "@files/"  # where a file that launch would write is put, in front of its name


@dataclass
class Context:
    """What `launch` calls its context: launch configurations and environment, and what was pushed."""

    found: LaunchImport
    packages: Packages
    file: str
    evaluate: Callable[[str, Place], Any]
    configurations: dict[str, Any] = field(default_factory=dict)
    environment: dict[str, Any] = field(default_factory=dict)
    substituted: set[str] = field(default_factory=set)
    parsed: dict[str, Any] = field(default_factory=dict)
    pushed: list[tuple[dict[str, Any], dict[str, Any]]] = field(default_factory=list)
    depth: int = 0

    def push(self, forwarding: bool = True) -> None:
        """Begin a scope."""
        self.pushed.append((self.configurations, self.environment))
        self.configurations, self.environment = (
            {key: list(one) if isinstance(one, list) else one for key, one in self.configurations.items()},
            dict(self.environment),
        )
        if not forwarding:
            self.configurations, self.environment = {}, {}

    def pop(self) -> None:
        """End the last scope."""
        if self.pushed:
            self.configurations, self.environment = self.pushed.pop()

    def perform(self, value: Any, place: Place) -> str | Unknown:
        """Return the text of a substitution, or of a list of them."""
        self.depth += 1
        try:
            if self.depth > DEEPEST:
                return Unknown(place, "it is nested too deep")
            text = self._perform(value, place)
            self.found.spend(OF_TEXT + len(text) if isinstance(text, str) else OF_TEXT)
            return text
        finally:
            self.depth -= 1

    def _perform(self, value: Any, place: Place) -> str | Unknown:
        if isinstance(value, (str, PurePosixPath)):
            return str(value)
        if isinstance(value, Unknown):
            return value
        if isinstance(value, (list, tuple)):
            text = ""
            for one in value:
                part = self.perform(one, place)
                if isinstance(part, Unknown):
                    return part
                text += part
            return text
        if isinstance(value, Made):
            do = SUBSTITUTIONS.get(value.kind)
            if do is None:
                return Unknown(value.place, f"only a launch determines {value.kind}")
            return do(self, value)
        if isinstance(value, (bool, int, float)):
            return str(value)
        return Unknown(place, "it is not a string")

    def truth(self, value: Any, place: Place) -> bool | Unknown:
        """Return a condition's value as launch reads it: true, 1, false or 0."""
        text = self.perform(str(value) if isinstance(value, bool) else value, place)
        if isinstance(text, Unknown):
            return text
        word = text.strip().lower()
        if word in ("true", "1"):
            return True
        if word in ("false", "0"):
            return False
        return Unknown(place, f"'{text[:60]}' is not a condition: launch refuses it")

    def read(self, path: str) -> str | None:
        """Return the text of a file that a package or this machine has; None if it is not here."""
        if path.startswith(WRITTEN):
            return self.found.files.get(path.removeprefix(WRITTEN))
        file = self.packages.file(path)
        if file is None and path and not path.startswith(("/", "$")):
            file = Path(self.file).parent / path
        try:
            content = read_bounded(file, MOST_DATA_BYTES) if file is not None else None
        except (OSError, ValueError):
            return None
        self.found.spend(len(content or b""))
        return None if content is None else content.decode("utf-8", "replace")

    def written(self, name: str, text: str) -> str:
        """Keep a file that launch would write, and return its path."""
        stem, dot, suffix = PurePosixPath(name).name.rpartition(".")
        stem, suffix = (stem, f".{suffix}") if dot else (suffix, ".yaml")
        name, number = f"{stem}{suffix}", 1
        while self.found.files.get(name, text) != text:
            number += 1
            name = f"{stem}_{number}{suffix}"
        self.found.files[name] = text
        return f"{WRITTEN}{name}"

    def data(self, text: str) -> Any:
        """Return the content of a YAML file, which is parsed once; raise NotYaml."""
        if text not in self.parsed:
            self.found.spend(20 * len(text))
            self.parsed[text] = read11(text)
        return self.parsed[text]

    def typed(self, text: str) -> Any:
        """Return the value of a text in YAML 1.1, as launch_ros reads it; raise NotYaml."""
        return read11_text(text) if text else ""


def _variable(context: Context, made: Made) -> str | Unknown:
    name = context.perform(made.word("variable_name", 0, made.words.get("name")), made.place)
    if isinstance(name, Unknown):
        return name
    if name in context.configurations:
        value = context.configurations[name]
        return value if isinstance(value, (str, Unknown)) else Unknown(made.place, f"{name} is not a string")
    default = made.word("default", 1)
    if default is None:
        return Unknown(made.place, f"the launch argument {name} is not given")
    return context.perform(default, made.place)


def _join(context: Context, made: Made) -> str | Unknown:
    parts = made.word("substitutions", 0, [])
    found: list[str] = []
    for one in parts if isinstance(parts, (list, tuple)) else [parts]:
        text = context.perform(one, made.place)
        if isinstance(text, Unknown):
            return text
        found.append(text)
    return os.path.join(*found) if found else ""


def _share(context: Context, made: Made) -> str | Unknown:
    name = context.perform(made.word("package", 0), made.place)
    return name if isinstance(name, Unknown) else f"$(find-pkg-share {name})"


def _prefix(context: Context, made: Made) -> str | Unknown:
    name = context.perform(made.word("package", 0), made.place)
    return name if isinstance(name, Unknown) else f"$(find-pkg-prefix {name})"


def _environment(context: Context, made: Made) -> str | Unknown:
    name = context.perform(made.word("name", 0), made.place)
    if isinstance(name, Unknown):
        return name
    if isinstance(value := context.environment.get(name), (str, Unknown)):
        return value
    default = made.word("default_value", 1)
    return f"$(env {name})" if default is None else context.perform(default, made.place)


def _command(context: Context, made: Made) -> str | Unknown:
    text = context.perform(made.word("command", 0), made.place)
    return text if isinstance(text, Unknown) else f"$(command '{text}')"


def _python(context: Context, made: Made) -> str | Unknown:
    text = context.perform(made.word("expression", 0), made.place)
    if isinstance(text, Unknown):
        return text
    value = context.evaluate(text, made.place)
    return value if isinstance(value, Unknown) else str(value)


def _not(context: Context, made: Made) -> str | Unknown:
    value = context.truth(made.word("value", 0), made.place)
    return value if isinstance(value, Unknown) else str(not value).lower()


def _all(any_of: bool) -> Callable[[Context, Made], str | Unknown]:
    def do(context: Context, made: Made) -> str | Unknown:
        parts = made.args or [made.words.get("left"), made.words.get("right")]
        values = [context.truth(one, made.place) for one in parts]
        unknown = [one for one in values if isinstance(one, Unknown)]
        if any(one is any_of for one in values):
            return str(any_of).lower()
        return unknown[0] if unknown else str(not any_of).lower()

    return do


def _equals(negated: bool) -> Callable[[Context, Made], str | Unknown]:
    def do(context: Context, made: Made) -> str | Unknown:
        sides: list[str] = []
        for name, position in (("left", 0), ("right", 1)):
            side = made.word(name, position)
            text = (
                ""
                if side is None
                else context.perform(str(side).lower() if isinstance(side, bool) else side, made.place)
            )
            if isinstance(text, Unknown):
                return text
            sides.append(text)
        left, right = sides
        lower = [one.lower() for one in sides]
        if all(one in ("true", "false", "1", "0") for one in lower):
            same = (lower[0] in ("true", "1")) == (lower[1] in ("true", "1"))
        else:
            try:
                same = math.isclose(float(left), float(right))
            except ValueError:
                same = left == right
        return str(same is not negated).lower()

    return do


def _if_else(context: Context, made: Made) -> str | Unknown:
    test = context.truth(made.word("condition", 0), made.place)
    if isinstance(test, Unknown):
        return test
    return context.perform(made.word("if_value", 1, "") if test else made.word("else_value", 2, ""), made.place)


def _content(context: Context, made: Made) -> str | Unknown:
    path = context.perform(made.word("path", 0), made.place)
    text = path if isinstance(path, Unknown) else context.read(path)
    return Unknown(made.place, f"{path} is not here") if text is None else text


def _string_join(context: Context, made: Made) -> str | Unknown:
    glue = context.perform(made.word("delimiter", 1, ""), made.place)
    parts = [context.perform(one, made.place) for one in made.word("substitutions", 0, [])]
    for one in [glue, *parts]:
        if isinstance(one, Unknown):
            return one
    return str(glue).join(str(one) for one in parts)


def _parameter_file(context: Context, made: Made) -> str | Unknown:
    path = context.perform(made.word("param_file", 0), made.place)
    substituted = made.word("allow_substs", 1, False)
    if isinstance(substituted, (Made, list, str)):
        substituted = context.truth(substituted, made.place)
    if isinstance(path, Unknown) or substituted is not True:
        return path
    text = context.read(path)
    if text is None:
        return Unknown(made.place, f"{path} is not here, and launch substitutes in it")
    if "$(" not in text:
        return path
    from fogspec.spec.launch_import.text import NotText, parse_text

    try:
        done = context.perform(parse_text(text, made.place), made.place)
    except NotText:
        return Unknown(made.place, f"the substitutions in {path} cannot be read")
    return done if isinstance(done, Unknown) else _kept(context, path, done)


def _kept(context: Context, path: str, text: str) -> str:
    """Keep a file that launch would write; one with paths that only the machine can tell is substituted there."""
    written = context.written(path, text)
    if KEPT.search(text):
        context.substituted.add(written)
    return written


def _rewritten(context: Context, made: Made) -> str | Unknown:
    """nav2's RewrittenYaml: a parameter file with some of its values replaced."""
    path = context.perform(made.word("source_file", 0), made.place)
    if isinstance(path, Unknown):
        return path
    text = context.read(path)
    rewrites: list[dict[str, str]] = []
    for name, position in (("param_rewrites", 1), ("key_rewrites", 3), ("value_rewrites", 4)):
        some: dict[str, str] = {}
        given = made.word(name, position) or {}
        for key, value in given.items() if isinstance(given, dict) else ():
            done = context.perform(value, made.place)
            if isinstance(done, Unknown):
                return done
            some[str(key)] = done
        rewrites.append(some)
    if text is None:
        return Unknown(made.place, f"{path} is not here, and launch rewrites it")
    root = made.word("root_key", 2)
    root_key = "" if root is None else context.perform(root, made.place)
    if isinstance(root_key, Unknown):
        return root_key
    try:
        data = context.data(text)
    except NotYaml:
        return Unknown(made.place, f"{path} cannot be read as YAML")
    if not isinstance(data, dict):
        return Unknown(made.place, f"{path} holds no parameters")
    convert = made.word("convert_types", 5, False) is True
    data = rewritten(data, rewrites[0], rewrites[1], rewrites[2], convert=convert, spend=context.found.spend)
    body = yaml_text({root_key: data} if root_key else data, "").partition("\n")[2]
    return _kept(context, path, f"# {PurePosixPath(path).name} with the values that launch sets\n{body}")


def rewritten(
    data: dict[str, Any],
    values: dict[str, str],
    keys: dict[str, str],
    texts: dict[str, str],
    *,
    convert: bool,
    spend: Callable[[int], None],
) -> dict[str, Any]:
    """Return parameters with values replaced by key or whole path, keys renamed, and values replaced by their text."""

    def converted(text: str) -> Any:
        if convert:
            try:
                return float(text) if "." in text else int(text)
            except ValueError:
                pass
        return text.lower() == "true" if text.lower() in ("true", "false") else text

    def walk(value: Any, path: str, depth: int) -> Any:
        spend(1)
        if depth > DEEPEST:
            return value
        if isinstance(value, list):
            return [walk(one, f"{path}.{i}", depth + 1) for i, one in enumerate(value)]
        if not isinstance(value, dict):
            return converted(texts[str(value)]) if str(value) in texts else value
        found: dict[str, Any] = {}
        for key, below in value.items():
            at = f"{path}.{key}" if path else str(key)
            said = values.get(str(key), values.get(at))
            found[keys.get(str(key)) or key] = walk(below, at, depth + 1) if said is None else converted(said)
        return found

    found: dict[str, Any] = walk(data, "", 0)
    for path, text in values.items():
        if "ros__parameters" in path.split("."):
            _set(found, path.split("."), converted(text))
    return found


def _set(data: dict[str, Any], names: list[str], value: Any) -> None:
    """Set a value that may be below maps that are not there yet."""
    for name in names[:-1]:
        below: Any = data.setdefault(name, {})
        if not isinstance(below, dict):
            return
        data = below
    data[names[-1]] = value


def _replaced(context: Context, made: Made) -> str | Unknown:
    """nav2's ReplaceString: a file with some texts replaced."""
    path = context.perform(made.word("source_file", 0), made.place)
    if isinstance(path, Unknown):
        return path
    condition = made.word("condition", 2)
    if isinstance(condition, Made):
        test = context.truth(condition.word("predicate_expression", 0), made.place)
        if test is not True:
            return test if isinstance(test, Unknown) else path
    text = context.read(path)
    if text is None:
        return Unknown(made.place, f"{path} is not here, and launch replaces texts in it")
    for key, value in (made.word("replacements", 1) or {}).items():
        done = context.perform(value, made.place)
        if isinstance(done, Unknown):
            return done
        context.found.spend(len(text) + text.count(str(key)) * len(done))
        text = text.replace(str(key), done)
    return _kept(context, path, text)


def _has_parameters(context: Context, made: Made) -> str | Unknown:
    path = context.perform(made.word("source_file", 0), made.place)
    text = path if isinstance(path, Unknown) else context.read(path)
    if not isinstance(text, str):
        return (
            path if isinstance(path, Unknown) else Unknown(made.place, f"{path} is not here, and a condition reads it")
        )
    try:
        data = context.data(text)
    except NotYaml:
        return Unknown(made.place, f"{path} cannot be read as YAML")
    return str(isinstance(data, dict) and made.word("node_name", 1) in data)


def _executable(context: Context, made: Made) -> str | Unknown:
    package = context.perform(made.word("package", 1), made.place)
    executable = context.perform(made.word("executable", 0), made.place)
    if isinstance(package, Unknown) or isinstance(executable, Unknown):
        return package if isinstance(package, Unknown) else executable
    return f"$(find-pkg-prefix {package})/lib/{package}/{executable}"


def _folder(context: Context, _: Made) -> str | Unknown:
    path = Path(os.path.abspath(context.file)).parent
    return context.packages.shared(path) or path.as_posix()


def _this(context: Context, _: Made) -> str | Unknown:
    path = Path(os.path.abspath(context.file))
    return context.packages.shared(path) or path.as_posix()


def _as_bool(context: Context, made: Made) -> str | Unknown:
    """nav2's LaunchConfigAsBool: True for what a person may write for it."""
    text = _variable(context, Made("LaunchConfiguration", made.args, made.words, made.place))
    return text if isinstance(text, Unknown) else str(text.strip().lower() in ("true", "1", "yes", "on"))


SUBSTITUTIONS: dict[str, Callable[[Context, Made], str | Unknown]] = {
    "Text": lambda context, made: context.perform(made.args, made.place),
    "LaunchConfigAsBool": _as_bool,
    "TextSubstitution": lambda context, made: context.perform(made.word("text", 0), made.place),
    "LaunchConfiguration": _variable,
    "PathJoinSubstitution": _join,
    "PathSubstitution": _join,
    "StringJoinSubstitution": _string_join,
    "FindPackageShare": _share,
    "FindPackage": _prefix,
    "FindPackagePrefix": _prefix,
    "ThisLaunchFileDir": _folder,
    "ThisLaunchFile": _this,
    "EnvironmentVariable": _environment,
    "Command": _command,
    "PythonExpression": _python,
    "NotSubstitution": _not,
    "AndSubstitution": _all(False),
    "AllSubstitution": _all(False),
    "OrSubstitution": _all(True),
    "AnySubstitution": _all(True),
    "EqualsSubstitution": _equals(False),
    "NotEqualsSubstitution": _equals(True),
    "IfElseSubstitution": _if_else,
    "FindExecutable": lambda context, made: context.perform(made.word("name", 0), made.place),
    "ExecutableInPackage": _executable,
    "FileContent": _content,
    "ParameterFile": _parameter_file,
    "RewrittenYaml": _rewritten,
    "ReplaceString": _replaced,
    "HasNodeParams": _has_parameters,
    "ParameterValue": lambda context, made: context.perform(made.word("value", 0), made.place),
    "PythonLaunchDescriptionSource": lambda context, made: context.perform(made.word("launch_file_path", 0), made.place),
    "AnyLaunchDescriptionSource": lambda context, made: context.perform(made.word("launch_file_path", 0), made.place),
    "XMLLaunchDescriptionSource": lambda context, made: context.perform(made.word("launch_file_path", 0), made.place),
    "YAMLLaunchDescriptionSource": lambda context, made: context.perform(made.word("launch_file_path", 0), made.place),
    "FrontendLaunchDescriptionSource": lambda context, made: context.perform(made.word("launch_file_path", 0), made.place),
}  # fmt: skip


def parsed_expression(text: str) -> ast.expr | None:
    """Return a Python expression's tree; None if it is none."""
    try:
        return ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return None
