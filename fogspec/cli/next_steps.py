"""Say which command comes next, with the options of the running one that it needs too."""

import importlib
from collections.abc import Iterable
from os import PathLike, fspath
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from fogspec.base.console import is_quiet, say
from fogspec.base.text import shell_command

if TYPE_CHECKING:
    from fogspec.check.audit import Status
    from fogspec.compile.artifacts import Artifacts
    from fogspec.compile.inputs import Inputs
    from fogspec.deploy.health import HealthReport
    from fogspec.review.diff import Difference

Words = tuple[str, ...]  # a verb, and its arguments

KEPT = ("catalog_path", "policies")  # parameters that say what the next command is to read, too


def next_command(verb: str, *words: str | PathLike[str]) -> str:
    """Return the command `fogspec VERB WORDS`, with the options of the running command that it takes too."""
    context = click.get_current_context()
    taken = {one.name: one for one in importlib.import_module(f"fogspec.cli.{verb}").command.params}
    options: list[str] = []
    for name in KEPT:
        if name in taken and _given(context, name):
            of_it = _option(taken[name], context.params[name])
            options += of_it if of_it[0] not in words else []
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
        return to_measure(compiled) if compiled.settles else None
    if decision.manifest is None:
        return f"{to_measure(compiled)}, or {next_command('compile', layout.spec, '--partial')}"
    return f"{next_command('explain', layout.argument)}, then review {shell_command(layout.manifest)}"


def after_look(compiled: "Artifacts") -> str | None:
    """Return what comes after a look at the choice: to measure, to write it, or to look at what it would cost to deploy it."""
    decision, layout = compiled.decision, compiled.layout
    if decision is None:
        return to_measure(compiled) if layout.files.exists(layout.plan) else next_command("compile", layout.spec)
    if decision.menu.spec.balanced is None or decision.manifest is None:
        return after_compile(compiled)
    return next_command("compile", layout.spec) if compiled.compare() else to_deploy(compiled.inputs)


def after_status(one: "Status", live: "HealthReport | None") -> Words | None:
    """Return what comes next for an application with this status; None if it is deployed, or no machine can be chosen.

    These are the words of `next_command`, which only the process of the command line can ask.
    """
    if one.artifacts is None or not one.fresh:
        return one.following
    if not one.layout.files.exists(one.layout.manifest):
        return one.following
    return _deploy(one.inputs) if live is None or live.sync != "Synced" or live.health == "Missing" else None


def after_diff(one: "Difference") -> str | None:
    """Return what makes an application as its spec says; None if it is."""
    if one.refused is not None and one.after is None:
        return None
    if one.differs:
        return next_command("compile", one.layout.spec)
    if not one.running or one.after is None:
        return None
    image = one.after.unpinned_image
    return next_command(*(("apply", one.layout.manifest, "--dry-run") if image is None else ("lock", one.layout.spec)))


def to_measure(compiled: "Artifacts") -> str | None:
    """Return the command that measures the plan; without prices there would be no choice, so first the one that has them."""
    from fogspec.check.audit import measuring

    return next_command(*measuring(compiled))


def to_deploy(inputs: "Inputs") -> str | None:
    """Return the command that shows what a manifest would start, and what it costs; first its image has to be pinned."""
    return next_command(*_deploy(inputs))


def _deploy(inputs: "Inputs") -> Words:
    from fogspec.language.lockfile import image_named, is_pinned, pinned

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
