"""The terminal: one module prints, and what it prints cannot steer a terminal."""

import ast
from pathlib import Path

import pytest

import fogspec
from fogspec.base.console import say, say_json, say_text, styled
from fogspec.base.text import INVISIBLE

PACKAGE = Path(fogspec.__file__).parent
# These run on machines, or speak to a process of fogspec's over a pipe: their output is a protocol, not a terminal's.
ELSEWHERE = ("agent", "ros")
# The action's script is run by its path, isolated and without fogspec: it prints commands of GitHub's, each on a line.
ALONE = ("base/console.py", "review/github_comment.py")
PRINTS = {"print", "pprint", "Console", "input"}
OF_CLICK = {"echo", "secho", "echo_via_pager", "confirm", "prompt", "style", "progressbar", "get_text_stream"}
CLICKS = {f"click.{name}" for name in OF_CLICK}


def printing(path: Path) -> list[str]:
    """Return the calls in a module that print, or make a style or a console."""
    found = []
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Call):
            name = ast.unparse(node.func)
            to_a_pipe = any(one.arg == "file" for one in node.keywords)
            if (name.rpartition(".")[2] in PRINTS or name in CLICKS) and not to_a_pipe:
                found.append(f"{path.relative_to(PACKAGE)}:{node.lineno}: {name}")
        elif isinstance(node, ast.ImportFrom) and node.module == "click":
            found += [f"{path.relative_to(PACKAGE)}: {one.name}" for one in node.names if one.name in OF_CLICK]
        elif isinstance(node, ast.Attribute) and node.attr in ("write", "writelines", "buffer"):
            owner = node.value
            if (
                isinstance(owner, ast.Attribute)
                and owner.attr in ("stdout", "stderr")
                and ast.unparse(owner.value) == "sys"
            ):
                found.append(f"{path.relative_to(PACKAGE)}:{node.lineno}: {ast.unparse(node)}")
    return found


def test_no_other_module_prints() -> None:
    modules = [path for path in PACKAGE.rglob("*.py") if path.relative_to(PACKAGE).parts[0] not in ELSEWHERE]
    found = [line for path in modules if path.relative_to(PACKAGE).as_posix() not in ALONE for line in printing(path)]
    assert not found, "print with fogspec.base.console"
    assert len(printing(PACKAGE / "base/console.py")) >= 3


@pytest.mark.parametrize("hostile", ["\x1b[31mred", "a\rb", "\u202eb", "\udc80", "\x9b1m", "two\nlines"])
def test_what_is_printed_is_visible(hostile: str, capsys: pytest.CaptureFixture[str]) -> None:
    say(hostile, hostile, err=True)
    say_text(hostile)
    say_json({hostile: hostile})
    said = capsys.readouterr()
    assert not INVISIBLE.search(said.out + said.err)
    assert len(said.err.splitlines()) == 2


def test_only_fogspecs_own_styles_reach_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    say_text(styled("\x1b[8mhidden", fg="red"), color=True)
    assert capsys.readouterr().out == "\x1b[31m\\x1b[8mhidden\x1b[0m\n"
    say_text(styled("plain", fg="red"), color=False)
    assert capsys.readouterr().out == "plain\n"
