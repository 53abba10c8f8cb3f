"""Run the command line; each command is a module that is imported when it is called."""

import importlib
import os
import sys
from collections.abc import Sequence

import click

from fogspec import __version__
from fogspec.base.console import say
from fogspec.base.diagnostics import DiagnosticError
from fogspec.base.errors import FogspecError, UsageError

VERBS = {
    "init": "write a commented, valid spec",
    "validate": "check specs and say every mistake at once",
    "explain": "explain a field, an error code, or a choice",
    "config": "print a spec merged with its overlays, defaults filled in",
    "compile": "write the plan and tasks; once measured, models, menu and manifest",
    "keys": "on the robot: make the key of its end of the link",
    "lock": "pin catalog, images, workspace and workload to digests",
    "status": "which stage is fresh or stale and why, and what was spent",
    "doctor": "what is wrong on this side, before any money is spent",
    "bench": "measure the plan's samples",
    "menu": "the choices on offer, also under other constraints",
    "report": "one self-contained page: spec, samples, models, a menu to weigh anew, costs",
    "apply": "run what a manifest says, idempotent",
    "ps": "what runs of all applications, also of those without a spec, and what it costs",
    "logs": "what an application's nodes print, and the last words of those that never answered",
    "down": "end everything of an application, and verify it",
    "diff": "what compile would write now against what is committed, and against what runs",
    "review": "what a change deploys, in Markdown for a pull request",
    "verify": "recompute the chain behind a manifest, byte for byte",
    "ci": "the gate in front of a merge: whether apply would deploy exactly what is committed",
    "attest": "an in-toto statement of where a manifest came from",
    "evaluate": "replay sampling and choosing against full measurements",
    "priors": "build a library of what machines do for other workloads",
}


class _Verbs(click.Group):
    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(VERBS)

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        if name not in VERBS:
            from fogspec.spec.suggest import did_you_mean

            hints = did_you_mean(name, VERBS) or ["fogspec --help lists the commands"]
            raise UsageError(f"there is no command {name}", *hints)
        module = importlib.import_module(f"fogspec.cli.{name}")
        command: click.Command = module.command
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Verbs"):
            formatter.write_dl(list(VERBS.items()))


@click.command(cls=_Verbs, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="fogspec")
def fogspec() -> None:
    """From a short spec to the right cloud machine for a robot's ROS 2 nodes, with the proof."""


def usage(wrong: click.ClickException) -> list[str]:
    """Return what click says of a wrong command line, as lines."""
    found = [f"error: {wrong.format_message().removesuffix('.')}"]
    context = wrong.ctx if isinstance(wrong, click.UsageError) else None
    if context is not None:
        found += [f"  {' '.join(context.get_usage().split())}", f"  options: {context.command_path} --help"]
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit with the documented exit code."""
    try:
        ended = fogspec.main(args=list(arguments) if arguments is not None else None, standalone_mode=False)
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
