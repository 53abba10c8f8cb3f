"""Rename an application with its files, and remove the files of applications that have no spec any more."""

import contextlib
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from fogspec.audit.sign import ATTESTATION
from fogspec.base.diagnostics import DiagnosticError, Span
from fogspec.base.errors import FogspecError, InvalidInput, OutOfDate, Refused, UsageError
from fogspec.base.layout import Layout
from fogspec.base.locks import application_lock
from fogspec.base.text import count, shell_command
from fogspec.base.units import dollars
from fogspec.base.yaml.positions import find, plain, span_of
from fogspec.base.yaml.writer import body_text, yaml_text
from fogspec.bench.journal import JournalState
from fogspec.compile.compiler import compile_application, try_compile
from fogspec.compile.inputs import Inputs, compiled_files
from fogspec.deploy.state import DeploymentState, WallClock
from fogspec.plan.schema import Plan, PlanMetadata
from fogspec.results.io import read_results
from fogspec.results.schema import Results, with_checksum
from fogspec.spec.documents import SourceMap, documents_in
from fogspec.spec.loader import LoadedSpec, SourceFile, check_text, load
from fogspec.spec.lock_io import lock_text, read_lock
from fogspec.spec.overlays import NAME as NAMED
from fogspec.spec.render import render_document
from fogspec.spec.schema import Name

NAME = TypeAdapter[str](Name)


@dataclass(frozen=True, slots=True)
class Renamed:
    """A renamed application: its layouts before and after, and the files that are fogspec's no more, which stay."""

    before: Layout
    after: Layout
    stay: tuple[Path, ...]


def rename(one: LoadedSpec, name: str, known: Collection[str], times: WallClock, catalog: str | None = None) -> Renamed:
    """Rename an application: in its spec, in the lock, in results with raw timings; compile it, and remove what it had.

    `known` are the names that other applications have, `catalog` overrides the catalog in the lock.

    Raise UsageError for a name that is invalid or taken, Busy while another command works on the application, Refused if it
    runs or a bench of it is unfinished: what runs is bound to the name.
    Raise InvalidInput or DiagnosticError if its files cannot be read, OutOfDate if its manifest is stale, and what compile
    raises if it has compiled files and cannot be compiled. In all these cases nothing is changed.
    """
    old = one.application.metadata.name
    try:
        NAME.validate_python(name)
    except ValidationError:
        raise UsageError(
            f"{name} is not a name for an application", "write lower-case letters, digits and -, at most 63"
        ) from None
    before = Layout.of(one.path, old)
    moves = before.spec.stem == old
    after = replace(before, name=name, spec=before.spec.with_stem(name) if moves else before.spec)
    _check_free(before, after, known)
    others = [other for other in load([one.path]) if other.base is not None and other.application.metadata.name == old]
    layouts = [before, *(other.layout for other in others)]
    with contextlib.ExitStack() as locks:
        every = _idle(one, others, after, locks, times, catalog)
        inputs = every[0]
        gone = [path for path in _own(before) if before.files.exists(path)]
        gone += [path for layout in layouts[1:] for path in _compiled(layout) if before.files.exists(path)]
        text, results = _spec_text(one, name, after.spec), _results(before, after)
        overlays = _overlay_texts(others, old, name)
        partial = _is_partial(inputs)
        # First what is beside the old files, then the spec in one step: a rename that is killed before leaves the old
        # application whole, one that is killed after it the new one; the rest are leftovers, which compile --prune removes.
        files = before.files
        for path in _own_timings(before):
            files.write(after.timings / path.relative_to(before.timings), files.read(path))
        if results is not None:
            files.write(after.results, results)
        _write_plan(inputs, before, after)
        _relock(before, {old: name}, keep=True)
        files.write(after.spec, text)
        if moves:
            files.remove(before.spec)
        for path, content in overlays.items():
            files.write(path, content)
        _relock(before, {old: name}, keep=False)
        if compiled_files(before):
            compiled = {layout.environment for layout in layouts if compiled_files(layout)}
            _compile(after, compiled, catalog, partial)
        for path in gone:
            files.remove(path)
        for layout in layouts:
            _remove_empty(layout)
    for layout in layouts:
        if files.remove_folder(layout.state):
            files.remove_folder(layout.state.parent)
    return Renamed(before, after, tuple(files.files(before.compiled)) if files.is_folder(before.compiled) else ())


def _idle(
    one: LoadedSpec,
    others: Sequence[LoadedSpec],
    after: Layout,
    locks: contextlib.ExitStack,
    times: WallClock,
    catalog: str | None,
) -> list[Inputs]:
    """Lock an application in all of its environments, and return their inputs; raise what `rename` does."""
    for layout in (one.layout, *(other.layout for other in others)):
        locks.enter_context(application_lock(layout, f"mv of {one.name}", remove=True))
        check_ended(layout, times)
    check_ended(after, times)
    every = Inputs.load([], catalog=catalog, audit=True, loaded=[one, *others])
    for inputs in every:
        _check_compiles(inputs)
    return every


def check_ended(layout: Layout, times: WallClock) -> None:
    """Raise Refused if machines of the application may run, or a bench has measured what is not in the results yet."""
    down = shell_command("fogspec", "down", layout.name)
    live = DeploymentState.look(layout, times)
    if live.machines or live.foreign:
        names = ", ".join(one.name for one in (*live.machines, *live.foreign))
        raise Refused(f"{layout.name} runs: {names}; machines are bound to the application's name", f"end it: {down}")
    files = layout.files
    if files.is_file(layout.journal):
        journal = JournalState.read(files.read(layout.journal))
        if journal.open or journal.unwritten:
            bench = shell_command("fogspec", "bench", layout.name)
            raise Refused(f"{layout.name}: a bench of it has not ended", f"let it finish: {bench}, or end it: {down}")


def _check_free(before: Layout, after: Layout, known: Collection[str]) -> None:
    if after.name == before.name:
        raise UsageError(f"{before.name} has this name already")
    if after.name in known:
        raise UsageError(f"{after.name} is the name of another application", "name another one")
    places = (after.compiled, after.results, after.timings.parent)
    taken = [
        path for path in (*places, *([after.spec] if after.spec != before.spec else [])) if after.files.exists(path)
    ]
    if taken:
        raise UsageError(f"{taken[0]} is there already", "name another one, or remove it")


def _check_compiles(inputs: Inputs) -> None:
    """Raise if the compiled files of an application could not be compiled again under another name."""
    layout = inputs.layout
    if not compiled_files(layout):
        return
    compiled = try_compile(inputs)
    if isinstance(compiled, FogspecError):
        raise compiled
    if compiled.kept:
        raise OutOfDate(
            f"{layout.manifest} is stale, and there is no new one yet: under another name it would be lost",
            shell_command("fogspec", "status", layout.spec) + " says why",
        )


def _spec_text(one: LoadedSpec, name: str, path: Path) -> bytes:
    """Return the spec with another name and nothing else changed; raise InvalidInput if its name is not written there."""
    span = span_of(one.node, ("metadata", "name"))
    content = one.texts.content[one.path]
    lines = content.decode("utf-8").split("\n")
    lines[span.line - 1] = _replaced(lines[span.line - 1], span, name)
    changed = "\n".join(lines).encode()
    found, _ = check_text(changed, str(path))
    documents = [render_document(loaded.application) for loaded in found]
    wanted = [render_document(loaded.application) for loaded in check_text(content, str(path))[0]]
    for document in wanted:
        if document["metadata"]["name"] == one.application.metadata.name:
            document["metadata"]["name"] = name
    if documents != wanted:
        raise InvalidInput(
            f"{one.path}:{span.line}:{span.column}: the name cannot be replaced here by itself",
            f"write metadata.name: {name} in a line of its own, and run it again",
        )
    return changed


def _overlay_texts(others: Sequence[LoadedSpec], old: str, name: str) -> dict[Path, bytes]:
    """Return the overlays of environments that name the application, with its other name and nothing else changed.

    Raise InvalidInput for a name that is not written in a place of its own.
    """
    found: dict[Path, bytes] = {}
    for one in others:
        overlay = one.overlay
        if overlay is None:
            continue
        named = [node for node in overlay.documents if (meant := find(node, NAMED)) is not None and meant.value == old]
        lines = one.texts.content[overlay.path].decode("utf-8").split("\n")
        for node in reversed(named):
            span = span_of(node, NAMED)
            lines[span.line - 1] = _replaced(lines[span.line - 1], span, name)
        content = "\n".join(lines).encode()
        wanted = [plain(node) for node in overlay.documents]
        for document in wanted:
            if isinstance(document, dict) and (document.get("metadata") or {}).get("name") == old:
                document["metadata"]["name"] = name
        if [plain(node) for node in documents_in(content, overlay.path, SourceMap(), [])[0]] != wanted:
            raise InvalidInput(
                f"{overlay.path}: the name {old} cannot be replaced here by itself",
                f"write metadata.name: {old} in a line of its own, and run it again",
            )
        if named:
            found[Path(overlay.path)] = content
    return found


def _replaced(line: str, span: Span, name: str) -> str:
    """Return a line with the name in place of what is at the span."""
    word = f'"{name}"' if _needs_quotes(name) else name
    return f"{line[: span.column - 1]}{word}{line[span.column - 1 + span.width :]}"


def _needs_quotes(name: str) -> bool:
    """Return whether YAML 1.1 or 1.2 could read the plain word as something else than text."""
    return not name[0].isalpha() or name in ("y", "n", "yes", "no", "on", "off", "true", "false", "null", "nan", "inf")


def _compile(layout: Layout, environments: Collection[str], catalog: str | None, partial: bool) -> None:
    """Compile an application in these of its environments."""
    for one in Inputs.load([layout.spec], catalog=catalog, audit=True):
        if one.layout.application == layout.name and one.layout.environment in environments:
            compile_application(one, partial).write()


def _results(before: Layout, after: Layout) -> bytes | None:
    """Return the results under the new name, with their checksum; None without results. Raise DiagnosticError if damaged."""
    results = read_results(before)
    if results is None:
        return None
    samples = []
    for record in results.spec.samples:
        if record.timings is not None and record.timings.path.startswith(f"{before.name}/"):
            path = f"{after.name}/{record.timings.path.removeprefix(f'{before.name}/')}"
            record = record.model_copy(update={"timings": record.timings.model_copy(update={"path": path})})
        samples.append(record)
    body = results.spec.model_copy(update={"samples": samples})
    renamed: Results = with_checksum(PlanMetadata(name=after.name), body)
    head = before.files.read(before.results).decode("utf-8", "replace").partition("\n")[0]
    head = head.replace(before.relative(before.spec), after.relative(after.spec)) if head.startswith("#") else ""
    text = body_text(renamed.model_dump(mode="json", exclude_none=True))
    return f"{head}\n{text}".lstrip("\n").encode()


def _write_plan(inputs: Inputs, before: Layout, after: Layout) -> None:
    """Keep a plan that was measured: compile keeps it while it serves."""
    file = inputs.on_disk.get(before.plan)
    if file is None:
        return
    data = {**file.document(Plan).model_dump(mode="json", exclude_none=True), "metadata": {"name": after.name}}
    made = shell_command("fogspec", "compile", after.relative(after.spec))
    after.files.write(after.plan, yaml_text(data, made, after.relative(after.spec)).encode())


def _is_partial(inputs: Inputs) -> bool:
    """Return whether a manifest on disk rests on a part of the plan, which was accepted once."""
    file = inputs.on_disk.get(inputs.layout.manifest)
    document = None if file is None else file.plain()
    provenance = document.get("provenance") if isinstance(document, Mapping) else None
    return isinstance(provenance, Mapping) and provenance.get("partial") is not None


def _compiled(layout: Layout) -> list[Path]:
    """Return what fogspec wrote into `compiled/` for an application, the report and the attestation included."""
    return [*compiled_files(layout), layout.page, layout.compiled / ATTESTATION]


def _own(layout: Layout) -> list[Path]:
    """Return what fogspec wrote for an application."""
    return [*_own_timings(layout), layout.results, *_compiled(layout)]


def _own_timings(layout: Layout) -> list[Path]:
    return [layout.timings / name for name in layout.files.names(layout.timings) if name.endswith(".gz")]


def _relock(layout: Layout, names: Mapping[str, str], keep: bool) -> None:
    """Write the lock with the pins of these applications under their new names; with `keep` also under the old ones."""
    lock = read_lock(layout.lock)
    if lock is None:
        return
    pins = dict(lock.spec.applications)
    for old, new in names.items():
        if old in pins:
            pins[new] = pins[old]
            if not keep:
                del pins[old]
    changed = lock.model_copy(update={"spec": lock.spec.model_copy(update={"applications": pins})})
    layout.files.write(layout.lock, lock_text(changed).encode())


def _remove_empty(layout: Layout) -> None:
    """Remove the folders of an application that are empty now."""
    for folder in (layout.tasks, layout.link, layout.compiled, layout.timings, layout.timings.parent):
        layout.files.remove_folder(folder)


@dataclass(frozen=True, slots=True)
class Leftover:
    """What fogspec wrote for an application that has no spec: `paths` are its files, `measured` says what they cost."""

    layout: Layout
    paths: tuple[Path, ...]
    measured: str

    @property
    def line(self) -> str:
        """The files in a few words."""
        compiled = sum(self.layout.compiled in path.parents for path in self.paths)
        parts = [f"{count(compiled, 'file')} in {self.layout.compiled}"] if compiled else []
        if self.layout.results in self.paths:
            parts.append(f"{self.layout.results}: {self.measured}")
        if rest := len(self.paths) - compiled - (self.layout.results in self.paths):
            parts.append(f"{count(rest, 'file')} in {self.layout.timings}")
        return f"{self.layout.name}: {'; '.join(parts)}"


def leftovers(root: Path, names: Collection[str]) -> list[Leftover]:
    """Return what fogspec wrote below a root for applications that are not among these names."""
    files = Layout.named(root, "any").files
    found = [name for name in files.names(root / "compiled") if files.is_folder(root / "compiled" / name)]
    found += [name.removesuffix(".yaml") for name in files.names(root / "results") if name.endswith(".yaml")]
    left = []
    for name in sorted(set(found) - set(names)):
        layout = Layout.named(root, name)
        ours = [path for path in _compiled(layout) if files.is_file(path)]
        if not any(path in ours for path in (layout.plan, layout.manifest)):
            ours = []  # not a folder of ours, whatever is in it
        results = _readable(layout)
        if results is not None:
            ours += [layout.results, *_own_timings(layout)]
        if ours:
            spent = (
                ""
                if results is None
                else f"{count(len(results.spec.samples), 'sample')}, {dollars(results.spec.spent)}"
            )
            left.append(Leftover(layout, tuple(ours), spent))
    return left


def prune(left: Leftover, times: WallClock) -> Iterator[Path]:
    """Remove the files and yield each; the lock's pins too. Raise Refused if the application still runs."""
    layout, files = left.layout, left.layout.files
    check_ended(layout, times)
    for path in left.paths:
        if files.remove(path):
            yield path
    _remove_empty(layout)
    lock = read_lock(layout.lock)
    if lock is not None and layout.name in lock.spec.applications:
        pins = {name: one for name, one in lock.spec.applications.items() if name != layout.name}
        changed = lock.model_copy(update={"spec": lock.spec.model_copy(update={"applications": pins})})
        files.write(layout.lock, lock_text(changed).encode())


def _readable(layout: Layout) -> Results | None:
    """Return results that fogspec wrote, None without any: another YAML file is not fogspec's to remove."""
    if layout.overlay is not None or not layout.files.is_file(layout.results):
        return None  # an environment has none of its own
    try:
        return SourceFile.read(layout.results, layout.files).document(Results)
    except DiagnosticError:
        return None
