"""Rendering of shell scripts, launch files and pictures; every value passes a quoting filter of the target language."""

import json
from functools import cache
from pathlib import Path
from typing import Any

import jinja2

from fogspec.base import text


def shipped(kind: str) -> Path:
    """Return the directory of shipped `templates`, `schemas` or `specs`: in the wheel, or next to the package in a checkout."""
    package = Path(__file__).resolve().parents[1]
    inside = package / "_shipped" / kind
    return inside if inside.is_dir() else package.parent / kind


@cache
def _environment() -> jinja2.Environment:
    # autoescape stays off: each template names the filter of the language that it is written in
    environment = jinja2.Environment(  # noqa: S701
        loader=jinja2.FileSystemLoader(shipped("templates")),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters["sh"] = text.shell
    environment.filters["py"] = python
    environment.filters["json"] = lambda value: json.dumps(value, sort_keys=True, ensure_ascii=False)
    environment.filters["xml"] = text.xml
    return environment


def python(value: Any, indent: int = 0) -> str:
    """Return the value as a Python expression: on one line if it fits, else one line per entry, indented by `indent` spaces."""
    written = repr(value)
    if len(written) + indent <= 100 or not isinstance(value, (dict, list)):
        return written
    inner = " " * (indent + 4)
    if isinstance(value, dict):
        lines = [f"{inner}{key!r}: {python(one, indent + 4)},\n" for key, one in value.items()]
        return "{\n" + "".join(lines) + " " * indent + "}"
    return "[\n" + "".join(f"{inner}{python(one, indent + 4)},\n" for one in value) + " " * indent + "]"


def render(template: str, /, **values: Any) -> str:
    """Return the rendered template; raise jinja2.UndefinedError if a value is missing."""
    return _environment().get_template(template).render(**values)
