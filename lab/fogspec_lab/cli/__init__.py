"""Run the command line of the lab: it reads options, prints and exits as fogspec's own does."""

import importlib
from collections.abc import Sequence

import click

from fogspec import __version__
from fogspec.cli import EXITS, add_verbosity, exits, run

COMMANDS = {  # name: what it does, an example
    "evaluate": ("Replay sampling and choosing against full measurements", "fogspec-lab evaluate --suite DIR"),
    "replay": (
        "Rehearse a bench with recorded results, free of charge",
        "fogspec-lab replay my-robot --from results.yaml",
    ),
    "library": ("Build a machine library from other workloads", "fogspec-lab library --from DIR"),
    "conformance": (
        "Prove fogspec on an engine; costs money there, and asks first",
        "fogspec-lab conformance --infra slurm/lab --max '$2'",
    ),
    "paper": ("Print the paper's tables beside ours, and write the page of both", "fogspec-lab paper --check"),
    "snapshot": ("Write the bundled catalog from the packages that have its data", "fogspec-lab snapshot --check"),
}


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="fogspec-lab")
def lab() -> None:
    """Evaluate fogspec's choices, build machine libraries, and prove fogspec on an engine."""


for _name, (_text, _example) in COMMANDS.items():
    _command = importlib.import_module(f"fogspec_lab.cli.{_name}").command
    _command.short_help = _text
    _command.epilog = f"\b\nExample: {_example}\n{exits(list(EXITS))}"
    lab.add_command(_command, _name)
add_verbosity(lab)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit with the documented exit code."""
    run(lab, "fogspec-lab", arguments)
