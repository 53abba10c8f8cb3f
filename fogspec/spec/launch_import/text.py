"""Texts of XML and YAML launch files: `$(var x)`, `$(find-pkg-share $(var p))` and their like, by launch's own grammar."""

import re
from typing import Any

from fogspec.spec.launch_import.found import DEEPEST, Made, Place

NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")
KINDS = {
    "var": "LaunchConfiguration",
    "env": "EnvironmentVariable",
    "optenv": "EnvironmentVariable",
    "find-pkg-share": "FindPackageShare",
    "find-pkg-prefix": "FindPackagePrefix",
    "dirname": "ThisLaunchFileDir",
    "filename": "ThisLaunchFile",
    "eval": "PythonExpression",
    "command": "Command",
    "find-exec": "FindExecutable",
    "exec-in-pkg": "ExecutableInPackage",
    "not": "NotSubstitution",
    "and": "AndSubstitution",
    "or": "OrSubstitution",
    "any": "AnySubstitution",
    "all": "AllSubstitution",
    "equals": "EqualsSubstitution",
    "not-equals": "NotEqualsSubstitution",
    "if": "IfElseSubstitution",
    "file-content": "FileContent",
    "path-join": "PathJoin",
    "string-join": "StringJoin",
}


class NotText(Exception):
    """A text whose substitutions cannot be read."""


def parse_text(text: str, place: Place) -> list[Any]:
    """Return the texts and substitutions that a text is made of; raise NotText."""
    reader = _Reader(text, place)
    return reader.template("")


class _Reader:
    def __init__(self, text: str, place: Place) -> None:
        self.text, self.place, self.at, self.depth = text, place, 0, 0

    def template(self, quote: str) -> list[Any]:
        """Read up to the end, or to the closing quote."""
        parts: list[Any] = []
        plain: list[str] = []
        while self.at < len(self.text):
            one = self.text[self.at]
            if quote and one == quote:
                break
            if one == "\\" and self.at + 1 < len(self.text):
                plain.append(self.text[self.at + 1])
                self.at += 2
            elif self.text.startswith("$(", self.at):
                if plain:
                    parts.append("".join(plain))
                    plain = []
                parts.append(self.substitution())
            else:
                plain.append(one)
                self.at += 1
        else:
            if quote:
                raise NotText(f"a closing {quote} is missing")
        if plain:
            parts.append("".join(plain))
        return parts

    def substitution(self) -> Made:
        self.depth += 1
        if self.depth > DEEPEST:
            raise NotText("it is nested too deep")
        match = NAME.match(self.text, self.at + 2)
        if match is None:
            raise NotText("a substitution has no name")
        self.at = match.end()
        arguments: list[list[Any]] = []
        while self.text.startswith(" ", self.at):
            self.at += 1
            if self.text.startswith((" ", ")"), self.at):
                continue
            arguments.append(self.argument())
        if not self.text.startswith(")", self.at):
            raise NotText(f"$({match[0]} … has no closing bracket")
        self.at += 1
        self.depth -= 1
        return _made(match[0], arguments, self.place)

    def argument(self) -> list[Any]:
        quote = self.text[self.at : self.at + 1]
        if quote and quote in "'\"":
            self.at += 1
            parts = self.template(quote)
            self.at += 1
            return parts
        parts = []
        plain: list[str] = []
        while self.at < len(self.text):
            one = self.text[self.at]
            if one in " )":
                break
            if one == "\\" and self.at + 1 < len(self.text):
                plain.append(self.text[self.at + 1])
                self.at += 2
            elif self.text.startswith("$(", self.at):
                parts += ["".join(plain)] if plain else []
                plain = []
                parts.append(self.substitution())
            else:
                plain.append(one)
                self.at += 1
        return [*parts, "".join(plain)] if plain else parts


def _made(name: str, arguments: list[list[Any]], place: Place) -> Made:
    kind = KINDS.get(name, f"$({name})")
    if name == "optenv":
        return Made(kind, [arguments[0] if arguments else "", arguments[1] if len(arguments) > 1 else ""], {}, place)
    if name in ("path-join", "string-join"):
        return Made(f"{kind}Substitution", [arguments], {}, place)
    return Made(kind, list(arguments), {}, place)
