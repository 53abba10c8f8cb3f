"""Implement `fogspec explain`: explain a field, a diagnostic code, or the choice of a machine."""

import os
from typing import TYPE_CHECKING

import click

from fogspec.base.console import say_json, say_text
from fogspec.base.errors import UsageError
from fogspec.cli.next_steps import after_look, next_lines
from fogspec.cli.options import OUTPUT, complete_application, load_named

if TYPE_CHECKING:
    from fogspec.language.documents import Reading
    from fogspec.language.field_docs import FieldPage

WIDEST_NAME = 24


def _completions(_context: click.Context, _parameter: click.Parameter, begun: str) -> list[str]:
    """Return the fields and codes with this prefix, for shell completion."""
    from fogspec.language.codes import codes
    from fogspec.language.field_docs import pages
    from fogspec.language.schema import Application

    return [one for one in (*(page.path for page in pages(Application)), *codes()) if one.startswith(begun)]


@click.command()
@click.argument("what", shell_complete=_completions)
@click.argument("spec", required=False, metavar="[APP]", shell_complete=complete_application)
@OUTPUT
def command(what: str, spec: str | None, output: str) -> None:
    """Explain a field such as constraints.cost, an error code such as FS201, or the choice for an application.

    WHAT is the field, the code, or the application, by name or by spec. With a field, APP is searched for the line that
    sets it.
    """
    from fogspec.language.discover import spec_of
    from fogspec.language.documents import Reading

    reading = Reading()
    if what.upper().startswith("FS") and what[2:].isdigit():
        _code(what.upper(), output)
    elif os.path.exists(what) or what.endswith((".yaml", ".yml")) or "/" in what:
        _choices(what, output, reading)
    elif _field(what, spec, output):
        return
    elif spec_of(what, reading):
        _choices(what, output, reading)
    else:
        _nothing(what)


def _choices(what: str, output: str, reading: "Reading") -> None:
    from fogspec.compile.compiler import compile_application
    from fogspec.report import explain

    inputs = load_named(what, None, reading)
    compiled = [compile_application(one) for one in inputs]
    if output == "json":
        say_json([explain.as_dict(one) for one in compiled])
    else:
        say_text("\n\n".join(explain.explain(one, following=next_lines([after_look(one)])) for one in compiled))


def _code(name: str, output: str) -> None:
    from fogspec.language.codes import codes
    from fogspec.language.reference import code_text

    if name not in codes():
        same = sorted(one for one in codes() if one[:3] == name[:3])
        groups = f"the codes are from {min(codes())} to {max(codes())}; validate prints the code of each error"
        raise UsageError(f"there is no error code {name}", f"known: {', '.join(same)}" if same else groups)
    if output == "json":
        say_json({"code": name, **codes()[name]._asdict()})
    else:
        say_text(code_text(name))


def _field(name: str, spec: str | None, output: str) -> bool:
    """Explain the fields of this name. Return True if there are any."""
    from fogspec.language.discover import spec_of
    from fogspec.language.documents import Reading
    from fogspec.language.field_docs import matching, pages
    from fogspec.language.locate import locate
    from fogspec.language.reference import field_data, field_text
    from fogspec.language.schema import Application

    known = pages(Application)
    found = matching(known, name)
    spans = locate(spec_of(spec, Reading()) or spec, [page.path for page in found]) if spec and found else {}
    if found and output == "json":
        say_json([field_data(page, spans.get(page.path, [])) for page in found])
    elif found:
        say_text("\n\n".join([*(field_text(page, spans.get(page.path, [])) for page in found), *_below(known, found)]))
    return bool(found)


def _nothing(name: str) -> None:
    from fogspec.language.discover import applications
    from fogspec.language.field_docs import pages
    from fogspec.language.schema import Application
    from fogspec.language.suggest import did_you_mean

    fields = [page.path.rpartition(".")[2] for page in pages(Application)]
    hints = did_you_mean(name.rpartition(".")[2], [*fields, *applications()]) or ["all fields: fogspec explain spec"]
    raise UsageError(f"{name} is not a field of the spec, an error code or an application in specs/", *hints)


def _below(known: list["FieldPage"], found: list["FieldPage"]) -> list[str]:
    """Return lists of the basic and the advanced fields below a field, if it is the only one found."""
    if len(found) != 1:
        return []
    inside = [
        page for page in known if page.path.startswith((f"{found[0].path}.", f"{found[0].path}[", f"{found[0].path}.<"))
    ]
    rows = [(page.path.removeprefix(found[0].path).lstrip("."), page.meaning, page.tier) for page in inside]
    width = min(max((len(name) for name, *_ in rows), default=0), WIDEST_NAME)
    tiers: dict[str, list[str]] = {"basic": [], "advanced": []}
    for name, meaning, tier in rows:
        # A meaning stands below a name that is too long for its column.
        name = f"{name}\n  {'':<{width}}" if len(name) > width else f"{name:<{width}}"
        tiers[tier].append(f"  {name}  {meaning}")
    if not tiers["basic"]:
        return ["\n".join(["fields:", *tiers["advanced"]])] if rows else []
    return ["\n".join([f"{tier} fields:", *lines]) for tier, lines in tiers.items() if lines]
