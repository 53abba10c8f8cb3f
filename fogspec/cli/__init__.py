"""Run the command line; each command is a module that is imported when it is called."""

import importlib
import os
import sys
import textwrap
from collections.abc import Sequence

import click

from fogspec import __version__
from fogspec.base.console import Verbosity, say, set_verbosity
from fogspec.base.diagnostics import DiagnosticError
from fogspec.base.errors import FogspecError, UsageError

GROUPS = {
    "Author": ("init", "validate", "lock"),
    "Plan and measure": ("compile", "bench", "status"),
    "Choose": ("menu", "explain", "report"),
    "Deploy": ("apply", "watch", "logs", "down"),
    "Review and audit": ("diff", "check"),
}
EXAMPLES = {
    "init": "fogspec init my-robot",
    "validate": "fogspec validate specs/my-robot.yaml",
    "lock": "fogspec lock my-robot",
    "compile": "fogspec compile my-robot",
    "bench": "fogspec bench my-robot --dry-run",
    "status": "fogspec status",
    "menu": "fogspec menu my-robot --latency 3s --alpha 0.2",
    "explain": "fogspec explain constraints.latency",
    "report": "fogspec report my-robot",
    "apply": "fogspec apply my-robot --dry-run",
    "watch": "fogspec watch my-robot --once --max-restarts 0",
    "logs": "fogspec logs my-robot",
    "down": "fogspec down my-robot",
    "diff": "fogspec diff --since main",
    "check": "fogspec check --since main",
}
EXITS = {
    0: "done", 1: "invalid file", 2: "wrong usage", 3: "out of date", 4: "infeasible", 5: "refused", 6: "cloud error",
    7: "not measured", 8: "busy", 70: "bug", 130: "interrupted",
}  # fmt: skip
ALWAYS = (0, 1, 2, 70, 130)
ENDS = {  # what a command may end with besides
    "init": (6,),
    "validate": (),
    "lock": (5, 6),
    "compile": (3, 4, 5, 7),
    "bench": (3, 4, 5, 6, 7, 8),
    "status": (5, 6),
    "menu": (3, 4, 5, 7),
    "explain": (3, 4, 5, 7),
    "report": (3, 4, 5, 7),
    "apply": (3, 4, 5, 6, 7, 8),
    "watch": (3, 5, 6, 8),
    "logs": (5, 6),
    "down": (3, 5, 6, 8),
    "diff": (3, 5),
    "check": (3, 5),
}

VERBS = {
    "init": "Write a commented, valid spec, or copy an example with its results",
    "validate": "Validate specs and report all errors",
    "explain": "Explain a field, an error code, or a choice",
    "compile": "Write plan and tasks; once measured, models, menu and manifest",
    "lock": "Pin catalog and images to digests",
    "status": "Show what is up to date, what is deployed and what was spent",
    "bench": "Measure the plan's samples; costs money, and asks first",
    "menu": "List candidate machines, optionally under other limits",
    "report": "Write a self-contained HTML report with interactive limits",
    "apply": "Deploy a manifest (idempotent); costs money, and asks first",
    "watch": "Keep deployments serving; restarts cost money, and it asks first",
    "logs": "Print the output of an application's nodes",
    "down": "Tear down an application and verify that nothing is left",
    "diff": "Compare with new output and the deployment, or with a commit",
    "check": "Check, before a merge, that apply would deploy what is committed",
}


def _verbosity(context: click.Context, parameter: click.Parameter, wanted: bool) -> None:
    if not wanted:
        return
    root = context.find_root()
    if root.meta.setdefault("verbosity", parameter.name) != parameter.name:
        raise click.UsageError("--quiet and --verbose exclude each other", context)
    set_verbosity(Verbosity.QUIET if parameter.name == "quiet" else Verbosity.VERBOSE)


VERBOSITY = (
    ("-q", "--quiet", "print only errors and the result"),
    (
        "-v",
        "--verbose",
        "also print all notes, which files are read, with their digests, and how long each stage takes",
    ),
)


# What many commands have stands last, in this order, and after a command's own options.
SHARED = ("catalog_path", "prices", "policies", "dry_run", "yes", "exit_code", "output", "color")


def _in_order(command: click.Command) -> None:
    """Put the options that many commands have behind a command's own, and show the default of each choice."""
    rank = {name: at for at, name in enumerate(SHARED)}
    command.params.sort(key=lambda one: rank.get(one.name or "", -1))
    for one in command.params:
        if isinstance(one, click.Option) and isinstance(one.type, click.Choice) and isinstance(one.default, str):
            one.show_default = True


def add_verbosity(command: click.Command) -> None:
    """Add the options that each command has."""
    if not any(one.name == "quiet" for one in command.params):
        _in_order(command)
        for short, long, text in VERBOSITY:
            option = click.Option([short, long], is_flag=True, expose_value=False, callback=_verbosity, help=text)
            command.params.append(option)
    for inner in command.commands.values() if isinstance(command, click.Group) else ():
        add_verbosity(inner)


def exits(besides: Sequence[int]) -> str:
    """Return the exit codes of a command, with their meanings, in lines of 80 columns."""
    said = ", ".join(f"{code} {EXITS[code]}" for code in sorted({*ALWAYS, *besides}))
    return textwrap.fill(said, 80, initial_indent="Exit codes: ", subsequent_indent=" " * 12)


class _Verbs(click.Group):
    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(VERBS)

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        if name not in VERBS:
            from fogspec.language.suggest import did_you_mean

            hints = did_you_mean(name, VERBS) or ["fogspec --help lists the commands"]
            raise UsageError(f"there is no command {name}", *hints)
        module = importlib.import_module(f"fogspec.cli.{name.replace('-', '_')}")
        command: click.Command = module.command
        add_verbosity(command)
        command.epilog = f"\b\nExample: {EXAMPLES[name]}\n{exits(ENDS[name])}"
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        for title, names in GROUPS.items():
            with formatter.section(title):
                formatter.write_dl([(name, VERBS[name]) for name in names])

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        formatter.write_paragraph()
        formatter.write("First steps:\n  fogspec init --example grasp-planning\n  fogspec menu grasp-planning\n")


@click.command(cls=_Verbs, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="fogspec")
def fogspec() -> None:
    """Find the right cloud machine for a robot's ROS 2 nodes, from measurements, and pin it in a pull request."""


add_verbosity(fogspec)


def usage(wrong: click.ClickException) -> list[str]:
    """Return what click says of a wrong command line, as lines."""
    found = [f"error: {wrong.format_message().removesuffix('.').replace(' Did you mean', '; did you mean')}"]
    context = wrong.ctx if isinstance(wrong, click.UsageError) else None
    if context is not None:
        found += [f"  {' '.join(context.get_usage().split())}", f"  options: {context.command_path} --help"]
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit with the documented exit code."""
    run(fogspec, "fogspec", arguments)


def run(command: click.Command, name: str, arguments: Sequence[str] | None) -> None:
    """Run a command under this name and exit with the documented exit code; `arguments` None: those of the process."""
    set_verbosity(Verbosity.NORMAL)
    try:
        ended = command.main(
            args=list(arguments) if arguments is not None else None, prog_name=name, standalone_mode=False
        )
        code = ended if isinstance(ended, int) else 0
    except click.ClickException as wrong:
        say(*usage(wrong), err=True)
        code = 2
    except (click.Abort, KeyboardInterrupt):
        say("interrupted", err=True)
        code = 130
    except DiagnosticError as problems:
        from fogspec.report.diagnostics import show_diagnostics

        show_diagnostics(problems.diagnostics)
        code = 1
    except FogspecError as outcome:
        say(f"error: {outcome.message}", *(f"  {hint}" for hint in outcome.hints), err=True)
        code = outcome.exit_code
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 0
    except Exception as bug:
        from fogspec.report.diagnostics import bug_paragraph

        say(bug_paragraph(bug), err=True)
        code = 70
    sys.exit(code)
