"""Live state and journal with garbage in them: an answer that names the file, never a bug, and nothing is lost."""

import copy
import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from fogspec.base.diagnostics import DiagnosticError
from fogspec.base.errors import OutOfDate
from fogspec.base.layout import Layout
from fogspec.base.yaml.writer import yaml_text
from fogspec.bench.journal import Journal
from fogspec.catalog.machine import Machine
from fogspec.deploy.schema import DeployedMachine
from fogspec.deploy.state import DeploymentState, SystemWallClock
from fogspec.language.loader import read_plain
from tests.unit.bench.test_journal import whole

VALUES = (
    None, "", "x", -1, 10**30, 1e308, math.nan, math.inf, True, [], {}, ["a"], "../../away", "..", "1969-07-20", "9" * 400,
    "NaN", "$-1", "1e999s", "\x1b[2J",
)  # fmt: skip


def damaged(whole: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], Any]]:
    """The tree with one value gone, another, or twice, for every value in it."""
    for key, value in list(whole.items() if isinstance(whole, dict) else enumerate(whole)):
        for other in VALUES:
            yield (*path, key, other), {**whole, key: other} if isinstance(whole, dict) else [other]
        less = copy.copy(whole)
        del less[key]
        yield (*path, key, "gone"), less
        if isinstance(whole, list):
            yield (*path, key, "twice"), [*whole, value]
        if isinstance(value, (dict, list)):
            for where, inner in damaged(value, (*path, key)):
                yield where, {**whole, key: inner} if isinstance(whole, dict) else [inner]


def answer(read: Callable[[], Any]) -> Any:
    """What is read, or why it is not; anything else that is raised is a bug."""
    try:
        return read()
    except (DiagnosticError, OutOfDate) as refused:
        return refused


@pytest.fixture
def live(tmp_path: Path) -> DeploymentState:
    """What one machine leaves on disk."""
    file = DeploymentState(Layout(tmp_path, tmp_path / "specs/tiny.yaml", "tiny"), SystemWallClock(), [])
    machine = Machine.model_construct(infra="local", instance="1cpu-1gib", cpus=1, memory=1.0, spot=False, price=0.02)
    name = file.owner.deployment_name("sha256:12345678", "abcdef")
    file.put(DeployedMachine.model_construct(
        name=name, deployer="local", state="serving", manifest="sha256:1", machine=machine,
        runs="sha256:2", files={"work.py": "sha256:3"}, fallback=0, image=None, address="127.0.0.1", at=5.0, boot="b",
        since="2026-11-21T00:00:00+00:00",
    ))  # fmt: skip
    return file


@pytest.mark.slow
def test_a_live_state_with_any_value_changed_is_read_or_refused(live: DeploymentState) -> None:
    path, layout = live.layout.live, live.layout
    whole = read_plain(path)
    read = refused = 0
    for where, other in damaged(whole):
        try:
            path.write_text(yaml_text(other, "a test"), encoding="utf-8", errors="surrogatepass")
        except (TypeError, ValueError):
            continue
        found = answer(lambda: DeploymentState.read(layout, live.times))
        if isinstance(found, DiagnosticError):
            refused += 1
            assert {one.span.path for one in found.diagnostics} == {str(path)}, where
            assert "fogspec down tiny" in str(found.diagnostics[0].fix)
            continue
        read += 1
        assert 0 <= found.total_usd() < math.inf, where
        for machine in found.machines:
            assert found.folder(machine.name).resolve().parent == layout.deployed.resolve(), where
    assert read > 50
    assert refused > 400


@pytest.mark.slow
@pytest.mark.parametrize(
    "content", [b"", b"\0" * 99, b"\xff\xfe\x00", b"[" * 20000, b"null\n", b"kind: LiveState\n---\n"]
)
def test_a_live_state_that_is_none_is_said(live: DeploymentState, content: bytes) -> None:
    live.layout.live.write_bytes(content)
    with pytest.raises(DiagnosticError):
        DeploymentState.read(live.layout, live.times)


@pytest.mark.slow
def test_a_journal_with_any_value_changed_is_read_or_refused_and_left(tmp_path: Path) -> None:
    path = tmp_path / "journal.jsonl"
    whole(path).close()
    lines = path.read_bytes().splitlines(keepends=True)
    for number, line in enumerate(lines):
        for where, other in damaged(json.loads(line)):
            content = b"".join([*lines[:number], json.dumps(other).encode() + b"\n", *lines[number + 1 :]])
            path.write_bytes(content)
            found = answer(lambda: Journal(path))
            if isinstance(found, OutOfDate):
                assert found.message.startswith(f"{path}:"), where
            else:
                book = found.state
                found.close()
                assert 0 <= book.spent_usd + book.committed_usd < math.inf, (number, where)
                assert not any("/" in name for name in book.open), (number, where)
            assert path.read_bytes() == content, where
