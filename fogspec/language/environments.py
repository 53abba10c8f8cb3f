"""Environments: one overlay for each, in `environments/` beside the specs, with a manifest of its own and no measurement.

What is measured serves all environments of an application, so that an overlay sets only what a choice reads (ADR 0169).
"""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from fogspec.base.diagnostics import Diagnostic, Span
from fogspec.base.layout import DEFAULT_ENVIRONMENT, ENVIRONMENTS, Layout
from fogspec.base.project_files import ProjectFiles
from fogspec.base.yaml.positions import Node, dotted, find, key_span, span_of
from fogspec.base.yaml.positions import Path as Steps
from fogspec.language.documents import Reading, SourceMap, documents_in, unreadable
from fogspec.language.fingerprints import stages_of_fields
from fogspec.language.overlays import SUFFIXES, Overlay
from fogspec.language.schema import Application

NAME = re.compile(r"[a-z0-9]([-a-z0-9]{0,30}[a-z0-9])?")
# A choice reads some of it, but the files are those that were measured, and the results have the benchmark.
NOT_OWN = (("spec", "files"), ("spec", "benchmark"))


def environments_beside(spec: str, texts: SourceMap, wrong: list[Diagnostic], reading: Reading) -> dict[str, Overlay]:
    """Return the overlay of each environment of a spec's project, by its name; what is wrong with a file goes to `wrong`.

    There are none without a folder `specs`: what a single spec has beside it may be anything, such as worlds of a simulator.
    """
    layout = Layout.of(spec, DEFAULT_ENVIRONMENT)
    if layout.root == layout.spec.parent:
        return {}
    folder, files = layout.root / ENVIRONMENTS, layout.files
    found: dict[str, Overlay] = {}
    for name in files.names(folder):
        path = folder / name
        if name.startswith(".") or not name.endswith(SUFFIXES) or not files.is_file(path):
            continue
        stem = path.stem
        if path.suffix != SUFFIXES[0] or NAME.fullmatch(stem) is None or stem == DEFAULT_ENVIRONMENT:
            fix = f"rename it to {ENVIRONMENTS}/NAME.yaml; lower-case letters, digits and -, at most 32"
            what = "taken by the specs themselves" if stem == DEFAULT_ENVIRONMENT else "not a name of an environment"
            shown = name if path.suffix != SUFFIXES[0] else stem
            wrong.append(Diagnostic("FS552", f"{shown} is {what}", Span(str(path), 1, 1), fix))
            continue
        found[stem] = Overlay(str(path), tuple(_documents(path, files, texts, wrong, reading)))
    return found


def folder_of_specs(spec: str) -> str:
    """Return the folder with all specs of a spec's project: `specs` for one that is in it, else its own."""
    layout = Layout.of(spec, DEFAULT_ENVIRONMENT)
    own = layout.spec.parent
    return str(own if layout.root == own else layout.root / "specs")


def _documents(
    path: Path, files: ProjectFiles, texts: SourceMap, wrong: list[Diagnostic], reading: Reading
) -> list[Node]:
    try:
        content = reading.content(str(path), files)
    except OSError as problem:
        texts.lines[str(path)] = []
        wrong.append(unreadable(str(path), problem))
        return []
    nodes, clean = documents_in(content, str(path), texts, wrong, parsed=reading.parsed)
    if clean and not nodes:
        fix = "write what differs, such as spec: {constraints: {cost: $1/1000 requests}}, or remove the file"
        wrong.append(Diagnostic("FS114", "the file is empty: it has no YAML document", Span(str(path), 1, 1), fix))
    return nodes


def shared_fields(
    base: Application, merged: Application, documents: Sequence[Node], environment: str
) -> Iterator[Diagnostic]:
    """Yield an error for each field that `documents` change and that all environments of an application share."""
    before, after = (one.model_dump(mode="json") for one in (base, merged))
    refused = dict.fromkeys(
        _above_items(path) for path, stages in stages_of_fields() if "results" in stages or _unread(path, stages)
    )
    for path in refused:
        if _value(before, path) == _value(after, path):
            continue
        node, at = next(
            (document, path[:size])
            for size in range(len(path), -1, -1)
            for document in reversed(documents)
            if find(document, path[:size]) is not None
        )
        span = key_span(node, at) or span_of(node, at)
        message = f"{dotted(path)} of environment {environment} differs: one measurement serves all environments"
        yield Diagnostic("FS553", message, span, "set it in the spec, or write another application for it")


def _unread(path: Steps, stages: frozenset[str]) -> bool:
    """Return whether a field is of the plan or the lock alone."""
    return path[:2] in NOT_OWN or (bool(stages) and "choice" not in stages)


def _above_items(path: Steps) -> Steps:
    return path[: path.index("*")] if "*" in path else path


def _value(document: object, path: Steps) -> object:
    for step in path:
        document = document.get(str(step)) if isinstance(document, dict) else None
    return document
