"""What a launch file starts elsewhere: it is read as if packages were installed in several places; what differs is left out."""

import json
import os
import re
from collections.abc import Callable, Iterator, Sequence
from itertools import chain
from typing import TYPE_CHECKING, Any

from fogspec.importers.launch.found import COMPUTED, WRITTEN

if TYPE_CHECKING:
    from fogspec.importers.launch.answer import Answer, At, Started

PACKAGE = re.compile(r"\$\(find-pkg-(share|prefix) ?([\w.-]*)\)")
PROGRAM = ("package", "executable", "plugin", "cmd")
LISTED = {"parameter_files": "a parameter file", "launch": "prefix or respawn"}
EACH = {"env": "the environment variable", "parameters": "the parameter", "remappings": "the remapping"}
MOVED = "whether this starts depends on where packages are installed"
Note = Callable[["At | None", str], None]


def leave_out(answer: "Answer", others: Sequence["Answer"], path: str) -> None:
    """Take from the answer about a launch file what differs in the others, which are those of other places, and note it."""

    def note(place: "At | None", message: str) -> None:
        answer.notes.append((*(place or (path, 1, 1, 1)), message))

    for other in others:
        for name in _differing(answer.files, other.files):
            answer.files.pop(name, None)
            for node in [*answer.cloud, *answer.robot]:
                if (file := f"{WRITTEN}{name}") in node.parameter_files:
                    node.parameter_files.remove(file)
                    note(node.place, f"a parameter file of {_label(node)} is not taken over: {COMPUTED}")
        for name in ("constraints", "objective", "hardware", "stop", "probe", "defaults"):
            mine = getattr(answer, name)
            for key in _differing(mine, getattr(other, name)):
                mine.pop(key, None)
                note(None, f"{key} of {name} is not taken over: {COMPUTED}")
        for name in ("infra", "image", "setup"):
            if not _is_same(getattr(answer, name), getattr(other, name)):
                setattr(answer, name, None if name == "image" else [])
                note(None, f"{name} is not taken over: {COMPUTED}")
        if other.failed is not None:
            note(
                other.failed[1], f"where packages are installed elsewhere, the launch file ends here: {other.failed[0]}"
            )
    for name in ("cloud", "robot"):
        setattr(answer, name, list(_steady(getattr(answer, name), [getattr(one, name) for one in others], note)))


def _steady(nodes: Sequence["Started"], elsewhere: Sequence[Sequence["Started"]], note: Note) -> Iterator["Started"]:
    """Yield the nodes without what differs."""
    left = [list(some) for some in elsewhere]
    for node in nodes:
        twins = [next((one for one in some if one.place == node.place), None) for some in left]
        for some, twin in zip(left, twins, strict=True):
            if twin is None:
                note(node.place, f"{MOVED}: it is taken as started")
            else:
                some.remove(twin)
        there = [twin for twin in twins if twin is not None]
        if all(_is_same(getattr(node, name), getattr(twin, name)) for name in PROGRAM for twin in there):
            _one(node, there, note)
            yield node
        else:
            note(node.place, f"{_label(node)} is not taken over: {COMPUTED}")
    for one in chain(*left):
        note(one.place, f"{MOVED}: what starts is left out")


def _one(node: "Started", twins: Sequence["Started"], note: Note) -> None:
    place, label = node.place, _label(node)
    for name in sorted(type(node).model_fields.keys() - {"place", *PROGRAM}):
        mine, others = getattr(node, name), [getattr(twin, name) for twin in twins]
        if all(_is_same(mine, other) for other in others):
            continue
        if name == "composable_node_descriptions":
            node.composable_node_descriptions = list(_steady(mine, others, lambda at, said: note(at or place, said)))
        elif isinstance(mine, dict):
            for key in chain(*(_differing(mine, other) for other in others)):
                mine.pop(key, None)
                note(place, f"{EACH.get(name, name)} {key} of {label} is not taken over: {COMPUTED}")
        else:
            setattr(node, name, type(node).model_fields[name].get_default())
            note(
                place,
                f"{LISTED.get(name, name)} of {label} {'are' if name == 'arguments' else 'is'} not taken over: {COMPUTED}",
            )


def _label(node: "Started") -> str:
    return node.name or node.executable or node.plugin or os.path.basename((node.cmd or [""])[0])


def _differing(mine: dict[str, Any], other: dict[str, Any]) -> list[str]:
    absent = object()
    return sorted(
        key for key in mine.keys() | other.keys() if not _is_same(mine.get(key, absent), other.get(key, absent))
    )


def _is_same(one: Any, other: Any) -> bool:
    return _plain(one) == _plain(other)


def _plain(value: Any) -> str:
    """Return a value as text, in which each package has the same prefix."""
    text = json.dumps(value, default=repr, sort_keys=True)
    text = PACKAGE.sub(lambda match: "$(prefix)" + (f"/share/{match[2]}" if match[1] == "share" else ""), text)
    return re.sub(r"\$\(prefix\)/share/[\w.-]+/\.\.(?![\w.-])", "$(prefix)/share", text)
