"""The one way to the terminal: everything that is printed passes here, and no text from a file can steer a terminal."""

import errno
import json
import os
import re
import sys
from typing import IO, TYPE_CHECKING, Any

import click

from fogspec.base.text import json_text, line, visible

if TYPE_CHECKING:
    from rich.console import Console

# A style is written as a mark that differs in every run, so that no file can know it; `say_text` makes codes of it.
GONE = (errno.EIO, errno.EPIPE)  # what a write to a closed terminal or pipe fails with
MARK = f"\0{os.urandom(8).hex()}"
STYLE = re.compile(f"{MARK}([0-9;]*)m")


def say(*lines: str, err: bool = False) -> None:
    """Print lines, of which none can become two."""
    say_text("\n".join(map(line, lines)), err=err)


def say_text(text: str, *, err: bool = False, end: str = "\n", color: bool | None = None) -> None:
    """Print text of several lines, with what `styled` made of it if `color` is True, by default on a terminal.

    Values in it that come from files have passed `fogspec.base.text.line`, or they could look like lines of fogspec's.
    """
    color = has_color(err) if color is None else color
    parts = STYLE.split(text)
    parts[::2] = map(visible, parts[::2])
    parts[1::2] = [f"\x1b[{codes}m" if color else "" for codes in parts[1::2]]
    click.echo("".join(parts) + end, nl=False, err=err, color=color)


def say_on(*lines: str) -> None:
    """Print lines on standard error; if nobody can read them any more, because the terminal is gone, work goes on without."""
    try:
        say(*lines, err=True)
    except OSError as lost:
        if lost.errno not in GONE:
            raise


def say_json(data: Any, *, indent: int | None = 2, err: bool = False) -> None:
    """Print a value as JSON."""
    say_text(json_text(json.dumps(data, ensure_ascii=False, indent=indent)), err=err, color=False)


def styled(text: str, **style: Any) -> str:
    """Return the text in a style of `click.style`, for `say_text`."""
    return click.style(visible(text), **style).replace("\x1b[", MARK)


def has_color(err: bool = False) -> bool:
    """Return whether the terminal shows colors, and the user wants them."""
    stream: IO[str] = sys.stderr if err else sys.stdout
    return stream.isatty() and not os.environ.get("NO_COLOR")


def ask(question: str) -> bool:
    """Ask the user a question, and return whether the answer is yes."""
    return click.confirm(line(question), err=True)


def live_console() -> "Console":
    """Return a console for a table that is redrawn; its cells must have passed `fogspec.base.text.line`."""
    from rich.console import Console

    return Console(stderr=True)
