"""A team's own rules: JSON Schemas (2020-12) that specs and manifests must meet besides the rules of the spec schema.

A policy is a file `policies/*.schema.json` next to `specs/`, or one that the command line names. `properties.kind.const`
says which kind of document it is about, `Application` unless it is given. It sees the document with defaults filled in
and quantities as numbers in base units (`fogspec.language.render.numeric_document`). Nothing is ever fetched for a `$ref`.
"""

import json
import os
import pathlib
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from types import MappingProxyType
from typing import Any, TypeVar

from pydantic import BaseModel

from fogspec.base.diagnostics import Diagnostic, DiagnosticError, Span
from fogspec.base.signals import TookTooLong, Used, processor_time
from fogspec.base.yaml import reader
from fogspec.base.yaml.positions import Node, Path, dotted, find, span_of
from fogspec.language.documents import SourceMap, unreadable
from fogspec.language.introspect import fields_of, part
from fogspec.language.loader import LoadedSpec, SourceFile
from fogspec.language.render import numeric_document
from fogspec.language.suggest import closest

FOLDER, SUFFIX = "policies", ".schema.json"
APPLICATION, MANIFEST = "Application", "DeploymentManifest"
DIALECT = "https://json-schema.org/draft/2020-12/schema"
SAME_PLACE = ("allOf", "anyOf", "oneOf", "not", "if", "then", "else", "dependentSchemas")
LONGEST = 160
MOST_SECONDS = 5.0  # of processor time for one policy: a regular expression may take for ever
# For all of a command, beyond what each may take of a document: a project with many specs is no slow policy.
MOST_SECONDS_TOGETHER, FREE_SECONDS = 20.0, 0.1
Files = Mapping[pathlib.Path, SourceFile]
Found = TypeVar("Found")
NO_FILES: Files = MappingProxyType({})


@dataclass(frozen=True, slots=True)
class Policy:
    """A policy file that is a JSON Schema, and the kind of document that it is about."""

    path: str
    text: str
    kind: str
    schema: dict[str, Any]

    def diagnostic(self, message: str, path: Path = (), fix: str | None = None) -> Diagnostic:
        """Return a mistake in the policy itself, at a path of it."""
        return Diagnostic("FS602", message, _span(self.text, self.path, path), fix)


@dataclass(slots=True)
class Policies:
    """The policies of the projects that are checked, each read once, and those in `named` for all of them.

    `before` are those of each project that a change edited or removed, as they were: the name that is shown, and the content.
    `read` are policies that were read already.
    """

    named: Sequence[str] = ()
    before: Mapping[str, Mapping[str, bytes]] = field(default_factory=dict)
    read: Files = field(default_factory=dict)
    texts: SourceMap = field(default_factory=SourceMap)
    _left_s: float = MOST_SECONDS_TOGETHER
    _read: dict[str, Policy | None] = field(default_factory=dict)
    _wrong: dict[Diagnostic, None] = field(default_factory=dict)

    def check_specs(self, loaded: Sequence[LoadedSpec]) -> list[Diagnostic]:
        """Return where the applications break a policy, and what is wrong with the policies themselves."""
        found: list[Diagnostic] = []
        for one in loaded:
            root = one.layout.root
            broken = self._broken(APPLICATION, one.application, one.node, root)
            found += one.texts.shown(broken)
        return [*self._taken(), *found]

    def check_manifests(
        self, loaded: Sequence[LoadedSpec], model: type[BaseModel], known: Files = NO_FILES
    ) -> list[Diagnostic]:
        """Return where the manifests on disk break a policy; one that cannot be read is for others to report.

        `known` are files that were read already.
        """
        found: list[Diagnostic] = []
        for one in loaded:
            layout = one.layout
            path = layout.manifest
            if not self._of(MANIFEST, layout.root) or not (path in known or layout.files.is_file(path)):
                continue
            file = known.get(path) or SourceFile.read(path, layout.files)
            try:
                manifest = file.document(model)
            except DiagnosticError:
                continue
            found += file.texts.shown(self._broken(MANIFEST, manifest, file.nodes[0], layout.root))
        return [*self._taken(), *found]

    def paths(self, root: str | os.PathLike[str]) -> list[str]:
        """Return the policies that a project is checked by, also those in `named`."""
        return [one.path for kind in (APPLICATION, MANIFEST) for one in self._of(kind, root)]

    def require_specs(self, loaded: Sequence[LoadedSpec]) -> None:
        """Raise DiagnosticError if an application breaks a policy, or if a policy is wrong."""
        if wrong := self.check_specs(loaded):
            raise DiagnosticError(wrong)

    def require_manifests(self, loaded: Sequence[LoadedSpec], model: type[BaseModel], known: Files = NO_FILES) -> None:
        """Raise DiagnosticError if a manifest on disk, of type `model`, breaks a policy, or if a policy is wrong."""
        if wrong := self.check_manifests(loaded, model, known):
            raise DiagnosticError(wrong)

    def _taken(self) -> list[Diagnostic]:
        """Return what is wrong with the policies read since the last call."""
        wrong = self.texts.shown(self._wrong)
        self._wrong.clear()
        return wrong

    def _of(self, kind: str, root: str | os.PathLike[str]) -> list[Policy]:
        before = self.before.get(os.path.realpath(root), {})
        paths = [*policy_paths(root), *self.named, *before]
        for path in paths:
            if path not in self._read:
                self._read[path] = self._policy(path, before.get(path))
        policies = (self._read[path] for path in dict.fromkeys(paths))
        return [policy for policy in policies if policy is not None and policy.kind == kind]

    def _policy(self, path: str, content: bytes | None) -> Policy | None:
        is_before = content is not None
        if content is None:
            file = self.read.get(pathlib.Path(path)) or SourceFile.read(path)
            if file.problem is not None:
                self._wrong[unreadable(path, file.problem)] = None
                return None
            content = file.content
        text, problems = reader.decode(content, path, reader.MOST_BYTES)
        self.texts.lines[path] = text.split("\n")
        found: Policy | list[Diagnostic] = problems
        if not problems:
            found = self._timed(path, partial(_schema_of, text, path))
        if isinstance(found, Policy):
            return found
        if not is_before:  # one that is mended judges nothing
            self._wrong |= dict.fromkeys(found)
        return None

    def _broken(self, kind: str, document: BaseModel, node: Node, root: str | os.PathLike[str]) -> Iterator[Diagnostic]:
        data: dict[str, Any] | None = None
        for policy in self._of(kind, root):
            data = numeric_document(document) if data is None else data
            found = self._timed(policy.path, partial(_breaches, policy, type(document), data, node))
            if any(one.code == "FS602" for one in found):
                self._wrong |= dict.fromkeys(found)
            else:
                yield from found

    def _timed(self, path: str, do: Callable[[], Found]) -> Found | list[Diagnostic]:
        """Return what is done with a policy, or why it is not: it takes too long, or others took the time of the command."""
        if self._left_s <= 0:
            message = f"the policy is not read: policies before it took {MOST_SECONDS_TOGETHER:g} s of processor time together"
            return [Diagnostic("FS602", message, Span(path, 1, 1), "mend those that take too long, or remove them")]
        used = Used()
        try:
            with processor_time(MOST_SECONDS) as used:
                return do()
        except TookTooLong:
            message = f"the policy takes too long: more than {MOST_SECONDS:g} s of processor time"
            fix = "simplify its patterns: a repeat within a repeat, such as (a+)+, may take for ever"
            return [Diagnostic("FS602", message, Span(path, 1, 1), fix)]
        finally:
            self._left_s -= max(0.0, used.seconds - FREE_SECONDS)


def policy_paths(root: str | os.PathLike[str]) -> list[str]:
    """Return the policies of a project."""
    folder = os.path.normpath(os.path.join(root, FOLDER))
    names = sorted(os.listdir(folder)) if os.path.isdir(folder) else []
    return [os.path.join(folder, name) for name in names if name.endswith(SUFFIX)]


def _breaches(policy: Policy, kind: type[BaseModel], data: dict[str, Any], node: Node) -> list[Diagnostic]:
    """Return where a document breaks the policy; or, under the code FS602, what is wrong with the policy."""
    if unknown := list(_unknown_fields(policy, policy.schema, kind, (), ())):
        return unknown
    found = _violations(policy, data)
    return [found] if isinstance(found, Diagnostic) else [_located(policy, error, node) for error in found]


def _schema_of(text: str, path: str) -> Policy | list[Diagnostic]:
    """Return the policy of a file's text, or why it is none."""
    from jsonschema import Draft202012Validator, SchemaError

    def wrong(message: str, span: Span, fix: str | None = None) -> list[Diagnostic]:
        return [Diagnostic("FS602", message, span, fix)]

    try:
        schema = json.loads(text, parse_constant=_no_number)
    except json.JSONDecodeError as problem:
        span = Span(path, problem.lineno, problem.colno)
        return wrong(f"the policy must be JSON: {problem.msg.lower()}", span)
    except (ValueError, RecursionError) as problem:
        return wrong(f"the policy must be JSON: {problem}", Span(path, 1, 1))
    if repeated := [one for one in _tree(text, path)[1] if one.code == "FS106"]:
        return repeated
    if not isinstance(schema, dict):
        return wrong("the policy must be a JSON Schema, which is an object", Span(path, 1, 1))
    if schema.get("$schema", DIALECT) != DIALECT:
        return wrong("the policy must be in JSON Schema 2020-12", _span(text, path, ("$schema",)), f"write '{DIALECT}'")
    try:
        Draft202012Validator.check_schema(schema)
    except SchemaError as problem:
        at = tuple(problem.absolute_path)
        return wrong(f"the policy must be a JSON Schema: {_short(problem.message)}", _span(text, path, at))
    except RecursionError:
        return wrong("the policy must be a JSON Schema: it is nested too deeply", Span(path, 1, 1))
    kind = _part(schema, "properties", "kind").get("const", APPLICATION)
    policy = Policy(path, text, str(kind), schema)
    if kind not in (APPLICATION, MANIFEST):
        message = f"a policy is about the kind {APPLICATION} or {MANIFEST}"
        return [policy.diagnostic(message, ("properties", "kind", "const"))]
    return list(_foreign_references(policy)) or policy


def _no_number(word: str) -> None:
    raise ValueError(f"{word} is not a JSON number")


def _part(schema: Any, *keys: str) -> Mapping[str, Any]:
    for key in keys:
        schema = schema.get(key) if isinstance(schema, Mapping) else None
    return schema if isinstance(schema, Mapping) else {}


def _foreign_references(policy: Policy) -> Iterator[Diagnostic]:
    """Yield each `$ref` that leads out of the file, or nowhere."""
    from referencing import Registry
    from referencing.exceptions import Unresolvable
    from referencing.jsonschema import DRAFT202012

    registry: Registry[Any] = Registry()
    resolver = registry.resolver_with_root(DRAFT202012.create_resource(policy.schema))
    for path, reference in _references(policy.schema, ()):
        try:
            resolver.lookup(reference)
        except Unresolvable:
            message = f"the policy refers to {_short(reference)}, which is not in this file; nothing is fetched"
            yield policy.diagnostic(message, path, "copy it under '$defs' and refer to '#/$defs/…'")


def _references(value: Any, path: Path) -> Iterator[tuple[Path, str]]:
    if isinstance(value, dict):
        for key, child in value.items():
            if key in ("$ref", "$dynamicRef") and isinstance(child, str):
                yield (*path, key), child
            elif key not in ("const", "enum", "default", "examples"):
                yield from _references(child, (*path, key))
    elif isinstance(value, list):
        for index, child in enumerate(value):
            yield from _references(child, (*path, index))


def _unknown_fields(policy: Policy, schema: Any, annotation: Any, at: Path, path: Path) -> Iterator[Diagnostic]:
    """Yield each property that no document has: such a policy would never be broken.

    `at` is the place in the document whose type is `annotation`, `path` the place of `schema` in the policy.
    """
    if not isinstance(schema, dict):
        return
    fields, (_, items) = fields_of(annotation), part(annotation)
    required = schema.get("required", [])
    named: list[tuple[Path, str]] = [(("properties", name), name) for name in _part(schema, "properties")]
    named += [(("required", index), name) for index, name in enumerate(required)]
    for step, name in named:
        if fields and name not in fields and not name.startswith("x-"):
            near = closest(name, fields)
            fix = f"write '{near}'" if near else f"known here: {', '.join(fields)}"
            message = f"{dotted(at) or 'the document'} has no {name}, so the policy would never be broken"
            yield policy.diagnostic(message, (*path, *step), fix)
    for name, child in _part(schema, "properties").items():
        if (inner := fields.get(name, items)) is not None:
            yield from _unknown_fields(policy, child, inner, (*at, name), (*path, "properties", name))
    for keyword in ("items", "additionalProperties"):
        if items is not None:
            yield from _unknown_fields(policy, schema.get(keyword), items, at, (*path, keyword))
    for keyword in SAME_PLACE:
        below = schema.get(keyword)
        if keyword == "dependentSchemas" or isinstance(below, list):
            parts = below.items() if isinstance(below, dict) else enumerate(below or ())
            for key, child in parts:
                yield from _unknown_fields(policy, child, annotation, at, (*path, keyword, key))
        else:
            yield from _unknown_fields(policy, below, annotation, at, (*path, keyword))


def _violations(policy: Policy, data: dict[str, Any]) -> list[Any] | Diagnostic:
    """Return jsonschema's errors about the document, or why the policy cannot be evaluated."""
    from jsonschema import Draft202012Validator
    from referencing import Registry
    from referencing.exceptions import Unresolvable

    registry: Registry[Any] = Registry()
    try:
        return list(Draft202012Validator(policy.schema, registry=registry).iter_errors(data))
    except RecursionError:
        return policy.diagnostic("the policy refers to itself without end")
    except (Unresolvable, ArithmeticError, re.error) as problem:
        return policy.diagnostic(f"the policy cannot be evaluated: {_short(str(problem))}")


def _located(policy: Policy, error: Any, node: Node) -> Diagnostic:
    """Return the diagnostic for one of jsonschema's errors, at the value that it is about."""
    path = tuple(error.absolute_path)
    name = dotted(path) or "the document"
    said = _described(policy.schema, error)
    message, fix = said.get("description"), said.get("x-fix")
    if not isinstance(message, str):
        message = f"{name}: {_short(error.message)}"
    value = error.instance
    default = not _is_written(node, path) and not isinstance(value, (dict, list))
    origin = f"; {name} is {json.dumps(value, ensure_ascii=False)} by default" if default else ""
    span = span_of(node, path)
    return Diagnostic("FS601", f"{message} ({policy.path}{origin})", span, fix if isinstance(fix, str) else None)


def _is_written(node: Node, path: Path) -> bool:
    """Return whether the document itself has a value at the path, or the text of a range that the path leads into."""
    found = find(node, path)
    while found is None and path:
        path = path[:-1]
        found = find(node, path)
        if found is not None:
            return not isinstance(found.value, (dict, list))
    return found is not None


def _described(schema: Any, error: Any) -> dict[str, Any]:
    """Return the subschema that failed if it has a description, else the nearest around it that has one."""
    found = [schema]
    for step in error.absolute_schema_path:
        schema = schema.get(step) if isinstance(schema, dict) else schema[step] if isinstance(schema, list) else None
        found.append(schema)
    candidates = [one for one in (error.schema, *reversed(found)) if isinstance(one, dict)]
    return next((one for one in candidates if isinstance(one.get("description"), str)), candidates[0])


def _span(text: str, path: str, at: Path) -> Span:
    """Return the place in a policy's text; its start where the text is JSON that is not YAML."""
    nodes, problems = _tree(text, path)
    return Span(path, 1, 1) if problems or not nodes else span_of(nodes[0], at)


@lru_cache(maxsize=4)
def _tree(text: str, path: str) -> tuple[list[Node], list[Diagnostic]]:
    return reader.documents(text, path)


def _short(text: str) -> str:
    text = " ".join(text.split())
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 3]}..."
