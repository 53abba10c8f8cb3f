"""The one way to the terminal: everything that is printed passes here, and no text from a file can steer a terminal."""

import contextlib
import errno
import json
import os
import re
import sys
from collections.abc import Iterator
from enum import IntEnum
from typing import IO, TYPE_CHECKING, Any

import click

from fogspec.base.clock import SystemClock
from fogspec.base.redaction import known, without_secrets
from fogspec.base.text import json_text, line, visible

if TYPE_CHECKING:
    from rich.console import Console

# A style is written as a mark that differs in every run, so that no file can know it; `say_text` makes codes of it.
GONE = (errno.EIO, errno.EPIPE)  # what a write to a closed terminal or pipe fails with
MARK = f"\0{os.urandom(8).hex()}"
STYLE = re.compile(f"{MARK}([0-9;]*)m")
LEAST_COLUMNS, USUAL_COLUMNS = 40, 80
SOURCE = re.compile(r" *\d* *\||[<>=]{7}")  # a line of a source file with its number, or of a conflict in it
COPIED = re.compile(r" *(next: |\$ )?fogspec \S")  # a command: a break would be copied too
HANGING = re.compile(r" *\S+(?: \S+)? {2,}| +")


class Verbosity(IntEnum):
    """How much is printed besides errors and the result."""

    QUIET = -1
    NORMAL = 0
    VERBOSE = 1


_verbosity = Verbosity.NORMAL


def set_verbosity(wanted: Verbosity) -> None:
    """Set how much this process prints from now on."""
    global _verbosity
    _verbosity = wanted


def is_quiet() -> bool:
    """Return whether only errors and the result are printed."""
    return _verbosity is Verbosity.QUIET


def is_verbose() -> bool:
    """Return whether details are printed too."""
    return _verbosity is Verbosity.VERBOSE


def say(*lines: str, err: bool = False) -> None:
    """Print lines, of which none can become two."""
    if lines:
        say_text("\n".join(map(line, lines)), err=err)


def note(*lines: str) -> None:
    """Print lines on standard error that are neither an error nor the result; nothing with `--quiet`."""
    if lines and not is_quiet():
        say(*lines, err=True)


def detail(*lines: str) -> None:
    """Print lines on standard error with `--verbose`."""
    if lines and is_verbose():
        say(*(f"verbose: {one}" for one in lines), err=True)


@contextlib.contextmanager
def timed(stage: str) -> Iterator[None]:
    """Print with `--verbose` how long a stage took."""
    clock = SystemClock()
    began_s = clock.now_s()
    yield
    detail(f"{stage} took {clock.now_s() - began_s:.2f} s")


def columns(err: bool = False) -> int:
    """Return the width of the terminal, or the environment's COLUMNS; 80 where neither says one."""
    try:
        wide = int(os.environ.get("COLUMNS", ""))
    except ValueError:
        wide = 0
    if wide <= 0:
        try:
            wide = os.get_terminal_size((sys.stderr if err else sys.stdout).fileno()).columns
        except (OSError, ValueError, AttributeError):
            wide = USUAL_COLUMNS
    return max(wide or USUAL_COLUMNS, LEAST_COLUMNS)


def say_text(text: str, *, err: bool = False, end: str = "\n", color: bool | None = None) -> None:
    """Print text of several lines, with what `styled` made of it if `color` is True, by default on a terminal.

    Values in it that come from files have passed `fogspec.base.text.line`, or they could look like lines of fogspec's.
    """
    _print(without_secrets(text), err=err, end=end, color=color)


def _print(text: str, *, err: bool, end: str = "\n", color: bool | None = None) -> None:
    color = has_color(err) if color is None else color
    if (sys.stderr if err else sys.stdout).isatty():
        text = wrapped(text, columns(err))
    parts = STYLE.split(text)
    parts[::2] = map(visible, parts[::2])
    parts[1::2] = [f"\x1b[{codes}m" if color else "" for codes in parts[1::2]]
    click.echo("".join(parts) + end, nl=False, err=err, color=color)


def wrapped(text: str, width: int) -> str:
    """Return text whose lines are at most `width` cells wide, broken at blanks; rows keep their column.

    A line of a file that is shown, or with a command stays as it is. `styled` parts take no cells.
    """
    return "\n".join(_wrapped_line(one, max(width, LEAST_COLUMNS)) for one in text.split("\n"))


def _wrapped_line(text: str, width: int) -> str:
    plain = STYLE.sub("", text)
    if len(plain) <= width or SOURCE.match(plain) or COPIED.match(plain):
        return text
    lead = HANGING.match(plain)
    starts = (len(lead[0]) if lead else 0, len(plain) - len(plain.lstrip(" ")))
    indent = " " * next((one for one in starts if 0 < one <= width // 3), 2)
    first, *rest = re.split(r"(?<=\S)( +)(?=\S)", text)
    lines, now = [], first
    for gap, word in zip(rest[::2], rest[1::2], strict=True):
        longer = f"{now}{gap}{word}"
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


def say_json(data: Any, *, indent: int | None = 2) -> None:
    """Print a value as JSON."""
    clean = known().redact_value(data)
    _print(json_text(json.dumps(clean, ensure_ascii=False, indent=indent)), err=False, color=False)


def styled(text: str, **style: Any) -> str:
    """Return the text in a style of `click.style`, for `say_text`."""
    return click.style(visible(text), **style).replace("\x1b[", MARK)


def has_color(err: bool = False) -> bool:
    """Return whether the terminal shows colors, and the user wants them."""
    stream: IO[str] = sys.stderr if err else sys.stdout
    return stream.isatty() and not os.environ.get("NO_COLOR")


def ask(question: str) -> bool:
    """Ask the user a question, and return whether the answer is yes."""
    return click.confirm(line(without_secrets(question)), err=True)


def live_console() -> "Console":
    """Return a console for a table that is redrawn; its cells must have passed `fogspec.base.text.line`."""
    from rich.console import Console

    return Console(stderr=True)
