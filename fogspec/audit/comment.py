"""The comment on a pull request: what decides first, the rest folded, and whole applications left out where it is too long."""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from fogspec.audit.compare import Change, short
from fogspec.audit.review import Machine, Removed, Review, Whole
from fogspec.base import digest, units
from fogspec.base.diagnostics import Diagnostic
from fogspec.base.text import code, count, shell_command
from fogspec.base.text import markdown as md

MARK = "<!-- fogspec review -->"
LONGEST = 65_536  # characters that GitHub takes in a comment
RESERVED = 400  # of them for the sentences on what is left out
MOST_INPUTS, MOST_ROWS, MOST_PROBLEMS, MOST_NAMED = 12, 100, 5, 20
PROVENANCE = ("application", "catalog", "plan", "results", "models")
ROLLOUTS = {
    "none": "nothing is deployed",
    "start": "starts a machine",
    "replace": "replaces the machine",
    "in place": "stays in place",
}
SENTENCES = {
    "start": "`apply` starts the first machine.",
    "replace": "`apply` starts a new machine, and ends the old one once the new one answers.",
    "in place": "`apply` keeps the machine: it is given nothing new.",
}


def markdown(whole: Whole, picture_base: str | None = None, longest: int = LONGEST) -> str:
    """Return the comment, of at most `longest` characters: a summary, a table, and a section for each application.

    Where all of it is too long, the last sections are left out, those of applications that decide less first, then rows of the
    table; the comment says how many.
    """
    touched = [one for one in whole.reviews if one.touched]
    rest = [one.name for one in whole.reviews if not one.touched and not one.idle]
    idle = [one.name for one in whole.reviews if not one.touched and one.idle]
    head = [MARK, "## fogspec: what this change deploys", "", *_summary(whole, touched), ""]
    head += _invalid(whole.invalid)
    tail = [f"Unchanged and fresh: {_names(rest)}."] if rest else []
    tail += [f"Unchanged, without a manifest: {_names(idle)}."] if idle else []
    rows = [*(_row(one) for one in touched), *(_removed_row(one) for one in whole.removed)]
    sections = [_section(one, picture_base) for one in touched] + [_removal(one) for one in whole.removed]
    weights = [*map(_weight, touched), *(1 for _ in whole.removed)]
    left = longest - RESERVED - _length(head) - _length(tail)
    table = _table(rows, whole, left // 2) if len(rows) > 1 else []
    left -= _length(table)
    shown = set()
    for place in sorted(range(len(sections)), key=lambda place: (weights[place], place)):
        if (size := _length(sections[place])) <= left:
            shown.add(place)
            left -= size
    if (cut := len(sections) - len(shown)) > 0:
        one_alone = code(shell_command("fogspec", "review", whole.commit[:12], "SPEC"))
        verb = "is" if cut == 1 else "are"
        tail = [f"{count(cut, 'application')} more {verb} left out for length: {one_alone} shows one.", "", *tail]
    lines = [*head, *table]
    for place in sorted(shown):
        lines += sections[place]
    return "\n".join([*lines, *tail]).rstrip() + "\n"


def _summary(whole: Whole, touched: Sequence[Review]) -> Iterator[str]:
    """Yield what decides, one fact an item."""
    number = len(touched) + len(whole.removed)
    total = len(whole.reviews) + len(whole.removed)
    changed = "No application changes" if not number else f"{number} of {count(total, 'application')} changed"
    before, after = whole.month_usd
    yield f"- **{changed}.** All machines: {_month(before)} before, {_month(after)} after{_share(before, after)}."
    kinds = [(name, sum(one.rollout == name for one in touched)) for name in ("start", "replace", "in place")]
    if said := [f"{number} {ROLLOUTS[name]}" for name, number in kinds if number]:
        yield f"- On `apply`: {', '.join(said)}."
    if due := whole.due:
        yield f"- **To measure first**: {count(len(due.samples), 'sample')}{due.most}."
    elif unknown := [one.name for one in whole.reviews if one.unusable]:
        yield f"- **Damaged results or lock**, so that what must be measured is not known: {_names(unknown)}."
    else:
        yield "- No benchmark needed."
    stale = [one.name for one in touched if not one.fresh]
    if stale:
        yield f"- **Not fresh**, so that `apply` refuses it: {_names(stale)}."
    if loose := [one.name for one in touched if one.deploys_unpinned]:
        yield f"- **Image not pinned**, so that `apply` refuses it: {_names(loose)}. `fogspec lock` pins it."
    checked = {path for one in whole.reviews for path in one.policies}
    if whole.broken:
        broken = [one.name for one in touched if one.broken]
        yield f"- **Policies broken**: {count(whole.broken, 'time')}, by {_names(broken)}."
    elif checked:
        yield f"- Policies met: {len(checked)}."
    if whole.invalid:
        yield f"- **Invalid specs**: {count(len(whole.invalid), 'error')}; what they deploy is not known."


def _invalid(found: Sequence[Diagnostic]) -> list[str]:
    if not found:
        return []
    shown = [
        f"- {code(f'{one.span.path}:{one.span.line}:{one.span.column}')}: {md(one.message)}"
        for one in found[:MOST_NAMED]
    ]
    more = [f"- and {len(found) - MOST_NAMED} more"] if len(found) > MOST_NAMED else []
    return ["### Invalid specs", "", *shown, *more, ""]


def _weight(one: Review) -> int:
    """Return how early an application is shown where not all are: what stops the merge, then machines, then the rest."""
    return 0 if one.broken or not one.fresh else 1 if one.rollout in ("start", "replace") else 2


def _table(rows: Sequence[str], whole: Whole, most: int) -> list[str]:
    """Return the table of all applications with their sum, of at most `most` characters."""
    head = ["| application | machine | per month | cost of requests | latency | on apply |", "|--|--|--|--|--|--|"]
    before, after = whole.month_usd
    total = f"| **all** | | {_month(before)} -> {_month(after)}{_share(before, after)} | | | |"
    left, kept = most - _length([*head, total]) - RESERVED, list[str]()
    for row in rows[:MOST_ROWS]:
        left -= _length([row])
        if left < 0:
            break
        kept.append(row)
    cut = len(rows) - len(kept)
    more = [f"| and {cut} more | | | | | |"] if cut else []
    return [*head, *kept, *more, total, ""]


def _row(one: Review) -> str:
    before, after = one.before, one.after
    state = "" if one.fresh else ", **not fresh**"
    cells = [
        _change(before, after, lambda machine: machine.place),
        _change(before, after, lambda machine: _month(machine.usd_per_month))
        + (_share(before.usd_per_month, after.usd_per_month) if before and after else ""),
        _change(before, after, lambda machine: _cost(machine.usd_per_request)),
        _change(before, after, lambda machine: _duration(machine.latency_s)),
        f"{ROLLOUTS[one.rollout]}{state}{', **policy broken**' if one.broken else ''}",
    ]
    return f"| {md(one.name)} | {' | '.join(cells)} |"


def _removed_row(one: Removed) -> str:
    return f"| {md(one.name)} | {_change(one.before, None, lambda machine: machine.place)} | | | | keeps running until `down` |"


def _change(before: Machine | None, after: Machine | None, text: Any) -> str:
    was, now = (md(text(one)) if one else "none" for one in (before, after))
    return now if was == now else f"{was} -\\> {now}"


def _section(one: Review, picture_base: str | None) -> list[str]:
    """Return all about one application: what decides in the open, the rest folded."""
    difference, layout = one.difference, one.difference.layout
    lines = [f"### {md(one.name)}: {md(_headline(one))}", ""]
    if one.rollout in SENTENCES:
        lines.append(f"- {SENTENCES[one.rollout]}")
    lines += [f"- {md(text)}" for text in _choice(one.after)]
    lines += [
        f"- **{md(stage.words)}**: {md('; '.join(stage.reasons) or 'compile it')}"
        for stage in one.stages
        if stage.state != "fresh"
    ]
    if one.refused:
        lines.append(f"- **cannot be compiled**: {md(one.refused)}")
    if one.due:
        measure = shell_command("fogspec", "bench", _from_here(layout.spec), *one.bench_options)
        lines.append(f"- **to measure first**: {count(len(one.due.samples), 'sample')}{one.due.most}: {code(measure)}")
    elif one.fresh:
        lines.append("- everything is fresh; no benchmark needed")
    elif not one.refused:
        todo = code(shell_command("fogspec", "compile", _from_here(layout.spec)))
        lines.append(f"- **to do**: {todo}, and commit what it writes")
    lines += _policies(one)
    new, kept = one.warnings
    lines += [f"- **warning**: {md(text)}" for text in new]
    lines += ["", *_inputs(one.inputs[:MOST_INPUTS]), *_costs(one)]
    if layout.files.is_file(layout.picture) and picture_base is not None:
        address = f"{picture_base.rstrip('/')}/{quote(_from_here(layout.picture))}"
        lines += [f"![menu of {md(layout.name)}]({address})", ""]
    if more := one.inputs[MOST_INPUTS:]:
        lines += _folded(f"{len(more)} more inputs changed", _inputs(more))
    if kept:
        lines += _folded(f"{count(len(kept), 'warning')}, as before", [f"- {md(text)}" for text in kept])
    found = difference.changes
    if found and difference.before is not None and difference.after is not None and not one.damaged:
        fields = f"{count(len(found), 'field')} of the manifest {'differs' if len(found) == 1 else 'differ'}"
        lines += _folded(fields, _fields(found))
    return [*lines, *_provenance(difference.after)]


def _headline(one: Review) -> str:
    before, after, fresh = one.before, one.after, one.fresh
    stale = "" if fresh else ", but the manifest is not fresh"
    if one.damaged:
        return "the manifest is damaged"
    if after is None:
        return "no manifest" if one.difference.before is None else "the manifest is gone"
    if before is None:
        return f"a new manifest{stale}"
    if one.rollout == "none" and not fresh:
        return "the manifest is not fresh"
    change = f"{before.place} -> {after.place}" if before.place != after.place else f"{after.place} stays"
    if before.place == after.place and one.rollout == "replace":
        change = f"{after.place} is replaced by another one"
    return f"{change}{stale}"


def _removal(one: Removed) -> list[str]:
    """Return the section about a removed application; merging terminates no machine."""
    lines = [f"### {md(one.name)}: no longer deployed", ""]
    lines += [f"- {md(text)}" for text in list(_choice(one.before))[:1]]
    down = code(shell_command("fogspec", "down", one.name))
    return [*lines, f"- its deployment keeps running: {down} ends it, while the files exist", ""]


def _choice(one: Machine | None) -> Iterator[str]:
    """Yield the machine and the expected latency and cost in a manifest."""
    if one is None:
        return
    price = "no price" if one.price_usd_per_hour is None else units.shown_price(one.price_usd_per_hour)
    yield f"runs on {one.place}, {price}, {_month(one.usd_per_month)}; image {one.image or 'none'}"
    if one.planned is not None:
        yield f"partial: {one.measured} of {one.planned} planned samples are measured"
    within = "" if one.interval_s is None else f" [{', '.join(map(units.shown_duration, one.interval_s))}]"
    limit = "" if one.limit_s is None else f", limit {units.shown_duration(one.limit_s)}"
    sure = "" if one.probability_met is None else f", met with probability {_probability(one.probability_met)}"
    latency = f"expected {one.statistic} latency {_duration(one.latency_s)}{within}{limit}{sure}"
    yield f"{latency}; {_cost(one.usd_per_request)}"


def _policies(one: Review) -> list[str]:
    shown = [
        f"- **policy broken**: {code(f'{found.span.path}:{found.span.line}')}: {md(found.message)}"
        for found in one.broken[:MOST_PROBLEMS]
    ]
    if len(one.broken) > MOST_PROBLEMS:
        shown.append(f"- and {len(one.broken) - MOST_PROBLEMS} more: `fogspec ci` lists them")
    if not one.broken and one.policies:
        shown.append(f"- policies met: {len(one.policies)}")
    return shown


def _inputs(found: Sequence[Change]) -> list[str]:
    if not found:
        return []
    return ["| input | before | after |", "|--|--|--|", *map(_field, found), ""]


def _fields(found: Sequence[Change]) -> list[str]:
    return ["| field | before | after |", "|--|--|--|", *map(_field, found)]


def _field(one: Change) -> str:
    return f"| {code(one.field or 'the whole file')} | {md(short(one.before))} | {md(short(one.after))} |"


def _costs(one: Review) -> list[str]:
    """Return the costs and the latency before and after, as far as they differ."""
    before, after = one.before, one.after
    if before is None or after is None:
        return []
    values: dict[str, tuple[float | None, float | None, Callable[[float], str]]] = {
        "machine": (before.price_usd_per_hour, after.price_usd_per_hour, units.shown_price),
        "per month": (before.usd_per_month, after.usd_per_month, _month),
        "requests": (before.usd_per_request, after.usd_per_request, units.shown_cost),
        "latency": (before.latency_s, after.latency_s, units.shown_duration),
    }
    rows = [
        f"| {name} | {md(show(was))} | {md(show(now))} | {md(_share(was, now).strip(' ()'))} |"
        for name, (was, now, show) in values.items()
        if was is not None and now is not None and was != now
    ]
    return ["| | before | after | |", "|--|--|--|--|", *rows, ""] if rows else []


def _provenance(manifest: Mapping[str, Any] | None) -> list[str]:
    named = (manifest or {}).get("provenance")
    rows = []
    for name in PROVENANCE:
        one = named.get(name) if isinstance(named, Mapping) else None
        if isinstance(one, Mapping) and one:
            where = one.get("path") or " ".join(str(one[key]) for key in ("source", "revision", "date") if one.get(key))
            rows.append(f"| {name} | {md(str(where))} | {code(digest.shorten(str(one.get('digest'))))} |")
    return _folded("Provenance", ["| made from | | digest |", "|--|--|--|", *rows]) if rows else []


def _folded(title: str, lines: Sequence[str]) -> list[str]:
    """Return lines that open on a click; the title is fogspec's own words."""
    return [f"<details><summary>{title}</summary>", "", *lines, "", "</details>", ""]


def _names(names: Sequence[str]) -> str:
    shown = ", ".join(map(md, names[:MOST_NAMED]))
    return shown if len(names) <= MOST_NAMED else f"{shown} and {len(names) - MOST_NAMED} more"


def _month(usd: float | None) -> str:
    return "unknown" if usd is None else units.shown_month(usd)


def _cost(usd_per_request: float | None) -> str:
    return "no cost" if usd_per_request is None else units.shown_cost(usd_per_request)


def _duration(seconds: float | None) -> str:
    return "unknown" if seconds is None else units.shown_duration(seconds)


def _probability(value: float) -> str:
    return "above 0.999" if value > 0.999 else f"{value:.3g}"


def _share(before: float | None, after: float | None) -> str:
    """Return the relative change, such as ` (-75%)`; empty where there is none."""
    if not before or after is None or before == after:
        return ""
    return f" ({(after - before) / before:+.0%})"


def _length(lines: Sequence[str]) -> int:
    """Return the characters of lines, as GitHub counts them at most: in units of UTF-16."""
    return sum(len(line.encode("utf-16-le", "surrogatepass")) // 2 + 1 for line in lines)


def _from_here(path: Path) -> str:
    return Path(os.path.relpath(path)).as_posix()
