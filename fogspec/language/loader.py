"""Load specs and fogspec's own files: the typed documents, or every error at once, each with its span."""

import copy
import dataclasses
import os
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from fogspec.base.diagnostics import Diagnostic, DiagnosticError, Span
from fogspec.base.errors import InvalidInput
from fogspec.base.files import read_file
from fogspec.base.layout import DEFAULT_ENVIRONMENT, Layout
from fogspec.base.project_files import ProjectFiles
from fogspec.base.redaction import register
from fogspec.base.text import shell, shell_command
from fogspec.base.yaml import reader
from fogspec.base.yaml.positions import Node, find, key_span, plain, span_of, spans
from fogspec.base.yaml.positions import Path as Steps
from fogspec.language import rules
from fogspec.language.documents import Reading, SourceMap, documents_in, documents_of, unreadable
from fogspec.language.environments import environments_beside, folder_of_specs, shared_fields
from fogspec.language.files_there import missing_files, shared_folder
from fogspec.language.lockfile import PUBLIC_LOGIN
from fogspec.language.overlays import NAME, Overlay, merge
from fogspec.language.rules.benchmark import PLACEHOLDERS, sender
from fogspec.language.schema import Application
from fogspec.language.tree import sent_tree, specs_in
from fogspec.language.validate import ANOTHER, Validation, validate

M = TypeVar("M", bound=BaseModel)

UNKNOWN, UPGRADE = "FS301", "upgrade fogspec: pip install --upgrade fogspec"
MOST_BYTES_OF_OUR_OWN = reader.MOST_BYTES_OF_CANONICAL


@dataclass(frozen=True, kw_only=True)
class LoadedSpec:
    """One valid `Application` document, and the spans of its values.

    `path` is the file as given, `document` counts the file's documents from 0. In an environment, `node` is merged with the
    `overlay`, and `base` is the application without it, whose measurement it shares. `infra` are the places of the
    application in all of its environments, which have one catalog.
    """

    application: Application
    path: str
    document: int
    node: Node
    texts: SourceMap
    warnings: tuple[Diagnostic, ...]
    infra: tuple[str, ...]
    overlay: Overlay | None = None
    base: "LoadedSpec | None" = None

    @property
    def name(self) -> str:
        """The name of the application, with `@` and the environment behind it unless that is the default one."""
        return self.application.name

    @property
    def layout(self) -> Layout:
        """The paths of the application's files."""
        return Layout.of(self.path, self.name)

    @property
    def spans(self) -> dict[Steps, Span]:
        """Return what to underline for every path in the document."""
        return spans(self.node)

    def diagnostic(
        self, code: str, path: Steps, message: str, fix: str | None = None, *, at_key: bool = False
    ) -> Diagnostic:
        """Return an error at a path of this document that was found after loading."""
        span = (key_span(self.node, path) if at_key else None) or span_of(self.node, path)
        return self.texts.shown([Diagnostic(code, message, span, fix)])[0]

    def absent(self, measured: bool = True) -> list[Diagnostic]:
        """Return an error for each file and package beside the spec that it names and that is not there.

        `measured` says whether what sends requests counts too.
        """
        if any(one.code == PLACEHOLDERS for one in self.warnings):
            return []  # what `init` made up is not there, and is said itself
        tree = sent_tree(self.application, self.layout)
        found = missing_files(self.application, Path(self.path).parent, tree, measured)
        return [self.diagnostic(one.code, one.path, one.message, one.fix) for one in found]


def load(paths: Sequence[str | os.PathLike[str]], reading: Reading | None = None) -> list[LoadedSpec]:
    """Return all applications of the files, and behind each those of its environments; `reading` is what was read before.

    Raise DiagnosticError with every error in any of the files.
    """
    found, wrong = check_file(paths, reading)
    if any(one.severity == "error" for one in wrong):
        raise DiagnosticError(wrong)
    return found


def check_file(
    paths: Sequence[str | os.PathLike[str]], reading: Reading | None = None
) -> tuple[list[LoadedSpec], list[Diagnostic]]:
    """Return the valid applications, and all errors and warnings; `reading` is what was read before."""
    texts, wrong, known = SourceMap(), list[Diagnostic](), Reading() if reading is None else reading
    files = [(os.fspath(path), *documents_of(path, texts, wrong, known)) for path in paths]
    return _checked(files, [], texts, wrong, known)


def check_text(
    content: bytes, path: str, overlay: tuple[bytes, str] | None = None
) -> tuple[list[LoadedSpec], list[Diagnostic]]:
    """Return the same for content that is not, or not yet, in the file at `path`, merged with the content of an overlay."""
    texts, wrong = SourceMap(), list[Diagnostic]()
    layers = [] if overlay is None else [Overlay(overlay[1], tuple(documents_in(*overlay, texts, wrong)[0]))]
    return _checked(
        [(path, *documents_in(content, path, texts, wrong))], layers, texts, wrong, Reading(), on_disk=False
    )


def _checked(
    files: Sequence[tuple[str, list[Node], bool]],
    layers: Sequence[Overlay],
    texts: SourceMap,
    wrong: list[Diagnostic],
    reading: Reading,
    on_disk: bool = True,
) -> tuple[list[LoadedSpec], list[Diagnostic]]:
    found: list[tuple[str, int, Node, Validation[Application]]] = []
    refused = {one.span for one in wrong}
    roots = {_root(path): path for path, _, _ in files} if on_disk else {}
    environments = {root: environments_beside(path, texts, wrong, reading) for root, path in roots.items()}
    for path, nodes, clean in files:
        if not nodes and clean:
            wrong.append(_nothing_in(path, texts.last_line(path)))
        for index, node in enumerate(nodes):
            merged = merge(node, layers)
            checked = _validated(merged)
            found_wrong = [*checked.wrong, *rules.run_rules(checked)]
            if on_disk and checked.value is not None:
                found_wrong += _alone(checked, checked.value, path, len(nodes))
            found_wrong += _sender(checked, found_wrong) if on_disk else ()
            said = [one for one in found_wrong if one.span not in refused]
            wrong.extend(texts.at_the_cut(said) if index == len(nodes) - 1 else said)
            found.append((path, index, merged, checked))
    wrong.extend(rules.run_rules_together([(node, checked) for _, _, node, checked in found]))
    names = [
        one.value for _, _, node, _ in found if (one := find(node, NAME)) is not None and isinstance(one.value, str)
    ]
    for overlay in (*layers, *(one for them in environments.values() for one in them.values())):
        wrong.extend(overlay.unknown(names, [folder_of_specs(path) for path in roots.values()], reading))
    before = list(wrong)
    merged_for = [_in_environments(one, environments.get(_root(one[0]), {}), before, wrong) for one in found]
    shown = texts.shown(dict.fromkeys(wrong))
    warnings = [one for one in shown if one.severity == "warning"]
    loaded = list[LoadedSpec]()
    for (path, index, node, checked), others in zip(found, merged_for, strict=True):
        if checked.value is None:
            continue
        places = [place for one in (checked.value, *(app for app, _, _ in others)) for place in one.spec.infra]
        default = LoadedSpec(
            application=checked.value,
            path=path,
            document=index,
            node=node,
            texts=texts,
            warnings=tuple(one for one in warnings if one.span.path == path),
            infra=tuple(dict.fromkeys(places)),
        )
        loaded.append(default)
        for application, overlay, merged in others:
            own = tuple(warning for warning in warnings if warning.span.path == overlay.path)
            loaded.append(
                dataclasses.replace(
                    default,
                    application=application,
                    node=merged,
                    warnings=(*default.warnings, *own),
                    overlay=overlay,
                    base=default,
                )
            )
    return loaded, shown


def _validated(node: Node) -> Validation[Application]:
    """Return the checked application, whose secrets are in no text from now on."""
    checked = validate(Application, node)
    if checked.value is not None:
        register(set(checked.value.spec.secrets) - PUBLIC_LOGIN)
    return checked


def _root(path: str) -> Path:
    return Layout.of(path, DEFAULT_ENVIRONMENT).root


def _in_environments(
    one: tuple[str, int, Node, Validation[Application]],
    environments: Mapping[str, Overlay],
    before: Sequence[Diagnostic],
    wrong: list[Diagnostic],
) -> list[tuple[Application, Overlay, Node]]:
    """Return the valid applications that overlays make of one; what is wrong with others goes to `wrong`.

    `before` are the diagnostics without environments. What an overlay makes wrong elsewhere names the environment.
    """
    path, _, node, checked = one
    base, found = checked.value, []
    if base is None or any(said.severity == "error" and said.span.path == path for said in before):
        return []
    for name, overlay in environments.items():
        documents = overlay.applying(node)
        if not documents:
            continue
        merged = merge(node, [overlay])
        again = _validated(merged)
        said = [*again.wrong, *rules.run_rules(again)]
        if again.value is not None:
            said += shared_fields(base, again.value, documents, name)
        for diagnostic in said:
            if diagnostic.span.path == overlay.path:
                wrong.append(diagnostic)
            elif not any(known.code == diagnostic.code and known.span == diagnostic.span for known in before):
                message = f"in environment {name}: {diagnostic.message}"
                wrong.append(dataclasses.replace(diagnostic, message=message))
        if again.value is not None and not any(diagnostic.severity == "error" for diagnostic in said):
            found.append((again.value.in_environment(name), overlay, merged))
    return found


def _alone(
    checked: Validation[Application], application: Application, path: str, documents: int
) -> Iterator[Diagnostic]:
    """Yield that an application shares its directory with other specs, and does not name its files."""
    folder, name = Path(path).parent, Path(path).name

    def others() -> Iterator[str]:
        yield from specs_in(folder, name)
        if documents > 1:
            yield f"other applications in {name}"

    for one in shared_folder(application, folder, others()):
        yield Diagnostic(one.code, one.message, span_of(checked.node, one.path), one.fix)


def _nothing_in(path: str, line: int) -> Diagnostic:
    """Return the diagnostic of a file without a document."""
    fix = f"replace it by a complete spec: rm {shell(path)}; {shell_command('fogspec', 'init', path)}"
    return Diagnostic("FS114", "the file is empty: it has no YAML document", Span(path, line, 1), fix)


def _sender(checked: Validation[Application], wrong: Sequence[Diagnostic]) -> Iterator[Diagnostic]:
    """Yield that nothing sends requests, of a spec that is right."""
    if checked.value is None or any(one.severity == "error" for one in wrong):
        return
    for one in sender(checked.value):
        yield Diagnostic(one.code, one.message, span_of(checked.node, one.path), one.fix, severity=one.severity)


class SourceFile:
    """One of fogspec's own files: read once, and parsed once, when its document is first needed.

    `content` are its bytes, none if it could not be read: `problem` says why.
    """

    def __init__(self, path: str | os.PathLike[str], content: bytes, problem: OSError | None = None) -> None:
        self.name = os.fspath(path)
        self.content = content
        self.problem = problem
        self._documents: dict[type[BaseModel], BaseModel] = {}

    @classmethod
    def read(cls, path: str | os.PathLike[str], files: ProjectFiles | None = None) -> "SourceFile":
        """Read the file; a file that cannot be read is reported when its document is read.

        `files` reads what is in a project, and raises LinkedPath for a link; without it, the path is the user's own word.
        """
        try:
            most = MOST_BYTES_OF_OUR_OWN + 1
            return cls(path, read_file(path, most) if files is None else files.head(Path(path), most))
        except OSError as problem:
            return cls(path, b"", problem)

    @cached_property
    def _parsed(self) -> tuple[list[Node], SourceMap, tuple[Diagnostic, ...]]:
        texts, wrong = SourceMap({self.name: []}), list[Diagnostic]()
        if self.problem is not None:
            return [], texts, (unreadable(self.name, self.problem),)
        nodes, _ = documents_in(self.content, self.name, texts, wrong, MOST_BYTES_OF_OUR_OWN)
        return nodes, texts, tuple(wrong)

    @property
    def nodes(self) -> list[Node]:
        """The documents of the file as trees, as far as it can be parsed."""
        return self._parsed[0]

    @property
    def texts(self) -> SourceMap:
        """The lines of the file."""
        return self._parsed[1]

    def document(self, model: type[M]) -> M:
        """Return the file's one document as `model`; raise DiagnosticError if it was edited or cut short."""
        known = self._documents.get(model) or self._canonical_document(model)
        if isinstance(known, model):
            return known
        nodes, texts, problems = self._parsed
        wrong = list(problems)
        if not wrong and len(nodes) != 1:
            wrong.append(Diagnostic("FS701", "the file must have one document", Span(self.name, 1, 1)))
        checked = None if wrong else validate(model, nodes[0], strict=False)
        wrong.extend(checked.wrong if checked else [])
        if checked is None or checked.value is None:
            wrong = list(filter(None, map(_newer, wrong))) or [_recompiled(one, texts) for one in wrong]
            raise DiagnosticError(texts.shown(wrong))
        self._documents[model] = checked.value
        return checked.value

    @cached_property
    def _canonical(self) -> dict[str, Any] | None:
        """The values of the file if it is what fogspec writes, byte for byte."""
        return None if self.problem is not None else reader.canonical(self.content)

    def _canonical_document(self, model: type[M]) -> M | None:
        """Return the document of a file that fogspec wrote and that is valid; None for one whose mistakes are to be located."""
        if self._canonical is None:
            return None
        try:
            found = model.model_validate(self._canonical, strict=False)
        except ValidationError:
            return None
        self._documents[model] = found
        return found

    def plain(self) -> Any:
        """Return the first document in plain values, None without one; raise DiagnosticError if it is not YAML."""
        if self._canonical is not None:
            return copy.deepcopy(self._canonical)
        nodes, texts, wrong = self._parsed
        if wrong:
            raise DiagnosticError(texts.shown(wrong))
        return plain(nodes[0]) if nodes else None


def read_document(path: str | os.PathLike[str], model: type[M], files: ProjectFiles | None = None) -> M:
    """Return one of fogspec's own files, such as a plan or results, checked against its types; see `SourceFile.read`.

    Raise DiagnosticError if it was edited or cut short, InvalidInput if it does not exist.
    """
    if not os.path.lexists(path):
        raise InvalidInput(f"{os.fspath(path)}: there is no such file")
    return SourceFile.read(path, files).document(model)


def read_nodes(path: str | os.PathLike[str], content: bytes | None = None) -> tuple[list[Node], SourceMap]:
    """Return the documents of a file as trees, valid or not; raise DiagnosticError if it is not YAML.

    `content` replaces the content of the file.
    """
    texts, wrong = SourceMap(), list[Diagnostic]()
    if content is None:
        nodes, clean = documents_of(path, texts, wrong, Reading())
    else:
        nodes, clean = documents_in(content, os.fspath(path), texts, wrong)
    if not clean:
        raise DiagnosticError(texts.shown(wrong))
    return nodes, texts


def read_plain(path: str | os.PathLike[str], content: bytes | None = None) -> Any:
    """Return the first document of a file as plain values, None if there is none; raise DiagnosticError if it is not YAML."""
    nodes, _ = read_nodes(path, content)
    return plain(nodes[0]) if nodes else None


def _newer(one: Diagnostic) -> Diagnostic | None:
    """Return the diagnostic of a field that only another version knows; None for another mistake, or a misspelt field."""
    if one.code != UNKNOWN or (one.fix or "").startswith("write "):
        return None
    field = one.message.partition(" is not ")[0]
    return dataclasses.replace(one, message=f"{field} is written by a newer fogspec", fix=UPGRADE)


def _recompiled(one: Diagnostic, texts: SourceMap) -> Diagnostic:
    """Return the diagnostic of a generated file, which is repaired by generating it again, unless it is another file."""
    if (one.fix or "").startswith(ANOTHER):
        return one
    first = next(iter(texts.lines.get(one.span.path, [])), "")
    commands = first.strip().removeprefix("# Generated by ").removesuffix(": do not edit").split("; ")
    if not all(map(_is_ours, commands)):
        return one  # the file may be anybody's
    return dataclasses.replace(one, fix=f"make it again: {'; '.join(commands)}")


def _is_ours(command: str) -> bool:
    """Return whether a command runs fogspec and nothing else, whatever is in the words after that."""
    try:
        words = shlex.split(command)
    except ValueError:
        return False
    return words[:1] == ["fogspec"] and shell_command(*words) == command
