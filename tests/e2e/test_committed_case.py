"""The case in this repository that deploys on any host: its dry run on the host measured, on another, on a small one."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from fogspec.agent import machine_facts
from fogspec.base import host
from fogspec.results.io import read_results_folder
from tests.support.running import Shell, shell  # noqa: F401

ROOT = Path(__file__).resolve().parents[2]
NAME = "cubicles-planner"


@pytest.fixture
def checkout(shell: Shell) -> Shell:
    for folder in ("specs", "results", "compiled"):
        shutil.copytree(ROOT / folder / NAME, shell.folder / folder / NAME)
    shutil.copy(ROOT / "compiled" / "agent.pyz", shell.folder / "compiled")
    return shell


def on(checkout: Shell, monkeypatch: pytest.MonkeyPatch, cpus: int, cpu: str | None) -> tuple[int, dict[str, Any]]:
    """Return the exit code of a dry run on a host with these CPUs, and what it says of the host; None is the one measured."""
    server = read_results_folder(ROOT / "results" / NAME).spec.samples[0].server
    assert server is not None
    facts = {"cpu": server.cpu, "threads": server.threads} if cpu is None else {"cpu": cpu, "threads": cpus}
    monkeypatch.setattr(machine_facts, "read", lambda: facts)
    monkeypatch.setattr(host, "capacity", lambda: (cpus, 4.0 * cpus))
    assert "manifest verified" in checkout("check").out
    ended = checkout("apply", NAME, "--dry-run", "-o", "json", code=None)
    (found,) = [one for one in json.loads(ended.out) if one["what"] == "host"]
    return ended.code, found


def test_on_the_host_that_was_measured(checkout: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    code, found = on(checkout, monkeypatch, 2, None)
    assert (code, found["state"], found["detail"]) == (0, "ok", "this host has 2 CPUs and 8 GiB")


def test_another_host_is_accepted_with_a_warning(checkout: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    code, found = on(checkout, monkeypatch, 64, "Another CPU")
    assert (code, found["state"]) == (0, "not checked")
    assert "latency may differ" in found["detail"]
    assert found["fixes"] == [f"fogspec bench specs/{NAME}/{NAME}.yaml --all"]


def test_a_host_with_one_cpu_is_refused_and_says_why(checkout: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    code, found = on(checkout, monkeypatch, 1, "Another CPU")
    assert (code, found["state"]) == (1, "problem")
    assert found["detail"] == "2cpu-1gib does not fit: this host has 1 CPU and 4 GiB"
