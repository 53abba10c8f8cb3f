"""Render differences as text and as JSON, which has one shape for one application and for many, with a base and without."""

from dataclasses import asdict
from typing import Any

from fogspec.base.diagnostics import Diagnostic
from fogspec.base.text import line, paragraph, shell_command
from fogspec.check.compare import change_text
from fogspec.language.warned import as_data, sentence
from fogspec.review.deployed import figure_rows
from fogspec.review.diff import Difference, Rollout, Whole

MOST_SAMPLES = 6
MAY_BE_NEWER = "not in this checkout: others may have added it since"
SENTENCES: dict[Rollout, str] = {
    "start": "`apply` starts the first machine.",
    "replace": "`apply` starts a new machine, and ends the old one once the new one answers.",
    "in place": "`apply` keeps the machine: it is given nothing new.",
}


def headline(one: Difference, base: bool) -> str:
    """Return what a change does, in one line; `base` tells whether it is compared with a commit."""
    before, after = one.before, one.after
    if one.damaged:
        return "the manifest is damaged"
    if after is None:
        if not base:
            return f"cannot be compiled to a manifest now: {one.refused}"
        return "no manifest" if before is None else "the manifest is gone"
    stale = ", but the manifest is not fresh" if base and not one.fresh else ""
    if before is None:
        return f"a new manifest{stale}"
    if not one.fields and one.rollout == "none":
        if base:
            return "the manifest is not fresh" if stale else "the manifest stays"
        return "the manifest is what compile would write" + (", other files differ" if one.why else "")
    if before.place != after.place:
        return f"{before.place} -> {after.place}{stale}"
    return f"{after.place} {'is replaced by another one' if one.rollout == 'replace' else 'stays'}{stale}"


def as_text(whole: Whole) -> str:
    """Return the differences as text: without a base of each application, else of those that differ, with their sum."""
    if whole.base is None:
        return "\n\n".join(_lines(one, base=False) for one in whole.found)
    texts = [
        *([f"warning: {whole.warning}"] if whole.warning else []),
        *(_lines(one, base=True) for one in whole.shown),
    ]
    for name, last in whole.removed.items():
        down = shell_command("fogspec", "down", name)
        ended = f"no longer deployed; {last.place} keeps running until {down}"
        texts.append(paragraph([f"{name}: {MAY_BE_NEWER if whole.warning else ended}"]))
    return "\n\n".join([*texts, f"{whole.changed}; all machines: {whole.costs}"])


def _lines(one: Difference, base: bool) -> str:
    lines = [f"{one.name}: {headline(one, base)}"]
    lines += [SENTENCES[one.rollout].replace("`", "")] if base and one.rollout in SENTENCES else []
    lines += [f"sample: {found.text}" for found in one.samples]
    lines += [f"input: {change_text(change)}" for change in one.inputs]
    lines += map(change_text, one.figures)
    lines += [f"warning: {sentence(found)}" for found in one.warnings.new if one.before is not None]
    lines += [f"warning that is gone: {sentence(found)}" for found in one.warnings.gone if one.after is not None]
    for name, was, now, relative in figure_rows(one.before, one.after):
        lines.append(f"cost: {name} {was} -> {now}{relative and f' ({relative})'}")
    lines += [f"why: {reason}" for reason in (() if one.idle else one.why)]
    lines += [f"policy broken: {found.span.path}:{found.span.line}: {found.message}" for found in one.broken]
    if one.differs and not (one.refused and one.after is None and not one.due):
        lines.append(measuring_text(one))
    if one.running is not None:
        lines.append(f"running: {'not what' if one.running else 'as'} the manifest says")
        lines += [f"  {change_text(change)}" for change in one.running]
    return paragraph([lines[0], *(f"  {line(text)}" for text in lines[1:])])


def measuring_text(one: Difference) -> str:
    """Return the samples that a benchmark would measure and their cost, or that none is needed."""
    if not one.due:
        return "no benchmark needed: everything that counts is measured"
    names, left = one.due.samples[:MOST_SAMPLES], len(one.due.samples) - MOST_SAMPLES
    listed = ", ".join(names) + (f" and {left} more" if left > 0 else "")
    return f"to measure first: {one.due.text}" + (f": {listed}" if names else "")


def as_dict(whole: Whole) -> dict[str, Any]:
    """Return the differences as values for JSON; money in USD, durations in seconds."""
    before_usd, after_usd = whole.months_usd
    return {
        "base": whole.base,
        "warning": whole.warning,
        "applications": [_data(one) for one in whole.found],
        "not_affected": sorted(whole.others),
        "removed": [{"name": name, "before": last.as_dict()} for name, last in whole.removed.items()],
        "invalid": [_problem(one) for one in whole.invalid],
        "total": {
            "before_usd_per_month": before_usd,
            "after_usd_per_month": after_usd,
            "to_measure": len(whole.due.samples),
            "measuring_usd_at_most": whole.due.usd,
            "policies_broken": sum(len(one.broken) for one in whole.found),
        },
    }


def _data(one: Difference) -> dict[str, Any]:
    return {
        "name": one.name,
        "spec": one.layout.spec.as_posix(),
        "changed": one.differs,
        "fresh": one.fresh,
        "refused": one.refused,
        "stages": [{"name": stage.name, "state": stage.state, "reasons": list(stage.reasons)} for stage in one.stages],
        "rollout": one.rollout.replace(" ", "_"),
        "before": one.before and one.before.as_dict(),
        "after": one.after and one.after.as_dict(),
        "inputs": [asdict(found) for found in one.inputs],
        "samples": [asdict(found) for found in one.samples],
        "carried": [found._asdict() for found in one.carried],
        "fields": [asdict(found) for found in one.fields],
        "warnings": {name: as_data(found) for name, found in one.warnings._asdict().items()},
        "to_measure": list(one.due.samples),
        "measuring_usd_at_most": one.due.usd,
        "policies": {"checked": list(one.policies), "broken": [_problem(found) for found in one.broken]},
        "running": None if one.running is None else [asdict(found) for found in one.running],
    }


def _problem(one: Diagnostic) -> dict[str, Any]:
    place = {"path": one.span.path, "line": one.span.line, "column": one.span.column}
    return {"code": one.code, "message": one.message, "fix": one.fix, **place}
