"""Redaction: remove the values of secret environment variables from everything that is printed or kept.

Standard library only, Python 3.10 or newer. The agent uses it where the nodes run, before any of their output is written,
and fogspec for what it keeps and prints of them. As a program it copies records, one per line:

    python3 agent.pyz redaction NAME ... < timings.jsonl
"""

import contextlib
import json
import os
import re
import subprocess
import sys
import threading
from collections.abc import Iterable, Mapping, Sequence
from typing import IO, Any

SHORTEST = 4
READ_BYTES = 65536
SETTLE_S = 2.0
LINE_LIMIT = 2**20
LONGEST_LINE = 2**14
LINE_END = re.compile(rb"\r?\n|\r(?!\n|\Z)")


class Secrets:
    """Secret values and their replacements; values shorter than `SHORTEST` characters are not secrets."""

    def __init__(self, values: Mapping[str, str]) -> None:
        # JSON escapes some characters, so each value is searched for in its escaped forms as well.
        forms = {form: replacement for value, replacement in values.items() for form in _forms(value)}
        # Longest first, because one may be part of another.
        self.replacements = {form: forms[form] for form in sorted(forms, key=lambda form: (-len(form), form))}
        self.byte_replacements = {
            os.fsencode(form): replacement.encode() for form, replacement in self.replacements.items()
        }
        self.pattern = re.compile(b"|".join(map(re.escape, self.byte_replacements)) or b"(?!)")

    @classmethod
    def of(cls, names: Iterable[str]) -> "Secrets":
        """Return the values of those of the variables that are set, each to be replaced by `$NAME`."""
        return cls({os.environ[name]: f"${name}" for name in names if len(os.environ.get(name, "")) >= SHORTEST})

    def __bool__(self) -> bool:
        return bool(self.byte_replacements)

    def redact(self, text: str) -> str:
        """Return the text with every secret replaced."""
        for form, replacement in self.replacements.items():
            text = text.replace(form, replacement)
        return text

    def redact_bytes(self, content: bytes) -> bytes:
        """Return the bytes with every secret replaced."""
        return self.pattern.sub(lambda found: self.byte_replacements[found[0]], content)

    def redact_record(self, line: bytes) -> bytes:
        """Return a line of JSON with secrets replaced in its strings; numbers stay, whatever digits they have."""
        if self.pattern.search(line) is None:
            return line
        try:
            return json.dumps(self.redact_value(json.loads(line))).encode() + b"\n"
        except (ValueError, RecursionError):
            return self.redact_bytes(line)

    def redact_value(self, value: Any) -> Any:
        """Return a value of JSON with secrets replaced in its strings."""
        if isinstance(value, dict):
            return {self.redact_value(key): self.redact_value(one) for key, one in value.items()}
        if isinstance(value, (list, tuple)):
            return [self.redact_value(one) for one in value]
        return self.redact(value) if isinstance(value, str) else value


def _forms(value: str) -> set[str]:
    return {value, *(json.dumps(value, ensure_ascii=ascii)[1:-1] for ascii in (True, False))}


class Stream:
    """Redaction of bytes that arrive in pieces: the possible beginning of a secret is held back."""

    def __init__(self, secrets: Secrets) -> None:
        self.secrets, self.held = secrets, b""

    def feed(self, piece: bytes) -> bytes:
        """Take the next piece and return the bytes that can be written now."""
        content = self.held + piece
        at, safe, out = 0, len(content) - self._held_back(content), list[bytes]()
        for found in self.secrets.pattern.finditer(content):
            if found.start() >= safe:
                break
            out += [content[at : found.start()], self.secrets.byte_replacements[found[0]]]
            at = found.end()
        safe = max(at, safe)
        self.held = content[safe:]
        return b"".join([*out, content[at:safe]])

    def rest(self) -> bytes:
        """Return the bytes that were held back, at the end of the stream."""
        held, self.held = self.held, b""
        return self.secrets.redact_bytes(held)

    def _held_back(self, content: bytes) -> int:
        """Return how many bytes at the end are the beginning of a secret."""
        secrets = self.secrets.byte_replacements
        return max((n for value in secrets for n in range(1, len(value)) if content.endswith(value[:n])), default=0)


class Marked:
    """Lines with the name in brackets of what printed them in front, as ROS 2's launch has it, from bytes in pieces.

    A line is held back until it is whole; one longer than `LONGEST_LINE` bytes is broken.
    """

    def __init__(self, name: str) -> None:
        self.mark, self.held = f"[{name}] ".encode("utf-8", "replace"), b""

    def feed(self, piece: bytes) -> bytes:
        """Take the next piece and return the bytes that can be written now."""
        # A carriage return alone begins a line, too; whether it is alone tells the byte after it.
        *whole, self.held = LINE_END.split(self.held + piece)
        while len(self.held) > LONGEST_LINE:
            whole.append(self.held[:LONGEST_LINE])
            self.held = self.held[LONGEST_LINE:]
        return b"".join(self.mark + line + b"\n" for line in whole)

    def rest(self) -> bytes:
        """Return the line that was held back, at the end of the stream."""
        held, self.held = self.held.rstrip(b"\r"), b""
        return self.mark + held + b"\n" if held else b""


class Output:
    """Start processes whose output reaches a file, or this process's standard output, without secrets."""

    def __init__(self, names: Iterable[str]) -> None:
        self.secrets = Secrets.of(names)
        self.copying: dict[int, threading.Thread] = {}

    def start(
        self, argv: list[str], to: "IO[bytes] | None" = None, name: "str | None" = None, **options: Any
    ) -> "subprocess.Popen[bytes]":
        """Start a process as subprocess.Popen does, with both outputs in one place; raise OSError if it cannot be started.

        With a name each line is marked with it. Without name and secrets the process writes directly; else a thread copies
        its output.
        """
        if not self.secrets and name is None:
            return subprocess.Popen(argv, stdout=to, stderr=None if to is None else subprocess.STDOUT, **options)
        options |= {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "bufsize": 0}
        process: subprocess.Popen[bytes] = subprocess.Popen(argv, **options)
        target = os.dup(1 if to is None else to.fileno())
        marked = None if name is None else Marked(name)
        words = (process.stdout, target, Stream(self.secrets), marked)
        copy = threading.Thread(target=_copy, args=words, daemon=True)
        self.copying[process.pid] = copy
        copy.start()
        return process

    def settle(self, process: "subprocess.Popen[bytes] | None" = None) -> None:
        """Wait up to `SETTLE_S` until the output of one ended process, or of all, is written."""
        for pid in list(self.copying) if process is None else [process.pid]:
            if (copy := self.copying.pop(pid, None)) is not None:
                copy.join(SETTLE_S)


def _copy(source: "IO[bytes]", target: int, stream: Stream, marked: "Marked | None" = None) -> None:
    with contextlib.suppress(OSError), source:
        while piece := source.read(READ_BYTES):
            content = stream.feed(piece)
            _write(target, content if marked is None else marked.feed(content))
    rest = stream.rest()
    _write(target, rest if marked is None else marked.feed(rest) + marked.rest())
    os.close(target)


def _write(target: int, content: bytes) -> None:
    """Write all of it; ignore a full disk, which must not end the process that prints."""
    with contextlib.suppress(OSError):
        while content:
            content = content[os.write(target, content) :]


def main(names: Sequence[str] | None = None) -> None:
    """Copy standard input to standard output without the values of the variables with these names."""
    secrets, out = Secrets.of(sys.argv[1:] if names is None else names), sys.stdout.buffer
    stream = Stream(secrets)
    while line := sys.stdin.buffer.readline(LINE_LIMIT):
        # A line that is too long for a record, or the rest of one, is redacted as plain bytes.
        whole = not stream.held and line.endswith(b"\n")
        out.write(secrets.redact_record(line) if whole else stream.feed(line))
    out.write(stream.rest())


if __name__ == "__main__":
    main()
