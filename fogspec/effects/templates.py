"""Rendering of shell scripts, launch files and pictures; every value passes a quoting filter of the target language."""

import json
import shlex
from functools import cache
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import escape


def shipped(kind: str) -> Path:
    """The folder of shipped `templates`, `schemas` or `specs`: in the wheel, or beside the package in a checkout."""
    package = Path(__file__).resolve().parent.parent
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
    environment.filters["sh"] = lambda value: shlex.quote(str(value))
    environment.filters["py"] = repr
    environment.filters["json"] = lambda value: json.dumps(value, sort_keys=True, ensure_ascii=False)
    environment.filters["xml"] = lambda value: str(escape(value))
    return environment


def render(template: str, /, **values: Any) -> str:
    """The template's text; raises jinja2.UndefinedError when a value is missing."""
    return _environment().get_template(template).render(**values)
