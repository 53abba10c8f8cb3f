"""Define options and steps that several commands share."""

import os
from collections.abc import Callable, Collection, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click
from click.shell_completion import CompletionItem

from fogspec.base.console import detail, is_verbose, note, say, say_json, timed
from fogspec.base.errors import FogspecError, UsageError
from fogspec.base.text import shell
from fogspec.base.units import UnitError

if TYPE_CHECKING:
    from fogspec.base.diagnostics import Diagnostic
    from fogspec.catalog.machine import Machine
    from fogspec.compile.bundle import ManifestBundle
    from fogspec.compile.inputs import Inputs
    from fogspec.deploy.checks import Stage
    from fogspec.language.documents import Reading
    from fogspec.language.loader import LoadedSpec, SourceFile
    from fogspec.language.schema import Spec


def complete_application(_context: click.Context, _parameter: click.Parameter, begun: str) -> list[CompletionItem]:
    """Return the applications in specs/ with this prefix, for shell completion; files if there is none."""
    from fogspec.language.discover import applications

    names = [one for one in applications() if one.startswith(begun)]
    return [CompletionItem(one) for one in names] or [CompletionItem(begun, type="file")]


class Dollars(click.ParamType):
    """An amount of money, as the spec writes it."""

    name = "'$2'"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return the amount in USD. Raise click.BadParameter for any other value."""
        from fogspec.base.units import parse_money_usd

        try:
            return value if isinstance(value, float) else parse_money_usd(str(value))
        except ValueError as wrong:
            self.fail(str(wrong), param, ctx)


# A name or a spec.
SPECS = click.argument(
    "specs", nargs=-1, metavar="[APP]...", type=click.Path(path_type=str), shell_complete=complete_application
)
SPEC = click.argument("spec", metavar="APP", type=click.Path(path_type=str), shell_complete=complete_application)


def _color(_context: click.Context, _parameter: click.Parameter, when: str) -> bool | None:
    return {"always": True, "never": False}.get(when)


COLOR = click.option(
    "--color",
    type=click.Choice(["auto", "always", "never"]),
    default="auto",
    callback=_color,
    help="auto: on a terminal, unless NO_COLOR is set",
)


def _manifest(_context: click.Context, _parameter: click.Parameter, given: str) -> str:
    from fogspec.language.discover import is_name, named_spec

    if not is_name(given):
        return given
    path = os.path.join("compiled", given, "manifest.yaml")
    if not os.path.exists(path):
        named_spec(given)  # raises for an application that does not exist
    return path


MANIFEST = click.argument(
    "manifest", type=click.Path(path_type=str), callback=_manifest, shell_complete=complete_application
)
OUTPUT = click.option("-o", "--output", type=click.Choice(["text", "json"]), default="text", help="output format")
CATALOG = click.option(
    "--catalog",
    "catalog_path",
    type=click.Path(path_type=str),
    metavar="FROM",
    help="price catalog: snapshot (bundled), skypilot (SkyPilot's own), host (shapes of this host, without a price), a "
    "directory in SkyPilot's layout, or a CSV file in its columns, in the project  [default: that of the lock, else of the "
    "plan, else host for infra local, else skypilot if its lists are on this host, else snapshot]",
)
POLICIES = click.option(
    "--policy",
    "policies",
    multiple=True,
    metavar="FILE",
    help="JSON Schema that specs and manifests must also meet, besides policies/*.schema.json next to specs/",
)
WORKERS = click.option(
    "-j", "--workers", type=click.IntRange(1, 64), help="processes [default: as many as are worth starting]"
)


def quantity(option: str, text: str, parse: Callable[[str], float]) -> float:
    """Return what an option's text means; raise UsageError that names the option and what to write instead."""
    try:
        return parse(text)
    except UnitError as wrong:
        raise UsageError(
            f"{option} {text}: {wrong}", *([f"write {option} {shell(wrong.fix)}"] if wrong.fix else [])
        ) from None


def load_inputs(specs: Sequence[str], catalog: str | None, *, audit: bool = False) -> "list[Inputs]":
    """Read the inputs of the applications that arguments lead to, in all environments; see `check_specs` and `Inputs.load`."""
    from fogspec.compile.inputs import Inputs
    from fogspec.language.discover import load_specs

    with timed("reading"):
        found = Inputs.load([], catalog=catalog, audit=audit, loaded=load_specs(specs))
    show_read(found)
    return found


def show_read(inputs: "Sequence[Inputs]") -> None:
    """Print with `--verbose` what was read, with digests."""
    if not is_verbose():
        return
    from fogspec.base.digest import of_bytes

    files: dict[str, bytes] = {}
    others: dict[str, None] = {}
    for one in inputs:
        files |= {os.fspath(path): content for path, content in one.spec.texts.content.items()}
        files |= {file.name: file.content for file in (one.lock, *one.results_files, *one.on_disk.values()) if file}
        about = one.catalog.about
        others[f"catalog {about.source}: {len(one.catalog):,} offers, {about.digest}"] = None
        if one.library is not None:
            others[f"machine library: {len(one.library.workloads):,} workloads, {one.library.digest}"] = None
    detail(*(f"read {path}: {len(content):,} bytes, {of_bytes(content)}" for path, content in files.items()), *others)


def require_ready(loaded: "Sequence[LoadedSpec]", started: bool = False, files: bool = True) -> None:
    """Raise DiagnosticError if specs still have the names that `init` made up, or, with `files`, name what is not there.

    Before machines are `started`, warn of specs in which nothing sends requests.
    """
    import dataclasses

    from fogspec.base.diagnostics import DiagnosticError
    from fogspec.language.rules.benchmark import NO_SENDER, PLACEHOLDERS
    from fogspec.report.diagnostics import show_diagnostics

    said = list(dict.fromkeys(warning for one in loaded for warning in one.warnings))
    wrong = [dataclasses.replace(one, severity="error") for one in said if one.code == PLACEHOLDERS]
    if files:
        wrong += [absent for one in loaded for absent in one.absent()]
    if wrong:
        raise DiagnosticError(list(dict.fromkeys(wrong)))
    show_diagnostics([one for one in said if started and one.code == NO_SENDER])


def load_named(what: str, name: str | None, reading: "Reading | None" = None) -> "list[Inputs]":
    """Read the applications of a spec, or the one in specs/ that `what` names; `name` selects one of several.

    Those in environments are named. Raise UsageError if there is none, and the errors of `Inputs.load`.
    """
    from fogspec.compile.inputs import Inputs

    return Inputs.load([], loaded=applications_of(what, name, reading))


def open_manifest(path: str, spec: Path | None = None) -> "ManifestBundle":
    """Open a manifest with its inputs; `spec` is where its application is if that is known."""
    from fogspec.compile.bundle import open_bundle

    with timed("reading"):
        found = open_bundle(path, spec)
    show_read([found.inputs])
    return found


def check_policies(policies: Sequence[str], inputs: "Sequence[Inputs]") -> None:
    """Raise DiagnosticError if a spec or a manifest on disk violates a policy, or if a policy is invalid."""
    from fogspec.compile.inputs import policies_read
    from fogspec.compile.manifest import Manifest
    from fogspec.language.rules.policies import Policies

    rules, loaded = Policies(policies, read=policies_read(inputs)), [one.spec for one in inputs]
    rules.require_specs(loaded)
    known = {path: file for one in inputs for path, file in one.on_disk.items()}
    rules.require_manifests(loaded, Manifest, known)


def raise_together(refusals: Iterable[FogspecError | None]) -> None:
    """Raise one error for those of applications that have no choice: the first of a kind that ends with the lowest code."""
    found = sorted((one for one in refusals if one is not None), key=lambda one: one.exit_code)
    if len(found) == 1:
        raise found[0]
    if found:
        texts = dict.fromkeys(one.message for one in found)
        together = FogspecError("; ".join(texts), *dict.fromkeys(hint for one in found for hint in one.hints))
        together.exit_code = found[0].exit_code
        raise together


def raise_damaged(found: "Iterable[Diagnostic]") -> None:
    """Raise the errors of damaged results, each once; nothing without any."""
    from fogspec.base.diagnostics import DiagnosticError

    if damaged := list(dict.fromkeys(found)):
        raise DiagnosticError(damaged)


def applications_of(what: str, name: str | None = None, reading: "Reading | None" = None) -> list["LoadedSpec"]:
    """Return the applications of a spec, or the one in specs/ that `what` names; `name` selects one of several.

    Those in environments are named. `reading` is what was read before. Raise UsageError if there is none, DiagnosticError if
    the spec is invalid.
    """
    from fogspec.language.discover import is_name, named_spec
    from fogspec.language.documents import Reading
    from fogspec.language.loader import load

    known, wanted = Reading() if reading is None else reading, name or (what if is_name(what) else None)
    path = named_spec(what, known)
    every = load([path], known)
    found = [one for one in every if (one.base is None if wanted is None else wanted == one.name)]
    if not found:
        names = sorted(one.name for one in every)
        raise UsageError(f"{path} has no application named {wanted}", f"it has {', '.join(names)}")
    return found


def unmet(
    loaded: "Sequence[LoadedSpec]",
    stage: "Stage",
    places: "Collection[str]",
    output: str,
    opened: "Inputs | None" = None,
    known: "dict[Path, SourceFile] | None" = None,
    here: "Machine | None" = None,
) -> bool:
    """Print the requirements of a bench or an apply that may start machines in these places; return whether one is not met.

    Raise DiagnosticError for a damaged lock.
    """
    from fogspec.backends.images.registry import Registry
    from fogspec.backends.registry import deployment_backend
    from fogspec.base.clouds import cloud_of
    from fogspec.deploy.checks import Check, State, as_dict, as_lines, checks
    from fogspec.deploy.state import SystemWallClock

    if any(cloud_of(place).on_skypilot for place in places):
        note(
            "SkyPilot checks its access to clouds; if its API server does not run on this computer, that starts, and ends then"
        )
    found: list[Check] = []
    times, check = SystemWallClock(), Registry().check
    for one in checks(loaded, stage, places, times, deployment_backend, check, opened, known, here):
        if output == "text":
            say(*as_lines(one, found[-1] if found else None))
        found.append(one)
    if output == "json":
        say_json([as_dict(one) for one in found])
    return any(one.state is State.PROBLEM for one in found)


def check_image(image: str | None, spec: "Spec", measures: bool) -> None:
    """Raise InvalidInput if the registry of a pinned image does not have it, or machines that measure, or serve, cannot use it.

    If the registry does not tell, the machines will.
    """
    from fogspec.backends.images.registry import NotShown, Registry
    from fogspec.base.errors import CloudError
    from fogspec.compile.tasks import image_use
    from fogspec.language.lockfile import is_pinned

    if image is None or not is_pinned(image):
        return
    try:
        Registry().check(image, image_use(spec, measures))
    except (NotShown, CloudError) as unknown:
        note(f"image not checked: {unknown.message}")
