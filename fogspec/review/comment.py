"""The comment on a pull request: what decides first, equal changes once, whole applications left out where it is too long."""

from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from itertools import chain
from typing import Any, TypeVar
from urllib.parse import quote

from fogspec.base.diagnostics import Diagnostic
from fogspec.base.text import code, count, shell_command
from fogspec.base.text import markdown as md
from fogspec.base.units import shown_month
from fogspec.base.yaml.writer import flow
from fogspec.check.compare import Change, short
from fogspec.language.warned import sentence
from fogspec.review.changed import Carried
from fogspec.review.deployed import LATENCY, MONTH, REQUEST, Deployed, figure_rows, share
from fogspec.review.diff import Difference, Rollout, Whole, from_here
from fogspec.review.diff_text import MAY_BE_NEWER, SENTENCES, headline

MARK = "<!-- fogspec review -->"
LONGEST = 65_536  # characters that GitHub takes in a comment
RESERVED = 400  # of them for the sentences on what is left out
MOST_INPUTS, MOST_PROBLEMS, MOST_NAMED = 12, 5, 20
MOST_SHARED = 20  # inputs and warnings that several applications have in common
K = TypeVar("K")
ROLLOUTS: dict[Rollout, str] = {
    "none": "no change",
    "start": "starts a machine",
    "replace": "replaces the machine",
    "in place": "stays in place",
}


def markdown(whole: Whole, picture_base: str | None = None, longest: int = LONGEST) -> str:
    """Return the comment, of at most `longest` characters: a summary, a table, and a section for each application.

    All in one order, by weight. Where all of it is too long, the last sections are left out, then rows of the table, of which
    replaced machines are still named.
    """
    shown = whole.shown
    inputs = _common(shown, lambda one: {(found.field, short(found.after)): found.before for found in one.inputs})
    warnings = _common(shown, lambda one: {_key(each): each for each in one.warnings.new + one.warnings.as_before})
    head = [MARK, "## fogspec: what this change deploys", "", *_summary(whole, shown), "", *_invalid(whole.invalid)]
    tail = list(_rest(whole))
    left = longest - RESERVED - _length([*head, *tail])
    table = _table(shown, whole, left // 2) if len(shown) + len(whole.removed) > 1 else []
    common = _common_table(inputs) + _common_warnings(warnings)
    if _length(common) > left // 4:
        common, inputs, warnings = [], {}, {}
    left -= _length([*table, *common])
    folded = len(shown) > 1
    sections = chain(
        (_section(one, picture_base, whole.base is not None, folded, {*inputs, *warnings}) for one in shown),
        (_removal(name, last, whole) for name, last in whole.removed.items()),
    )
    body = list[str]()
    for place, section in enumerate(sections):
        if (size := _length(section)) > left:
            cut = len(shown) + len(whole.removed) - place
            alone = code(f"fogspec diff --since {(whole.base or 'BASE')[:12]} APP")
            more = f"{count(cut, 'application')} more {'is' if cut == 1 else 'are'} left out for length: {alone} shows one."
            tail = [more, "", *tail]
            break
        body += section
        left -= size
    return "\n".join([*head, *table, *common, *body, *tail]).rstrip() + "\n"


def _summary(whole: Whole, shown: Sequence[Difference]) -> Iterator[str]:
    """Yield what decides, one fact an item."""
    if whole.warning is not None:
        yield f"- **Not only this change**: {md(whole.warning)}."
    yield f"- **{whole.changed}.** All machines: {whole.costs}."
    kinds = {name: sum(one.rollout == name for one in shown) for name in SENTENCES}
    if any(kinds.values()):
        yield f"- On `apply`: {', '.join(f'{number} {ROLLOUTS[name]}' for name, number in kinds.items() if number)}."
    if due := whole.due:
        yield f"- **To measure first**: {due.text}."
    elif unknown := [one.name for one in whole.found if one.unusable]:
        yield f"- **Damaged results or lock**, so that what must be measured is not known: {_names(unknown)}."
    else:
        yield "- No benchmark needed."
    if stale := [one.name for one in shown if not one.fresh]:
        yield f"- **Not fresh**, so that `apply` refuses it: {_names(stale)}."
    if loose := [one.name for one in shown if one.refused_image is not None]:
        yield f"- **Image not pinned**, so that `apply` refuses it: {_names(loose)}. `fogspec lock` pins it."
    if edited := [one.name for one in shown if any(found.how == "edited" for found in one.samples)]:
        yield f"- **Samples changed without a new measurement**: {_names(edited)}."
    checked = {path for one in whole.found for path in one.policies}
    if broken := [one for one in shown if one.broken]:
        times = count(sum(len(one.broken) for one in broken), "time")
        yield f"- **Policies broken**: {times}, by {_names([one.name for one in broken])}."
    elif checked:
        yield f"- Policies met: {len(checked)}."
    yield from _carried([found for one in shown for found in one.carried])
    if whole.invalid:
        yield f"- **Invalid specs**: {count(len(whole.invalid), 'error')}; what they deploy is not known."


def _carried(found: Sequence[Carried]) -> Iterator[str]:
    """Yield how many changes samples outlive, declared and measured apart, how many of them are new, and since when."""
    kinds = ([one for one in found if one.measured == measured] for measured in (False, True))
    for what, those in zip(("declared harmless by a waiver", "confirmed by a measurement"), kinds, strict=True):
        if those:
            days = [one.since for one in those if one.since is not None]
            oldest = f", the oldest of {min(days)}" if set(days) - {"new"} else ""
            yield f"- Changes since the measurement, {what}: {len(those)} ({days.count('new')} new{oldest})."


def _invalid(found: Sequence[Diagnostic]) -> list[str]:
    if not found:
        return []
    lines = [f"{code(f'{one.span.path}:{one.span.line}:{one.span.column}')}: {md(one.message)}" for one in found]
    more = [f"- and {len(found) - MOST_NAMED} more"] if len(found) > MOST_NAMED else []
    return ["### Invalid specs", "", *(f"- {text}" for text in lines[:MOST_NAMED]), *more, ""]


def _rest(whole: Whole) -> Iterator[str]:
    """Yield the applications that have no section."""
    same = [one for one in whole.found if not one.differs]
    rest = {
        "Unchanged and fresh": [one.name for one in same if not one.idle],
        "Unchanged, without a manifest": [one.name for one in same if one.idle],
        "Not affected": sorted(whole.others),
    }
    yield from (f"{what}: {_names(names)}." for what, names in rest.items() if names)


def _table(shown: Sequence[Difference], whole: Whole, most: int) -> list[str]:
    """Return the table of all applications with their sum, of at most `most` characters; then the replaced ones beyond it."""
    head = ["| application | machine | per month | cost of requests | latency | on apply |", "|--|--|--|--|--|--|"]
    before, after = map(shown_month, whole.months_usd)
    total = f"| **all** | | {_both(before, after)}{_share(*whole.months_usd)} | | | |"
    rows = [
        *map(_row, shown),
        *(_removed_row(name, last, whole) for name, last in whole.removed.items()),
    ]
    left, kept = most - _length([*head, total]) - RESERVED, list[str]()
    for row in rows:
        left -= _length([row])
        if left < 0:
            break
        kept.append(row)
    cut = len(rows) - len(kept)
    more = [f"| and {cut} more | | | | | |"] if cut else []
    replaced = [one.name for one in shown[len(kept) :] if one.rollout == "replace"]
    also = [f"Also replaced: {_names(replaced, most * 7 // 8)}.", ""] if replaced else []
    return [*head, *kept, *more, total, "", *also]


def _row(one: Difference) -> str:
    sides = (one.before, one.after)
    cells = [_both(*("none" if side is None else side.place for side in sides))]
    for figure in (MONTH, REQUEST, LATENCY):
        cells.append(_both(*("none" if side is None or side.damage else side.shown(figure) for side in sides)))
        cells[-1] += _share(*one.months_usd) if figure is MONTH and None not in sides else ""
    stops = f"{'' if one.fresh else ', **not fresh**'}{', **policy broken**' if one.broken else ''}"
    return f"| {md(one.name)} | {' | '.join(cells)} | {ROLLOUTS[one.rollout]}{stops} |"


def _removed_row(name: str, last: Deployed, whole: Whole) -> str:
    on_apply = MAY_BE_NEWER if whole.warning else "keeps running until `down`"
    return f"| {md(name)} | {_both(last.place, 'none')} | | | | {on_apply} |"


def _both(before: str, after: str) -> str:
    return md(after) if before == after else f"{md(before)} -\\> {md(after)}"


def _share(before: float, after: float) -> str:
    relative = share(before, after)
    return relative and f" ({relative})"


def _common(shown: Sequence[Difference], of: Callable[[Difference], Mapping[K, Any]]) -> dict[K, list[tuple[str, Any]]]:
    """Return what several applications have in common, with their names and values; that of the most applications first."""
    found = defaultdict[K, list[tuple[str, Any]]](list)
    for one in shown:
        for key, value in of(one).items():
            found[key].append((one.name, value))
    several = [item for item in found.items() if len(item[1]) > 1]
    return dict(sorted(several, key=lambda item: -len(item[1]))[:MOST_SHARED])


def _common_table(inputs: Mapping[tuple[str, str], Sequence[tuple[str, Any]]]) -> list[str]:
    """Return the inputs that several applications change to one value."""
    rows = []
    for (name, after), those in inputs.items():
        values = list({short(value): value for _, value in those}.values())
        before = short(values[0]) if len(values) == 1 else f"{len(values)} values"
        if len(values) > 1 and all(isinstance(value, float) for value in values):
            before = f"{min(values):.3g}..{max(values):.3g}"
        rows.append(
            f"| {code(name)} | {md(before)} | {md(after)} | {len(those)}: {_names([who for who, _ in those])} |"
        )
    return ["| input of several | before | after | applications |", "|--|--|--|--|", *rows, ""] if rows else []


def _key(warning: Mapping[str, Any]) -> str:
    """Return a warning as a key: its code and values."""
    return flow(warning)


def _common_warnings(warnings: Mapping[str, Sequence[tuple[str, Any]]]) -> list[str]:
    lines = [
        f"- {md(sentence(those[0][1]))}: {len(those)}: {_names([who for who, _ in those])}"
        for those in warnings.values()
    ]
    return _folded(f"{count(len(lines), 'warning')} of several applications", lines) if lines else []


def _section(
    one: Difference, picture_base: str | None, base: bool, folded: bool, common: Collection[object]
) -> list[str]:
    """Return all about one application; of several, what stops the merge stays open, and the rest is folded.

    Inputs and warnings that are `common` are shown once, elsewhere.
    """
    stops, facts = list(_stops(one)), list(_facts(one, common))
    own = [change for change in one.inputs if (change.field, short(change.after)) not in common]
    rest = [*_changes("input", own[:MOST_INPUTS])]
    rows = [
        f"| {name} | {md(was)} | {md(now)} | {md(by)} |" for name, was, now, by in figure_rows(one.before, one.after)
    ]
    rest += ["| | before | after | |", "|--|--|--|--|", *rows, ""] if rows else []
    picture = one.layout.picture
    if picture_base is not None and one.layout.files.is_file(picture):
        rest += [f"![menu of {md(one.name)}]({picture_base.rstrip('/')}/{quote(from_here(picture))})", ""]
    if more := own[MOST_INPUTS:]:
        rest += _folded(f"{len(more)} more inputs changed", _changes("input", more))
    for found, what in ((one.warnings.as_before, "as before"), (one.warnings.gone, "no longer there")):
        if lines := [f"- {md(sentence(warning))}" for warning in found if _key(warning) not in common]:
            rest += _folded(f"{count(len(lines), 'warning')}, {what}", lines)
    if one.before is not None and one.figures:
        differ = "differs" if len(one.figures) == 1 else "differ"
        rest += _folded(f"{count(len(one.figures), 'field')} of the manifest {differ}", _changes("field", one.figures))
    title = [f"### {md(one.name)}: {md(headline(one, base))}", ""]
    if not folded:
        return [*title, *stops, *facts, "", *rest]
    return [*title, *stops, *([""] if stops else []), *_folded("Details", [*facts, "", *rest])]


def _stops(one: Difference) -> Iterator[str]:
    """Yield what stops the merge, and the samples that nothing measured."""
    for reason in () if one.idle else one.why:
        what, colon, why = reason.partition(": ")
        yield f"- **{md(what)}**{colon}{md(why)}"
    if one.due:
        bench = shell_command("fogspec", "bench", from_here(one.layout.spec), *one.bench_options)
        yield f"- **to measure first**: {one.due.text}: {code(bench)}"
    elif not one.fresh and not one.refused:
        yield f"- **to do**: {code(shell_command('fogspec', 'compile', from_here(one.layout.spec)))}, and commit what it writes"
    for found in one.broken[:MOST_PROBLEMS]:
        yield f"- **policy broken**: {code(f'{found.span.path}:{found.span.line}')}: {md(found.message)}"
    if len(one.broken) > MOST_PROBLEMS:
        yield f"- and {len(one.broken) - MOST_PROBLEMS} more: `fogspec check` lists them"
    edited = [found.text for found in one.samples if found.how == "edited"]
    yield from _some([f"- **sample**: {md(text)}" for text in edited])


def _facts(one: Difference, common: Collection[object]) -> Iterator[str]:
    """Yield what `apply` does, what the manifest deploys, and the rest that a reviewer should know."""
    if one.rollout in SENTENCES:
        yield f"- {SENTENCES[one.rollout]}"
    yield from (f"- {md(text)}" for text in (() if one.after is None else one.after.facts))
    if one.fresh and not one.due:
        yield "- everything is fresh; no benchmark needed"
    if one.policies and not one.broken:
        yield f"- policies met: {len(one.policies)}"
    yield from _some([f"- sample: {md(found.text)}" for found in one.samples if found.how != "edited"])
    new = (warning for warning in one.warnings.new if _key(warning) not in common)
    yield from (f"- **warning**: {md(sentence(warning))}" for warning in new)
    if one.running is not None:
        yield f"- {'not what' if one.running else 'as'} the manifest says, is what runs"


def _some(lines: Sequence[str]) -> list[str]:
    more = [f"- and {count(len(lines) - MOST_INPUTS, 'sample')} more"] if len(lines) > MOST_INPUTS else []
    return [*lines[:MOST_INPUTS], *more]


def _removal(name: str, last: Deployed, whole: Whole) -> list[str]:
    """Return the section about a removed application; merging terminates no machine."""
    if whole.warning:
        return [f"### {md(name)}: {MAY_BE_NEWER}", ""]
    facts = [f"- {md(text)}" for text in last.facts[:1]]
    down = code(shell_command("fogspec", "down", name))
    return [f"### {md(name)}: no longer deployed", "", *facts, f"- its deployment keeps running: {down} ends it", ""]


def _changes(title: str, found: Sequence[Change]) -> list[str]:
    rows = [
        f"| {code(one.field or 'the whole file')} | {md(short(one.before))} | {md(short(one.after))} |" for one in found
    ]
    return [f"| {title} | before | after |", "|--|--|--|", *rows, ""] if rows else []


def _folded(title: str, lines: Sequence[str]) -> list[str]:
    """Return lines that open on a click; the title is fogspec's own words."""
    return [f"<details><summary>{title}</summary>", "", *lines, *([""] if lines[-1:] != [""] else []), "</details>", ""]


def _names(names: Sequence[str], longest: int = 0) -> str:
    """Return the first names, or as many as `longest` characters take, and how many more there are."""
    texts, number = list(map(md, names)), min(len(names), MOST_NAMED)
    left = longest - sum(len(text) + 2 for text in texts[:number])
    while number < len(texts) and (left := left - len(texts[number]) - 2) >= 0:
        number += 1
    return ", ".join(texts[:number]) + (f" and {len(texts) - number} more" if number < len(texts) else "")


def _length(lines: Sequence[str]) -> int:
    """Return the characters of lines, as GitHub counts them at most: in units of UTF-16."""
    return sum(len(line.encode("utf-16-le", "surrogatepass")) // 2 + 1 for line in lines)
