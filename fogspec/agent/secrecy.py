"""Secrets stay where they are: the values of environment variables are taken out of whatever is printed or kept.

Standard library only (Python 3.10 or newer): agent and keeper use it where the nodes run, before anything they print is
written, and fogspec for what it keeps and shows of them. By itself it passes on records, a line each:

    python3 secrecy.py NAME ... < timings.jsonl
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


class Secrets:
    """Values, and what is written in their place; what is shorter than `SHORTEST` characters is no secret."""

    def __init__(self, values: Mapping[str, str]) -> None:
        # JSON and what is printed with it write some characters otherwise.
        forms = {form: instead for value, instead in values.items() for form in _forms(value)}
        # The longest first, for one may be part of another.
        self.texts = {form: forms[form] for form in sorted(forms, key=lambda form: (-len(form), form))}
        self.words = {os.fsencode(form): instead.encode() for form, instead in self.texts.items()}
        self.pattern = re.compile(b"|".join(map(re.escape, self.words)) or b"(?!)")

    @classmethod
    def of(cls, names: Iterable[str]) -> "Secrets":
        """Those of these variables that are set; `$NAME` takes the place of a value."""
        return cls({os.environ[name]: f"${name}" for name in names if len(os.environ.get(name, "")) >= SHORTEST})

    def __bool__(self) -> bool:
        return bool(self.words)

    def out_of(self, text: str) -> str:
        """The text without them."""
        for form, instead in self.texts.items():
            text = text.replace(form, instead)
        return text

    def out_of_bytes(self, content: bytes) -> bytes:
        """The same for bytes."""
        return self.pattern.sub(lambda found: self.words[found[0]], content)

    def out_of_record(self, line: bytes) -> bytes:
        """The same for a line of JSON: texts lose them, figures stay, whatever digits they have."""
        if self.pattern.search(line) is None:
            return line
        try:
            return json.dumps(self._out_of_value(json.loads(line))).encode() + b"\n"
        except (ValueError, RecursionError):
            return self.out_of_bytes(line)

    def _out_of_value(self, value: Any) -> Any:
        if isinstance(value, dict):
            return {self.out_of(key): self._out_of_value(one) for key, one in value.items()}
        if isinstance(value, list):
            return [self._out_of_value(one) for one in value]
        return self.out_of(value) if isinstance(value, str) else value


def _forms(value: str) -> set[str]:
    return {value, *(json.dumps(value, ensure_ascii=ascii)[1:-1] for ascii in (True, False))}


class Stream:
    """The same for bytes that come in pieces: what may be the beginning of a secret is held back."""

    def __init__(self, secrets: Secrets) -> None:
        self.secrets, self.held = secrets, b""

    def feed(self, piece: bytes) -> bytes:
        """What can be written now."""
        content = self.held + piece
        at, safe, out = 0, len(content) - self._begun(content), list[bytes]()
        for found in self.secrets.pattern.finditer(content):
            if found.start() >= safe:
                break
            out += [content[at : found.start()], self.secrets.words[found[0]]]
            at = found.end()
        safe = max(at, safe)
        self.held = content[safe:]
        return b"".join([*out, content[at:safe]])

    def rest(self) -> bytes:
        """What was held back, once there is no more."""
        held, self.held = self.held, b""
        return self.secrets.out_of_bytes(held)

    def _begun(self, content: bytes) -> int:
        """How many bytes at the end are the beginning of a secret."""
        words = self.secrets.words
        return max((n for word in words for n in range(1, len(word)) if content.endswith(word[:n])), default=0)


class Output:
    """Starts processes whose output reaches a file, or this one's standard output, without secrets."""

    def __init__(self, names: Iterable[str]) -> None:
        self.secrets = Secrets.of(names)
        self.copying: dict[int, threading.Thread] = {}

    def start(self, argv: list[str], to: "IO[bytes] | None" = None, **options: Any) -> "subprocess.Popen[bytes]":
        """As subprocess.Popen, both outputs to one place; raises OSError. Where there is no secret nothing is between them."""
        if not self.secrets:
            return subprocess.Popen(argv, stdout=to, stderr=None if to is None else subprocess.STDOUT, **options)
        options |= {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "bufsize": 0}
        process: subprocess.Popen[bytes] = subprocess.Popen(argv, **options)
        assert process.stdout is not None
        target = os.dup(1 if to is None else to.fileno())
        copy = threading.Thread(target=_copy, args=(process.stdout, target, Stream(self.secrets)), daemon=True)
        self.copying[process.pid] = copy
        copy.start()
        return process

    def settle(self, process: "subprocess.Popen[bytes] | None" = None) -> None:
        """Wait a while until all is written that it, or whoever was started, has printed before it ended."""
        for pid in list(self.copying) if process is None else [process.pid]:
            if (copy := self.copying.pop(pid, None)) is not None:
                copy.join(SETTLE_S)


def _copy(source: "IO[bytes]", target: int, stream: Stream) -> None:
    with contextlib.suppress(OSError), source:
        while piece := source.read(READ_BYTES):
            _put(target, stream.feed(piece))
    _put(target, stream.rest())
    os.close(target)


def _put(target: int, content: bytes) -> None:
    """Write it; a disk that is full must not end who prints."""
    with contextlib.suppress(OSError):
        while content:
            content = content[os.write(target, content) :]


def main(names: Sequence[str]) -> None:
    """Pass standard input on."""
    secrets, out = Secrets.of(names), sys.stdout.buffer
    stream = Stream(secrets)
    while line := sys.stdin.buffer.readline(LINE_LIMIT):
        # What is too long for a record, or the rest of that, is no record.
        out.write(stream.feed(line) if stream.held or not line.endswith(b"\n") else secrets.out_of_record(line))
    out.write(stream.rest())


if __name__ == "__main__":
    main(sys.argv[1:])
