"""The one way to the terminal: everything that is printed passes here, and no text from a file can steer a terminal."""

import errno
import json
import os
import re
import shutil
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
LEAST_COLUMNS = 40
DRAWN = re.compile(r" *[\d.$µms ]*[|+]|[<>=]{7}")  # a line of a chart, or of a source file with its number
HANGING = re.compile(r" *\S+(?: \S+)? {2,}| +")


def say(*lines: str, err: bool = False) -> None:
    """Print lines, of which none can become two."""
    say_text("\n".join(map(line, lines)), err=err)


def say_text(text: str, *, err: bool = False, end: str = "\n", color: bool | None = None) -> None:
    """Print text of several lines, with what `styled` made of it if `color` is True, by default on a terminal.

    Values in it that come from files have passed `fogspec.base.text.line`, or they could look like lines of fogspec's.
    """
    color = has_color(err) if color is None else color
    if (sys.stderr if err else sys.stdout).isatty():
        text = wrapped(text, shutil.get_terminal_size().columns)
    parts = STYLE.split(text)
    parts[::2] = map(visible, parts[::2])
    parts[1::2] = [f"\x1b[{codes}m" if color else "" for codes in parts[1::2]]
    click.echo("".join(parts) + end, nl=False, err=err, color=color)


def wrapped(text: str, width: int) -> str:
    """Return text whose lines are at most `width` cells wide, broken at blanks; rows keep their column.

    A line of a chart or of a file that is shown stays as it is. `styled` parts take no cells.
    """
    return "\n".join(_wrapped_line(one, max(width, LEAST_COLUMNS)) for one in text.split("\n"))


def _wrapped_line(text: str, width: int) -> str:
    if len(STYLE.sub("", text)) <= width or DRAWN.match(STYLE.sub("", text)):
        return text
    lead = HANGING.match(STYLE.sub("", text))
    indent = " " * (len(lead[0]) if lead and len(lead[0]) <= width // 3 else 2)
    lines, now = [], ""
    for word in re.split(r"(?<=\S) (?=\S)", text):
        longer = f"{now} {word}" if now else word
        if now.strip() and len(STYLE.sub("", longer)) > width:
            lines.append(now)
            now = f"{indent}{word}"
        else:
            now = longer
    return "\n".join([*lines, now])


def say_on(*lines: str) -> None:
    """Print lines on standard error; if the terminal is gone, work continues without them."""
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
