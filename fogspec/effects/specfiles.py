"""Reading specs and fogspec's own files: every mistake at once, each at its place, or the typed documents."""

import dataclasses
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel

from fogspec import rules
from fogspec.base.diagnostics import Diagnostic, Place, Problems
from fogspec.base.nodes import Node, key_place, place_of, places
from fogspec.base.nodes import Path as Steps
from fogspec.base.outcomes import WrongFile
from fogspec.base.shape import Checked, check
from fogspec.effects import yamltext
from fogspec.effects.overlays import merge
from fogspec.spec import Application

M = TypeVar("M", bound=BaseModel)

MOST_BYTES_OF_OUR_OWN = 64 << 20


@dataclass
class Texts:
    """The lines of every file that was read, so that a diagnostic can show them."""

    lines: dict[str, list[str]] = field(default_factory=dict)

    def shown(self, diagnostics: Iterable[Diagnostic]) -> list[Diagnostic]:
        """The diagnostics with their source lines, each file's in the order of its lines, errors first at a place."""
        found = [dataclasses.replace(one, source_line=self.line(one.place)) for one in diagnostics]
        files = list(self.lines)
        return sorted(
            found, key=lambda one: (_rank(files, one.place.path), one.place.line, one.place.column, one.severity)
        )

    def line(self, place: Place) -> str | None:
        """The line that a place is on, where its file was read."""
        lines = self.lines.get(place.path, [])
        return lines[place.line - 1] if 0 < place.line <= len(lines) else None


@dataclass(frozen=True)
class LoadedSpec:
    """One `Application` document that is right, and where its values stand.

    `path` is the file as given, `document` counts the file's documents from 0, `places` maps the path of a value
    such as `("spec", "constraints", "cost")` to its place.
    """

    application: Application
    path: str
    document: int
    node: Node
    texts: Texts
    warnings: tuple[Diagnostic, ...]

    @property
    def places(self) -> dict[Steps, Place]:
        """What to underline for every path in the document."""
        return places(self.node)

    def diagnostic(
        self, code: str, path: Steps, message: str, fix: str | None = None, *, at_key: bool = False
    ) -> Diagnostic:
        """A mistake at a path of this document, found later than when it was read."""
        place = (key_place(self.node, path) if at_key else None) or place_of(self.node, path)
        return self.texts.shown([Diagnostic(code, message, place, fix)])[0]


def load(paths: Sequence[str | os.PathLike[str]], overlays: Sequence[str | os.PathLike[str]] = ()) -> list[LoadedSpec]:
    """All applications of the files, each merged with the overlays.

    Raises Problems with every mistake in any of the files.
    """
    found, wrong = examine(paths, overlays)
    if any(one.severity == "error" for one in wrong):
        raise Problems(wrong)
    return found


def examine(
    paths: Sequence[str | os.PathLike[str]], overlays: Sequence[str | os.PathLike[str]] = ()
) -> tuple[list[LoadedSpec], list[Diagnostic]]:
    """The applications that are right, and every mistake and warning about those that are not."""
    texts, wrong = Texts(), list[Diagnostic]()
    layers = [(os.fspath(path), *_documents(path, texts, wrong)) for path in overlays]
    found: list[tuple[str, int, Node, Checked[Application]]] = []
    for path in paths:
        nodes, clean = _documents(path, texts, wrong)
        if not nodes and clean:
            wrong.append(Diagnostic("FS114", "the file must have a document", Place(os.fspath(path), 1, 1)))
        for index, node in enumerate(nodes):
            merged = merge(node, [layer for _, layer, _ in layers])
            checked = check(Application, merged)
            said = {one.place for one in wrong}
            wrong.extend(one for one in (*checked.wrong, *rules.judge(checked, merged)) if one.place not in said)
            found.append((os.fspath(path), index, merged, checked))
    wrong.extend(rules.judge_together([(node, checked) for _, _, node, checked in found]))
    shown = texts.shown(wrong)
    loaded = [
        LoadedSpec(checked.value, path, index, node, texts, _warnings(shown, path))
        for path, index, node, checked in found
        if checked.value is not None
    ]
    return loaded, shown


def read_document(path: str | os.PathLike[str], model: type[M]) -> M:
    """One of fogspec's own files, such as a plan or results.

    Raises Problems when it was edited or cut short, WrongFile when it is not there.
    """
    name, texts, wrong = os.fspath(path), Texts(), list[Diagnostic]()
    if not Path(path).is_file():
        raise WrongFile(f"{name}: there is no such file")
    nodes, clean = _documents(path, texts, wrong, MOST_BYTES_OF_OUR_OWN)
    if clean and len(nodes) != 1:
        wrong.append(Diagnostic("FS701", "the file must have one document", Place(name, 1, 1)))
    checked = check(model, nodes[0], strict=False) if clean and len(nodes) == 1 else None
    wrong.extend(checked.wrong if checked else [])
    if checked is None or checked.value is None:
        raise Problems(texts.shown(_remade(one, texts) for one in wrong))
    return checked.value


def read_nodes(path: str | os.PathLike[str]) -> tuple[list[Node], Texts]:
    """The documents of a file as trees, right or wrong; raises Problems when it is no YAML."""
    texts, wrong = Texts(), list[Diagnostic]()
    nodes, clean = _documents(path, texts, wrong)
    if not clean:
        raise Problems(texts.shown(wrong))
    return nodes, texts


def _documents(
    path: str | os.PathLike[str], texts: Texts, wrong: list[Diagnostic], most_bytes: int = yamltext.MOST_BYTES
) -> tuple[list[Node], bool]:
    """The documents of a file, and whether the file could be read to its end."""
    name = os.fspath(path)
    if name in texts.lines:
        wrong.append(Diagnostic("FS101", "the file must be named only once", Place(name, 1, 1)))
        return [], False
    texts.lines[name] = []
    try:
        content = _content(Path(path), most_bytes)
    except OSError as problem:
        wrong.append(
            Diagnostic(
                "FS101", f"the file cannot be read: {(problem.strerror or str(problem)).lower()}", Place(name, 1, 1)
            )
        )
        return [], False
    text, problems = yamltext.decode(content, name, most_bytes)
    texts.lines[name] = text.split("\n")
    nodes: list[Node] = []
    if not problems:
        nodes, problems = yamltext.documents(text, name)
    wrong.extend(problems)
    return [node for node in nodes if not node.empty], not problems


def _content(path: Path, most_bytes: int) -> bytes:
    with path.open("rb") as file:
        return file.read(most_bytes + 1)


def _remade(one: Diagnostic, texts: Texts) -> Diagnostic:
    """The diagnostic of a generated file: it is mended by making the file again, not by hand."""
    first = texts.lines.get(one.place.path, [""])[0]
    command = first.partition("Make it again: ")[2].strip()
    return dataclasses.replace(one, fix=f"make it again: {command}") if command else one


def _warnings(shown: list[Diagnostic], path: str) -> tuple[Diagnostic, ...]:
    return tuple(one for one in shown if one.severity == "warning" and one.place.path == path)


def _rank(files: list[str], path: str) -> Any:
    return files.index(path) if path in files else len(files)
