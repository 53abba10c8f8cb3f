"""What a person meets in a terminal: the next command, lines that fit, no color that is the only sign, quiet and verbose."""

import json
import re
import shlex
import shutil
import sys
from collections.abc import Iterator
from typing import Any

import click
import pytest

from fogspec.cli import VERBS, fogspec
from fogspec.cli.next_steps import KEPT
from tests.support.running import Shell, chosen, measure, project, shell  # noqa: F401

AT = ("--catalog", "offers.csv")
MANIFEST = "compiled/demo/manifest.yaml"
# What may follow a command; nothing follows one that prints a document, or that ends the work.
FOLLOWED_BY: dict[str, tuple[str, ...]] = {
    "init": ("validate", "compile", "menu"),
    "validate": ("compile",),
    "lock": ("compile",),
    "compile": ("lock", "bench", "compile", "explain"),
    "bench": ("bench", "compile"),
    "status": ("compile", "bench", "lock", "apply", "down"),
    "menu": ("explain", "compile"),
    "explain": ("bench", "compile", "lock", "apply"),
    "report": ("bench", "compile", "lock", "apply"),
    "apply": ("apply", "status"),
    "logs": (),
    "down": (),
    "watch": (),
    "diff": ("compile", "lock", "apply"),
    "check": (),
}
ESCAPES = re.compile(r"\x1b\[[0-9;]*m")


def commands_of(verb: str) -> click.Command:
    found = fogspec.get_command(click.Context(fogspec), verb)  # type: ignore[attr-defined]
    assert found is not None
    return found  # type: ignore[no-any-return]


@pytest.fixture
def done(shell: Shell) -> Shell:
    """A measured application with its manifest."""
    chosen(shell)
    return shell


def next_of(out: str) -> list[list[str]]:
    """Return the words of the commands that come next, without the prose around them."""
    lines = [line.removeprefix("next: ") for line in out.splitlines() if line.startswith("next: ")]
    return [shlex.split(line[line.index("fogspec ") :].split(", ")[0])[1:] for line in lines]


def test_the_table_has_every_command() -> None:
    assert FOLLOWED_BY.keys() == VERBS.keys()
    assert {verb for verbs in FOLLOWED_BY.values() for verb in verbs} <= VERBS.keys()
    assert {one.name for verb in VERBS for one in commands_of(verb).params} >= set(KEPT)


FOLLOWS = (
    (("validate", "demo"), "compile demo"),
    (("compile", "demo", *AT), "explain specs/demo.yaml"),
    (("explain", "demo"), f"apply {MANIFEST} --dry-run"),
    (("menu", "demo"), "explain specs/demo.yaml"),
    (("menu", "demo", "--alpha", "0.2"), "compile specs/demo.yaml"),
    (("report", "demo"), f"apply {MANIFEST} --dry-run"),
    (("status",), f"apply {MANIFEST} --dry-run"),
    (("apply", MANIFEST, "--dry-run", "--max", "$9/h"), f"apply {MANIFEST} --max '$9/h'"),
    (("bench", "demo", "--dry-run"), "compile specs/demo.yaml"),
    (("lock", "demo", *AT), "compile demo --catalog offers.csv"),
)


def test_a_command_ends_with_the_one_that_comes_next(done: Shell) -> None:
    for words, follows in FOLLOWS:
        (found,) = next_of(done(*words).out)
        assert shlex.join(found) == follows
        assert found[0] in FOLLOWED_BY[words[0]]
        commands_of(found[0]).make_context(found[0], found[1:])
        assert next_of(done("-q", *words).out) == []


def test_the_way_from_a_spec_to_a_deployment_is_a_chain_of_next_commands(shell: Shell) -> None:
    project(shell)
    (found,) = next_of(shell("validate", "specs/demo.yaml").out)
    (found,) = next_of(shell(*found).out)
    assert found == ["bench", "specs/demo.yaml"], "the plan remembers its price list"
    (again,) = next_of(shell(*found, "--dry-run").out)
    assert again == found
    measure(shell)
    (found,) = next_of(shell("status").out)
    chain = []
    while found[0] != "apply" or "--dry-run" in found:
        chain.append(found[0])
        (found,) = next_of(shell(*found).out)
    assert chain == ["compile", "explain", "apply"]


def test_a_part_of_the_plan_names_both_ways_on(shell: Shell) -> None:
    project(shell)
    measure(shell, only=1)
    (line,) = [one for one in shell("compile", *AT, code=7).out.splitlines() if one.startswith("next: ")]
    both = "bench specs/demo.yaml, or fogspec compile specs/demo.yaml --partial --catalog offers.csv"
    assert line == f"next: fogspec {both}"


def test_what_was_tried_is_what_the_spec_is_to_say(done: Shell) -> None:
    said = done("menu", "demo", "--latency", "5s", "--cost", "none", "--alpha", "0.25").out.splitlines()[-1]
    assert "(objective.alpha: 0.25, constraints.latency: 5s, constraints.cost: none)" in said


COMMANDS = (
    ("validate",),
    ("compile", *AT),
    ("status",),
    ("menu", "demo"),
    ("menu", "demo", "--latency", "100ms"),
    ("explain", "demo"),
    ("explain", "spec"),
    ("explain", "constraints.cost", "demo"),
    ("explain", "FS201"),
    ("bench", "demo", "--dry-run"),
    ("diff",),
    ("check",),
    ("check", "-v"),
    ("apply", MANIFEST, "--dry-run"),
    ("lock", "demo", *AT),
    ("down", "demo"),
)


def on_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let both streams look like a terminal of 80 columns that shows colors."""
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.delenv("NO_COLOR", raising=False)
    for stream in (sys.stdout, sys.stderr):
        monkeypatch.setattr(stream, "isatty", lambda: True, raising=False)


def test_lines_fit_a_terminal_of_80_columns(done: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    on_terminal(monkeypatch)
    wide = []
    for words in COMMANDS:
        ended = done(*words, code=None)
        assert ended.code in (0, 1, 4, 6)
        for line in ESCAPES.sub("", ended.out + ended.err).splitlines():
            word = max(line.split(), key=len, default="")
            copied = (
                re.match(r" *(next: )?fogspec ", line) or len(word) > 40
            )  # commands, paths and addresses stay whole
            if len(line) > 80 and not copied:
                wide.append(f"{' '.join(words)}: {line}")
    assert not wide


def test_colors_are_never_the_only_sign(done: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    on_terminal(monkeypatch)
    free = shutil.disk_usage(done.folder)  # others write to the disk between two looks
    monkeypatch.setattr(shutil, "disk_usage", lambda _: free)
    done("compile", *AT)
    looks = [words for words in COMMANDS if words[0] not in ("lock", "down")]
    colored = [done(*words, code=None) for words in looks]
    monkeypatch.setenv("NO_COLOR", "1")
    for words, before in zip(looks, colored, strict=True):
        plain = done(*words, code=None)
        assert ESCAPES.sub("", before.out) == plain.out, words
        assert ESCAPES.sub("", before.err) == plain.err, words
        assert not ESCAPES.search(plain.out + plain.err), words
    assert any(ESCAPES.search(one.out + one.err) for one in colored)


def test_errors_and_limits_have_colors_that_words_repeat(done: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    on_terminal(monkeypatch)
    done.write("specs/demo.yaml", done.read("specs/demo.yaml").replace("latency: 10s", "latency: ten"))
    said = done("validate", code=1).err
    assert "\x1b[31m" in said
    assert "error[FS204]" in ESCAPES.sub("", said)


def test_without_a_terminal_sentences_are_whole_and_tables_fit(done: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    said = done("menu", "demo").out
    assert any(len(line) > 80 for line in said.splitlines() if line.startswith("limits: "))
    table = [line for line in said.splitlines() if line.startswith((" ", ">", "-"))]
    assert len(table) > 2
    assert all(len(line) <= 80 for line in table)


def test_quiet_leaves_errors_and_the_result(done: Shell) -> None:
    said = done("compile", "-q", *AT)
    assert said.err == ""
    assert [line.split()[0] for line in said.out.splitlines()] == [
        "demo",
        "choice",
        "latency",
        "cost",
        "price",
        "with",
        "network",
    ]
    assert done("--quiet", "validate").out == "1 application in 1 file valid: demo\n"
    done.write("specs/demo.yaml", done.read("specs/demo.yaml").replace("latency: 10s", "latency: ten"))
    assert "error[FS204]" in done("-q", "validate", code=1).err


def test_quiet_still_shows_a_price_before_money_is_spent(shell: Shell) -> None:
    project(shell)
    said = shell("-q", "bench", "demo", "--dry-run")
    assert "at most $" in said.err


def test_verbose_names_what_was_read_and_how_long_it_took(done: Shell) -> None:
    said = done("compile", "demo", "-v", *AT).err
    assert re.search(r"^verbose: read specs/demo.yaml: [\d,]+ bytes, sha256:[0-9a-f]{64}$", said, re.MULTILINE)
    assert re.search(r"^verbose: read results/demo/aws-r1-a-small.yaml: ", said, re.MULTILINE)
    assert re.search(r"^verbose: catalog .*: [0-9]+ offers, sha256:[0-9a-f]{64}$", said, re.MULTILINE)
    assert re.search(r"^verbose: demo: compiling took [\d.]+ s$", said, re.MULTILINE)
    assert "verbose" not in done("compile", "demo", *AT).err, "it is over with the command"
    assert "exclude each other" in done("-q", "compile", "-v", code=2).err
    assert "error: No such option: --name; did you mean --prune?" in done("compile", "--name", code=2).err


def test_the_age_of_prices_is_mentioned_by_compile_alone(done: Shell) -> None:
    done.write("specs/demo.yaml", done.read("specs/demo.yaml").replace("aws/r1", "aws/us-east-1"))
    assert "prices in us-east-1 were unchanged" in done("compile", "demo", "-v", "--catalog", "snapshot", code=7).out
    for words in (("status",), ("bench", "demo", "--dry-run"), ("diff",)):
        said = done(*words, code=None)
        assert "were unchanged" not in said.out + said.err, words


def leaves(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict):
        for key, one in value.items():
            yield from leaves(one, f"{path}.{key}")
    elif isinstance(value, list):
        for one in value:
            yield from leaves(one, path)
    else:
        yield path, value


QUANTITY = re.compile(r"\s*\$?\d[\d.,]*\s*(s|ms|us|min|h|d|GiB|MiB|GB|USD|\$|)(/(h|request|month|GiB))?\s*")
TEXTS = ("id", "before", "after", "running", "manifest", "date", "revision", "version", "detail")


def test_json_has_numbers_with_the_unit_in_the_key(done: Shell) -> None:
    seen = [("compile",), ("status",), ("menu", "demo"), ("menu", "demo", "--latency", "100ms"), ("explain", "demo")]
    seen += [("diff",), ("check",), ("bench", "demo", "--dry-run"), ("lock", "demo")]
    for words in seen:
        found = dict(leaves(json.loads(done(*words, "-o", "json", code=None).out)))
        assert found, words
        for path, value in found.items():
            if isinstance(value, str) and path.rpartition(".")[2] not in TEXTS:
                assert not QUANTITY.fullmatch(value), (words, path, value)
            if isinstance(value, float) and re.search(r"price|cost|spent|budget|month", path):
                assert "usd" in path, (words, path)


def test_json_of_a_machine_is_the_same_everywhere(done: Shell) -> None:
    (menu,) = json.loads(done("menu", "demo", "-o", "json").out)
    (compiled,) = json.loads(done("compile", *AT, "-o", "json").out)
    (explained,) = json.loads(done("explain", "demo", "-o", "json").out)
    assert menu["balanced"] == compiled["menu"]["balanced"] == explained["balanced"]
    chosen = menu["balanced"]
    assert chosen["memory_gib"] in (4, 8, 16, 32)
    beside = 2 * (20.11 / 730)  # disk and address, as is assumed of regions that are not known
    assert chosen["price_usd_per_hour"] + beside == pytest.approx(chosen["usd_per_month"] / 730, rel=1e-3)
    assert chosen["interval_s"][0] <= chosen["latency_s"] <= chosen["interval_s"][1]
    assert menu["limits"] == {"latency_s": 10, "cost_usd_per_request": 1}


def test_a_name_that_is_nearly_right_is_suggested_also_for_an_invalid_spec(shell: Shell) -> None:
    shell.write(
        "specs/other-file.yaml", "apiVersion: fogspec.dev/v1alpha1\nkind: Application\nmetadata: {name: my-robot}\n"
    )
    assert "did you mean my-robot?" in shell("bench", "my-robo", code=2).err
    assert "error[FS" in shell("bench", "my-robot", code=1).err


def test_the_code_to_read_about_is_an_error_s(done: Shell) -> None:
    text = done.read("specs/demo.yaml").replace("callback: plan", "request: /in, response: /out")
    done.write("specs/demo.yaml", text.replace("cost: $1/request", "cost: lots"))
    said = done("validate", code=1).err
    last = said.splitlines()[-1]
    code = last.rpartition(" ")[2]
    assert f"error[{code}]" in said
