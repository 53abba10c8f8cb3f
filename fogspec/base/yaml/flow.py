"""Values as YAML that fogspec reads back as the same values: in one line, or in a block of lines."""

import json
import re
from collections.abc import Iterator, Mapping
from typing import Any

from fogspec.base.yaml.positions import Path
from fogspec.base.yaml.scalars import HIDDEN, resolve

PLAIN = re.compile(r"[A-Za-z0-9_/$.~](?:[-A-Za-z0-9_./$%+=*@ ]|:(?=[^\s,\]}]))*(?<! )")


def flow(value: Any) -> str:
    """The value in flow style: `{a: [1, two], b: 'no'}`; floats keep their point, texts get quotes where needed."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{flow(str(key))}: {flow(one)}" for key, one in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(flow, value)) + "]"
    if isinstance(value, str):
        plain = PLAIN.fullmatch(value) and resolve(value) == value and isinstance(resolve(value), str)
        return (
            value if plain else HIDDEN.sub(lambda one: f"\\u{ord(one[0]):04x}", json.dumps(value, ensure_ascii=False))
        )
    return json.dumps(value)


def block(value: Mapping[str, Any], path: Path = (), indent: str = "") -> Iterator[tuple[str, Path]]:
    """The mapping in block style: lines, each with the path of what it says. Maps and lists of maps take lines of their own."""
    for key, child in value.items():
        at, name = (*path, key), f"{indent}{flow(key)}:"
        if isinstance(child, Mapping) and child:
            yield name, at
            yield from block(child, at, f"{indent}  ")
        elif isinstance(child, list) and any(isinstance(item, Mapping) for item in child):
            yield name, at
            for i, item in enumerate(child):
                yield from _item(item, (*at, i), f"{indent}  ")
        else:
            yield f"{name} {flow(child)}", at


def _item(item: Any, path: Path, indent: str) -> Iterator[tuple[str, Path]]:
    if not isinstance(item, Mapping) or not item:
        yield f"{indent}- {flow(item)}", path
        return
    for i, (line, at) in enumerate(block(item, path, f"{indent}  ")):
        yield (f"{indent}- {line[len(indent) + 2 :]}" if i == 0 else line), at
