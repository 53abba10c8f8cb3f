"""Reading YAML 1.2 as data: bytes in, trees of values with their places out, every refusal located.

The parser is ruamel.yaml's; what becomes of its events is ours, because a spec needs exact places, bounded
aliases, and one meaning for every scalar.
"""

import itertools
import re
from collections.abc import Iterator
from typing import Any

from fogspec.base.diagnostics import Diagnostic, Span
from fogspec.base.yaml.hints import syntax_hint
from fogspec.base.yaml.positions import Node
from fogspec.base.yaml.scalars import HIDDEN, Refusal, resolve
from fogspec.base.yaml.writer import body_text

MOST_BYTES = 1 << 20
MOST_BYTES_OF_CANONICAL = 64 << 20
MOST_NODES = 100_000
DEEPEST = 64
UNUSABLE = re.compile("[\x00\ud800-\udfff]")


class _Stop(Exception):
    """Reading a file cannot continue."""


def decode(content: bytes, path: str, most_bytes: int = MOST_BYTES) -> tuple[str, list[Diagnostic]]:
    """Return the text of a UTF-8 file with LF line ends, or the reason why it is not one."""
    if len(content) > most_bytes:
        fix = "keep data in files of their own"
        return "", [Diagnostic("FS112", f"a file may have at most {most_bytes >> 20} MiB", Span(path, 1, 1), fix)]
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as wrong:
        before = content[: wrong.start].decode("utf-8", "replace")
        span = Span(path, before.count("\n") + 1, len(before.rpartition("\n")[2]) + 1)
        fix = "save the file as UTF-8"
        if content[:2] in (b"\xff\xfe", b"\xfe\xff") or b"\x00" in content[:64]:
            return "", [Diagnostic("FS102", "the file must be in UTF-8, this looks like UTF-16", span, fix)]
        message = f"the file must be in UTF-8, byte 0x{content[wrong.start]:02x} is not"
        return "", [Diagnostic("FS102", message, span, fix)]
    text = text.replace("\r\n", "\n")
    found = HIDDEN.search(text)
    if not found:
        return text, []
    before, character = text[: found.start()], ord(found[0])
    span = Span(path, before.count("\n") + 1, len(before.rpartition("\n")[2]) + 1)
    return text, [Diagnostic("FS103", f"the control character U+{character:04X} is not text", span, "remove it")]


def documents(text: str, path: str) -> tuple[list[Node], list[Diagnostic]]:
    """Return the documents of a text, as far as it can be read, and all errors in it as YAML."""
    composer = _Composer(text, path)
    try:
        found = list(composer.documents())
    except _Stop:
        found = composer.done
    return found, composer.wrong


def canonical(content: bytes) -> dict[str, Any] | None:
    """Return the values of a file that `yaml_text` wrote, many times faster than `documents`; None for any other content.

    A parser in C reads it. That parser knows other versions of YAML and other limits, so its values count only if they make
    the same bytes again: then they are what was written, and what `documents` reads.
    """
    head, _, body = content.partition(b"\n")
    if not head.startswith(b"# ") or len(content) > MOST_BYTES_OF_CANONICAL:
        return None
    try:
        from yaml.cyaml import CParser
        from yaml.error import YAMLError
    except ImportError:  # PyYAML was built without its C library
        return None
    try:
        text = content.decode()
        found = _values(CParser(body))
        same = isinstance(found, dict) and not HIDDEN.search(text) and body_text(found).encode() == body
    except (YAMLError, ValueError, TypeError, RecursionError):
        return None
    return found if same else None


def _values(parser: Any) -> Any:
    """Return the value of the only document in a parser's events; raise ValueError for what is not canonical."""
    stack: list[tuple[Any, list[Any]]] = []  # the container of each level, and its items so far: keys, and values
    found: list[Any] = []
    for count in itertools.count():
        event = parser.get_event()
        if event is None:
            break
        kind = type(event).__name__
        if kind == "ScalarEvent":
            value = event.value if event.style else resolve(event.value)
            if event.anchor or event.tag or isinstance(value, Refusal) or UNUSABLE.search(event.value):
                raise ValueError("not canonical")
        elif kind in ("MappingStartEvent", "SequenceStartEvent"):
            if len(stack) >= DEEPEST or event.anchor or event.tag:
                raise ValueError("not canonical")
            stack.append((dict if kind[0] == "M" else list, []))
            continue
        elif kind in ("MappingEndEvent", "SequenceEndEvent"):
            made, items = stack.pop()
            value = dict(zip(items[::2], items[1::2], strict=True)) if made is dict else items
        elif kind == "AliasEvent":
            raise ValueError("not canonical")
        else:
            continue
        if count > MOST_NODES:
            raise ValueError("not canonical")
        (stack[-1][1] if stack else found).append(value)
    if len(found) != 1:
        raise ValueError("not canonical")
    return found[0]


class _Composer:
    def __init__(self, text: str, path: str) -> None:
        self.text = text
        self.path = path
        self.wrong: list[Diagnostic] = []
        self.done: list[Node] = []
        self.anchors: dict[str, Node] = {}
        self.nodes = 0
        self.events = self._events()

    def documents(self) -> Iterator[Node]:
        from ruamel.yaml.events import DocumentStartEvent

        for event in self.events:
            if isinstance(event, DocumentStartEvent):
                self.anchors = {}
                node = self._node(next(self.events), 0)
                self.done.append(node)
                yield node

    def _events(self) -> Iterator[Any]:
        from ruamel.yaml import YAML
        from ruamel.yaml.error import MarkedYAMLError, YAMLError

        try:
            yield from YAML(typ="safe", pure=True).parse(self.text)
        except MarkedYAMLError as wrong:
            self._syntax(wrong)
            raise _Stop from None
        except (YAMLError, ValueError, IndexError, AssertionError, RecursionError) as wrong:
            self._refuse("FS104", f"the text must be YAML: {wrong}".splitlines()[0], Span(self.path, 1, 1))
            raise _Stop from None

    def _syntax(self, wrong: Any) -> None:
        found = syntax_hint(self.text.split("\n"), wrong)
        self._refuse(
            found.code, found.message, Span(self.path, found.line + 1, found.column + 1, found.width), found.fix
        )

    def _refuse(self, code: str, message: str, span: Span, fix: str | None = None) -> None:
        self.wrong.append(Diagnostic(code, message, span, fix))

    def _span(self, event: Any) -> Span:
        start, end = event.start_mark, event.end_mark
        end_of_line = self.text.find("\n", start.index)
        width = (end.index if end.line == start.line else end_of_line) - start.index
        return Span(self.path, start.line + 1, start.column + 1, max(1, width))

    def _node(self, event: Any, depth: int) -> Node:
        from ruamel.yaml.events import AliasEvent, MappingStartEvent, ScalarEvent

        span = self._span(event)
        if isinstance(event, AliasEvent):
            return self._alias(event, span)
        if depth > DEEPEST:
            self._refuse("FS112", f"a file may be nested at most {DEEPEST} deep", span)
            raise _Stop
        self._count(1, span)
        if event.ctag is not None:
            tag = str(event.ctag).replace("tag:yaml.org,2002:", "!!")
            self._refuse("FS109", f"the tag {tag} is not supported in a spec", span, "remove it")
        if isinstance(event, ScalarEvent):
            node = self._scalar(event, span)
        elif isinstance(event, MappingStartEvent):
            node = self._mapping(span, depth)
        else:
            node = self._sequence(span, depth)
        if event.anchor is not None:
            self.anchors[event.anchor] = node
        return node

    def _count(self, nodes: int, span: Span) -> None:
        self.nodes += nodes
        if self.nodes > MOST_NODES:
            self._refuse("FS107", f"a file may have at most {MOST_NODES} values, aliases counted each time", span)
            raise _Stop

    def _alias(self, event: Any, span: Span) -> Node:
        node = self.anchors.get(event.anchor)
        if node is None:
            self._refuse("FS107", f"the anchor &{event.anchor} must be complete before *{event.anchor}", span)
            return Node(value=None, span=span)
        self._count(node.size, span)
        return node

    def _scalar(self, event: Any, span: Span) -> Node:
        if found := UNUSABLE.search(event.value):
            self._refuse(
                "FS103", f"the character U+{ord(found[0]):04X} is not text", span, "remove its escape sequence"
            )
            return Node(value="", span=span, quoted=True)
        if event.style is not None or not event.implicit[0]:
            return Node(value=event.value, span=span, text=event.value, quoted=True)
        value = resolve(event.value)
        if isinstance(value, Refusal):
            self._refuse(value.code, value.message, span, value.fix)
            value = event.value
        return Node(value=value, span=span, text=event.value, empty=event.value == "")

    def _mapping(self, span: Span, depth: int) -> Node:
        from ruamel.yaml.events import MappingEndEvent

        values: dict[str, Node] = {}
        node = Node(value=values, span=span)
        while not isinstance(event := next(self.events), MappingEndEvent):
            key = self._node(event, depth + 1)
            value = self._node(next(self.events), depth + 1)
            name = self._key(key, values, node)
            if name is not None:
                values[name] = value
                node.keys[name] = key.span
            node.size += key.size + value.size
        return node

    def _key(self, key: Node, values: dict[str, Node], node: Node) -> str | None:
        if isinstance(key.value, (dict, list)) or key.empty or (not key.quoted and key.value is None):
            self._refuse("FS113", "a key must be a string", key.span)
            return None
        if key.text == "<<" and not key.quoted:
            self._refuse(
                "FS108", "merge keys are not part of YAML 1.2", key.span, "write the keys out, or use an overlay"
            )
            return None
        if key.text in values:
            earlier = node.keys[key.text].line
            self._refuse(
                "FS106",
                f"{key.text} is already set on line {earlier}",
                key.span,
                "remove one of the two" if earlier == key.span.line else f"remove this line, or line {earlier}",
            )
            return None
        return key.text

    def _sequence(self, span: Span, depth: int) -> Node:
        from ruamel.yaml.events import SequenceEndEvent

        items: list[Node] = []
        node = Node(value=items, span=span)
        while not isinstance(event := next(self.events), SequenceEndEvent):
            items.append(self._node(event, depth + 1))
            node.size += items[-1].size
        return node
