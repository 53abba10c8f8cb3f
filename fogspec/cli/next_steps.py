"""Say which command comes next: one table over all commands, with the options that the next one needs too."""

import importlib
from collections.abc import Iterable, Sequence
from os import PathLike, fspath
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from fogspec.base.console import is_quiet, say
from fogspec.base.text import shell_command

if TYPE_CHECKING:
    from fogspec.audit.diff import Difference
    from fogspec.audit.freshness import Status
    from fogspec.compile.artifacts import Artifacts
    from fogspec.compile.inputs import Inputs
    from fogspec.deploy.health import HealthReport

Words = tuple[str, ...]  # a verb, and its arguments

# What may follow a command; nothing follows one that prints a document, or that ends the work.
FOLLOWED_BY: dict[str, tuple[str, ...]] = {
    "init": ("validate", "compile", "menu"),
    "validate": ("compile",),
    "config": (),
    "lock": ("compile",),
    "compile": ("lock", "bench", "compile", "explain"),
    "doctor": ("compile", "bench"),
    "bench": ("bench", "compile"),
    "join": ("compile",),
    "status": ("compile", "bench", "lock", "apply"),
    "menu": ("explain", "compile"),
    "explain": ("bench", "compile", "lock", "apply"),
    "report": ("bench", "compile", "lock", "apply"),
    "apply": ("apply", "status"),
    "ps": ("down", "status"),
    "logs": (),
    "down": (),
    "mv": ("apply",),
    "adopt": ("status",),
    "watch": (),
    "merge-driver": (),
    "keys": (),
    "diff": ("compile", "lock", "apply"),
    "review": (),
    "ci": (),
    "verify": ("lock", "apply"),
    "attest": ("verify",),
    "evaluate": (),
    "conformance": (),
    "priors": ("compile",),
    "completion": (),
}
KEPT = ("overlays", "catalog_path", "priors", "policies")  # parameters that say what all commands are to read
NEEDED = ("overlays",)  # without these, another command would read something else


def next_command(verb: str, *words: str | PathLike[str]) -> str | None:
    """Return the command `fogspec VERB WORDS`, with the options of the running command that it needs too.

    Return None if the running command has an option that VERB needs and does not take.
    """
    context = click.get_current_context()
    taken = {one.name: one for one in importlib.import_module(f"fogspec.cli.{verb}").command.params}
    options: list[str] = []
    for name in KEPT:
        if not _given(context, name):
            continue
        if name in taken:
            options += _option(taken[name], context.params[name])
        elif name in NEEDED:
            return None
    return shell_command("fogspec", verb, *(fspath(word) for word in words), *options)


def same_command(without: str) -> str:
    """Return the running command as it was called, without this option."""
    context = click.get_current_context()
    words: list[str] = []
    for one in sorted(context.command.params, key=lambda one: isinstance(one, click.Option)):
        if one.name is not None and one.name != without and _given(context, one.name):
            value = context.params[one.name]
            words += _option(one, value) if isinstance(one, click.Option) else _texts(value)
    return shell_command(*context.command_path.split(" "), *words)


def say_next(*commands: str | None) -> None:
    """Print the commands that come next; nothing with `--quiet`."""
    if not is_quiet():
        say(*next_lines(commands))


def next_lines(commands: Iterable[str | None]) -> list[str]:
    """Return a line for each command that comes next."""
    return [f"next: {one}" for one in dict.fromkeys(commands) if one is not None and not is_quiet()]


def after_compile(compiled: "Artifacts") -> str | None:
    """Return what comes after the files of an application were written; None if no machine can be chosen."""
    decision, layout = compiled.decision, compiled.layout
    if decision is None:
        return to_measure(compiled)
    if decision.menu.spec.balanced is None:
        return None
    if decision.manifest is None:
        return f"{to_measure(compiled)}, or {next_command('compile', layout.spec, '--partial')}"
    return f"{next_command('explain', layout.argument)}, then review {shell_command(layout.manifest)}"


def after_look(compiled: "Artifacts") -> str | None:
    """Return what comes after a look at the choice: to measure, to write it, or to look at what it would cost to deploy it."""
    decision, layout = compiled.decision, compiled.layout
    if decision is None:
        return to_measure(compiled) if layout.files.exists(layout.plan) else next_command("compile", layout.spec)
    if decision.menu.spec.balanced is None:
        return None
    if decision.manifest is None:
        return after_compile(compiled)
    return next_command("compile", layout.spec) if compiled.compare() else to_deploy(compiled.inputs)


def after_status(one: "Status", live: "HealthReport | None") -> Words | None:
    """Return what comes next for an application with this status; None if it is deployed, or no machine can be chosen.

    These are the words of `next_command`, which only the process of the command line can ask.
    """
    if one.artifacts is None:
        return None
    if not one.fresh:
        states = {stage.name: stage.state for stage in one.stages}
        if states.get("plan") == "fresh" and (one.to_measure or states.get("results") == "partial"):
            return _measure(one.artifacts)
        return "compile", fspath(one.layout.spec)
    return _deploy(one.inputs) if live is None or live.sync != "Synced" or live.health == "Missing" else None


def after_diff(inputs: "Inputs", one: "Difference", live: Sequence[Any] | None) -> str | None:
    """Return what makes an application as its spec says; None if it is."""
    if one.refused is not None and one.after is None:
        return None
    if one.differs:
        return next_command("compile", one.layout.spec)
    return to_deploy(inputs) if live else None


def to_measure(compiled: "Artifacts") -> str | None:
    """Return the command that measures the plan; without prices there would be no choice, so first the one that has them."""
    return next_command(*_measure(compiled))


def _measure(compiled: "Artifacts") -> Words:
    from fogspec.compile.inputs import unpriced

    if (missing := unpriced(compiled.inputs.spec, compiled.catalog)) is not None:
        return missing[2]
    return "bench", fspath(compiled.layout.spec), *compiled.plan.runner_options


def to_deploy(inputs: "Inputs") -> str | None:
    """Return the command that shows what a manifest would start, and what it costs; first its image has to be pinned."""
    return next_command(*_deploy(inputs))


def _deploy(inputs: "Inputs") -> Words:
    from fogspec.spec.lockfile import image_named, is_pinned, pinned

    image = image_named(pinned(inputs.application, inputs.pins))
    if image is not None and not is_pinned(image):
        return "lock", fspath(inputs.layout.spec)
    return "apply", fspath(inputs.layout.manifest), "--dry-run"


def _given(context: click.Context, name: str) -> bool:
    return context.get_parameter_source(name) is ParameterSource.COMMANDLINE


def _option(option: click.Parameter, value: Any) -> list[str]:
    name = max(option.opts, key=len)
    if isinstance(option, click.Option) and option.is_flag:
        return [name]
    return [word for text in _texts(value) for word in (name, text)]


def _texts(value: Any) -> list[str]:
    return list(map(str, value)) if isinstance(value, tuple) else [str(value)]
