"""The help of the commands: an option means the same everywhere, in one order, with its default."""

import importlib
import re
from collections import defaultdict

import click
import pytest

from fogspec.cli import EXAMPLES, SHARED, VERBS, fogspec
from fogspec_lab.cli import lab

CONTEXT = click.Context(fogspec, info_name="fogspec")
COMMANDS = {name: fogspec.get_command(CONTEXT, name) for name in VERBS}
ALL = COMMANDS | {f"fogspec-lab {name}": one for name, one in lab.commands.items()}


def options(command: click.Command) -> dict[str, click.Option]:
    return {name: one for one in command.params if isinstance(one, click.Option) for name in one.opts}


def test_an_option_has_one_meaning() -> None:
    """Where the text differs, it is about that command: the options below have a meaning of their own in each."""
    own = {
        "--max",
        "--name",
        "--exit-code",
        "--resolve-image",
        "--since",
        "--yes",
        "--dry-run",
        "--workers",
        "--output",
        "-o",
    }
    texts: dict[str, set[tuple[str | None, str | None]]] = defaultdict(set)
    for command in COMMANDS.values():
        for name, one in options(command).items():
            texts[name].add((one.help, one.metavar))
    assert {name for name, found in texts.items() if len(found) > 1} <= own | {
        "-f",
        "--out",
    }


@pytest.mark.parametrize("name", ALL)
def test_each_option_is_described_and_in_order(name: str) -> None:
    command = ALL[name]
    for one in command.params:
        if isinstance(one, click.Option):
            assert one.help, one.name
            assert not one.help.endswith("."), one.name
            assert one.help[:1].islower() or one.help.startswith(("URL", "JSON", "Show")), one.name
            if isinstance(one.type, click.Choice) and one.default is not None:
                assert one.show_default or "[default" in one.help, one.name
            assert not re.search(r"\b(say|says|told|asks for)\b", one.help), one.name
    ranks = [SHARED.index(one.name or "") for one in command.params if one.name in SHARED]
    assert ranks == sorted(ranks)


@pytest.mark.parametrize("name", ALL)
def test_the_text_names_the_arguments_that_the_usage_names(name: str) -> None:
    text = ALL[name].get_help(click.Context(ALL[name], info_name=name))
    usage, rest = text.split("\n\n", 1)
    assert "SPECS" not in text
    for word in ("APP", "MANIFEST"):
        assert (word in usage) == bool(re.search(rf"\b{word}s?\b", rest)), word


@pytest.mark.parametrize("name", VERBS)
def test_the_example_is_a_command_line_that_is_accepted(name: str) -> None:
    """Up to the point at which its files are read: options and the number of arguments are right."""
    words = EXAMPLES[name].partition(" > ")[0].replace("'", "").split()
    if words[0] != "fogspec":
        return
    command = importlib.import_module(f"fogspec.cli.{name.replace('-', '_')}").command
    rest = words[2:]
    while isinstance(command, click.Group):
        command, rest = command.commands[rest[0]], rest[1:]
    parser = command.make_parser(click.Context(command))
    parsed, left, _ = parser.parse_args(args=list(rest))
    assert left == []
    needed = [one.name for one in command.params if one.required]
    assert all(parsed.get(one) for one in needed)
