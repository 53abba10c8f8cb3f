"""Texts of XML and YAML launch files: `$(var x)`, `$(find-pkg-share $(var p))` and their like, by launch's own grammar."""

import re
import shlex
from typing import Any

from fogspec.importers.launch.sandboxed.made import NAMES
from fogspec.importers.launch.sandboxed.values import Place, Unknown

NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")
DEEPEST = 50
LONGEST_COMMAND = 8 << 10
KINDS = {
    "var": "LaunchConfiguration", "env": "EnvironmentVariable", "optenv": "EnvironmentVariable", "dirname": "ThisLaunchFileDir",
    "find-pkg-share": "FindPackageShare", "find-pkg-prefix": "FindPackagePrefix", "filename": "ThisLaunchFile",
    "eval": "PythonExpression", "command": "Command", "find-exec": "FindExecutable", "exec-in-pkg": "ExecutableInPackage",
    "not": "NotSubstitution", "and": "AndSubstitution", "or": "OrSubstitution", "any": "AnySubstitution",
    "all": "AllSubstitution", "equals": "EqualsSubstitution", "not-equals": "NotEqualsSubstitution", "if": "IfElseSubstitution",
    "file-content": "FileContent", "anon": "AnonName", "path-join": "PathJoinSubstitution",
    "string-join": "StringJoinSubstitution",
}  # fmt: skip


class NotText(Exception):
    """A text whose substitutions cannot be read."""


def parsed(value: Any, place: Place) -> Any:
    """Return the texts and substitutions of an attribute: a text if it has none, unknown if it cannot be read."""
    if not isinstance(value, str):
        return value
    try:
        parts = Reader(value, place).template("", 0)
    except NotText as wrong:
        return Unknown(f"'{value[:60]}' cannot be read: {wrong}", place)
    return "".join(parts) if all(isinstance(one, str) for one in parts) else parts


def split(text: str) -> list[str]:
    """Return a command line as words; a very long one is split at spaces, because shlex takes quadratic time."""
    try:
        return shlex.split(text) if len(text) <= LONGEST_COMMAND else text.split()
    except ValueError:
        return text.split()


def command_line(value: Any, place: Place) -> Any:
    """Return the words of a command line: what a substitution gives stays one word with what touches it."""
    parts = parsed(value, place) if isinstance(value, str) else [str(value)]
    if isinstance(parts, Unknown):
        return parts
    found: list[list[Any]] = []
    current: list[Any] = []
    for one in [parts] if isinstance(parts, str) else parts:
        if not isinstance(one, str):
            current.append(one)
            continue
        for i, word in enumerate(split(one)):
            if current and (i or one[0].isspace()):
                found.append(current)
                current = []
            current.append(word)
        if current and one and one[-1].isspace():
            found.append(current)
            current = []
    return [*found, current] if current else found


class Reader:
    """Reads one text."""

    def __init__(self, text: str, place: Place) -> None:
        self.text, self.place, self.at = text, place, 0

    def template(self, ends: str, depth: int) -> list[Any]:
        """Read up to one of these characters, or to the end; raise NotText."""
        parts: list[Any] = []
        plain: list[str] = []
        while self.at < len(self.text) and self.text[self.at] not in (ends or "\0"):
            if self.text[self.at] == "\\" and self.at + 1 < len(self.text):
                plain.append(self.text[self.at + 1])
                self.at += 2
            elif self.text.startswith("$(", self.at):
                if plain:
                    parts.append("".join(plain))
                    plain = []
                parts.append(self.substitution(depth + 1))
            else:
                plain.append(self.text[self.at])
                self.at += 1
        return [*parts, "".join(plain)] if plain else parts

    def substitution(self, depth: int) -> Any:
        """Read a substitution; raise NotText."""
        match = NAME.match(self.text, self.at + 2)
        if depth > DEEPEST:
            raise NotText("it is nested too deep")
        if match is None:
            raise NotText("a substitution has no name")
        self.at = match.end()
        arguments = []
        while self.text.startswith(" ", self.at):
            self.at += 1
            if not self.text.startswith((" ", ")"), self.at):
                arguments.append(self.argument(depth))
        if not self.text.startswith(")", self.at):
            raise NotText(f"$({match[0]} … has no closing bracket")
        self.at += 1
        return self.made(match[0], arguments)

    def argument(self, depth: int) -> list[Any]:
        """Read one argument of a substitution; raise NotText."""
        quote = self.text[self.at : self.at + 1]
        if not quote or quote not in "'\"":
            return self.template(" )", depth)
        self.at += 1
        parts = self.template(quote, depth)
        if not self.text.startswith(quote, self.at):
            raise NotText(f"a closing {quote} is missing")
        self.at += 1
        return parts

    def made(self, name: str, arguments: list[Any]) -> Any:
        """Return the substitution of this name."""
        kind = KINDS.get(name, "")
        make = NAMES["launch"].get(kind) or NAMES["launch_ros"].get(kind)
        if make is None:
            return Unknown(f"only a launch determines $({name})", self.place)
        if name == "optenv":
            arguments = [*arguments, "", ""][:2] if len(arguments) < 2 else arguments
        try:
            made = make(arguments) if name in ("path-join", "string-join") else make(*arguments)
        except TypeError as wrong:
            return Unknown(f"launch refuses $({name} …): {wrong}", self.place)
        made.__dict__["place"] = self.place
        return made
