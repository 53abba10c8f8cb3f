"""Find what changed by hand between the base of a change and the checkout: spec, files, samples, waivers, other inputs."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

from fogspec.base import digest
from fogspec.base.diagnostics import DiagnosticError
from fogspec.base.layout import Layout
from fogspec.base.redaction import redacted
from fogspec.base.units import shown_apart, shown_duration
from fogspec.check.audit import Status
from fogspec.check.compare import Change, changes
from fogspec.language.fingerprints import differing_rows
from fogspec.language.loader import SourceFile, check_text
from fogspec.language.render import render_document
from fogspec.language.schema import Statistic
from fogspec.language.tree import DOCUMENT, sent_tree
from fogspec.results.schema import Measured, Result
from fogspec.review.deployed import Deployed
from fogspec.review.git import Base

How = Literal["new", "removed", "another run", "edited"]
RUN = ("duration", "spent", "setup", "timings")  # of a record: what another run changes
OTHER_INPUTS = {
    "image": ("spec", "image"),
    "samples": ("evidence", "samples"),
}


@dataclass(frozen=True, slots=True)
class SampleChange:
    """A sample whose record differs: its machine, and its latency, or its state, before and after; None where it is not there.

    It is `edited` if the figures differ and the run does not: it was not measured again.
    """

    id: str
    machine: str
    before: str | None
    after: str | None
    how: How

    @property
    def text(self) -> str:
        """The change for people: `c6i.large 207.5 ms -> 11.5 ms, same id, not measured again`."""
        if self.before is None or self.after is None:
            return f"{self.machine} {self.after or self.before}, {self.how}"
        again = "same id, not measured again" if self.how == "edited" else self.how
        return f"{self.machine} {self.before} -> {self.after}, {again}"


class Carried(NamedTuple):
    """A change that samples outlive: declared by a waiver, or measured by a confirmation.

    `since` is the day of its commit, `new` for one of this change, None if the history of the clone does not reach it.
    """

    what: str
    measured: bool
    since: str | None


def input_changes(status: Status, base: Base | None, old: Deployed | None, new: Deployed | None) -> Iterator[Change]:
    """Yield the inputs besides the sent files that differ: fields of the spec, and what two manifests name differently."""
    if base is not None:
        yield from _spec_changes(status, base)
    if old is None or new is None or old == new or new.damage is not None:
        return
    for name, path in OTHER_INPUTS.items():
        before, after = old.get(*path), new.get(*path)
        if before != after:
            yield Change(name, _shortened(before), _shortened(after))
    # What a field of the spec is with its defaults is above, if there is a base.
    was, now = old.part("evidence", "inputs"), new.part("evidence", "inputs")
    for name in differing_rows(was, now):
        if base is None or not name.startswith("spec."):
            yield Change(name, _shortened(was.get(name)), _shortened(now.get(name)))


def _spec_changes(status: Status, base: Base) -> Iterator[Change]:
    """Yield the fields of the spec that differ, defaults filled in; the file itself if it was no valid spec before."""
    layout, one = status.layout, status.inputs.spec
    named = [layout.spec, *([] if layout.overlay is None else [layout.overlay])]
    content = base.at(layout.spec) if any(map(base.differs, named)) else None
    if content is None:
        return
    overlay = None if layout.overlay is None else base.at(layout.overlay)
    known = check_text(content, one.path, None if overlay is None else (overlay, str(layout.overlay)))[0]
    was = next((found for found in known if found.application.metadata.name == layout.application), None)
    if was is None:
        yield Change(layout.relative(layout.spec), "not a valid spec", "a valid spec")
        return
    yield from changes(*(redacted(render_document(found.application)) for found in (was, one)))


def sent_changes(status: Status, base: Base) -> Iterator[Change]:
    """Yield the files that machines are sent and that differ, with the beginnings of their digests."""
    layout, sent = status.layout, status.inputs.sent
    tree, folder = sent_tree(status.inputs.application, layout), status.layout.spec.parent
    for name in base.below(folder) if tree is not None else ():
        path = folder / name
        if name not in sent and (path.exists() or tree is None or tree.excludes(name)):
            continue
        content = base.at(path)
        # What is gone was sent, if it was there and not one of fogspec's own documents.
        if name not in sent and (content is None or ("/" not in name and DOCUMENT.search(content))):
            continue
        before = None if content is None else digest.of_bytes(content)
        yield Change(layout.relative(path), _shortened(before), _shortened(sent.get(name)))


def _shortened(named: Any) -> Any:
    """Return a value with the beginning of its digest in place of the whole, if it has one."""
    what, found, value = named.rpartition("sha256:") if isinstance(named, str) else ("", "", "")
    return f"{what}sha256:{digest.shorten(found + value)}" if found else named


def sample_changes(status: Status, base: Base) -> Iterator[SampleChange]:
    """Yield the samples whose records differ, those first that were not measured again; none if results cannot be read."""
    folder, before, after = status.layout.results, dict[str, Measured](), dict[str, Measured]()
    here = {Path(one.name): one for one in status.inputs.results_files}
    statistic = status.inputs.application.spec.constraints.statistic
    for path in (folder / name for name in base.below(folder) if "/" not in name and name.endswith(".yaml")):
        try:
            was, now = _record(base.file(path)), _record(here.get(path))
        except DiagnosticError:
            continue
        before |= {} if was is None else {was.id: was}
        after |= {} if now is None else {now.id: now}
    found = [
        _sample_change(name, before.get(name), after.get(name), statistic)
        for name in {**before, **after}
        if before.get(name) != after.get(name)
    ]
    yield from sorted(found, key=lambda one: one.how != "edited")


def _record(file: SourceFile | None) -> Measured | None:
    return None if file is None else file.document(Result).spec.record


def _sample_change(name: str, was: Measured | None, now: Measured | None, statistic: Statistic) -> SampleChange:
    """Return how a record changed; a second measurement does not take exactly as long and cost as much as the first."""
    left, right = _latency_s(was, statistic), _latency_s(now, statistic)
    texts = [None if value is None else shown_duration(value) for value in (left, right)]
    if left is not None and right is not None:
        texts = list(shown_apart(left, right, shown_duration))
    states = [None if one is None else f"{one.state}, {one.reason}" if one.reason else one.state for one in (was, now)]
    how: How = "new" if was is None else "removed"
    if was is not None and now is not None:
        same = all(getattr(was, name) == getattr(now, name) for name in RUN)
        how = "edited" if same else "another run"
    return SampleChange(
        id=name,
        machine=next((one.machine.instance for one in (now, was) if one is not None), ""),
        before=texts[0] or states[0],
        after=texts[1] or states[1],
        how=how,
    )


def _latency_s(record: Measured | None, statistic: Statistic) -> float | None:
    latency = None if record is None else record.latency
    value: float | None = None if latency is None else getattr(latency, statistic)
    return latency.mean if latency is not None and value is None else value


def carried(layout: Layout, old: Deployed | None, new: Deployed | None, base: Base | None) -> Iterator[Carried]:
    """Yield the changes that the samples behind a manifest outlive; `old` is the manifest before it."""
    known = [] if old is None else old.carried
    for one in [] if new is None else new.carried:
        what, text, measured = one
        since = None if one in known else "new"
        if since is None and base is not None:
            since = base.repository.first_day(layout.results if measured else layout.spec, text)
        yield Carried(what, measured, since)
