"""A clone without the price list that a plan was made from: judged by what plan, menu and manifest say of it."""

import json
import re
import shutil
import socket
import sys
from collections.abc import Callable
from typing import Any, NoReturn

import pytest

from tests.support.deployed import SPEC, Deployed, app, tiny  # noqa: F401
from tests.support.repositories import git
from tests.support.running import CATALOG, Shell, measure, project, shell  # noqa: F401

AT = ("--catalog", "offers.csv")
MANIFEST, PLAN, MENU = (f"compiled/demo/{name}.yaml" for name in ("manifest", "plan", "menu"))
VERBS = {"check": ("check",), "status": ("status",), "apply": ("apply", "demo", "--dry-run")}


def connected(*_: Any, **__: Any) -> NoReturn:
    raise AssertionError("a connection was opened")


@pytest.fixture(params=["a file", "SkyPilot's", "another snapshot"])
def clone(request: pytest.FixtureRequest, shell: Shell, monkeypatch: pytest.MonkeyPatch) -> Shell:
    """A committed application in a clone whose price list is gone, without SkyPilot and without a network."""
    if request.param == "SkyPilot's":
        lists = shell.folder.parent / "sky/.sky/catalogs/v8/aws/vms.csv"
        lists.parent.mkdir(parents=True)
        lists.write_text(CATALOG)
    project(shell)
    if request.param == "another snapshot":
        shell.write("specs/demo.yaml", shell.read("specs/demo.yaml").replace("aws/r1", "aws/us-east-1"))
    at = {"a file": AT, "SkyPilot's": ("--catalog", "skypilot"), "another snapshot": ("--catalog", "snapshot")}[
        request.param
    ]
    shell("compile", *at)
    measure(shell)
    shell("compile")
    shell("check")
    git("init", "-q", folder=shell.folder)
    (shell.folder / "offers.csv").unlink()
    git("add", "-A", folder=shell.folder)
    git("commit", "-qm", "all", folder=shell.folder)
    shutil.rmtree(shell.folder.parent / "sky", ignore_errors=True)
    monkeypatch.setattr("fogspec.catalog.sources.snapshot.bundled_digest", lambda: "sha256:" + "0" * 64)
    monkeypatch.setitem(sys.modules, "sky", None)
    monkeypatch.setattr(socket.socket, "connect", connected)
    return shell


def test_a_clone_without_the_price_list_is_green(clone: Shell) -> None:
    said = clone("check").out
    assert re.search(r"ok    demo  manifest verified; prices as of .*, not judged again: ", said)
    assert {clone(*words).code for words in VERBS.values()} == {0}
    (found,) = json.loads(clone("status", "-o", "json").out)
    assert {stage["state"] for stage in found["stages"]} == {"fresh"}
    assert "not judged again" in found["stages"][0]["notes"][0]
    assert json.loads(clone("diff", "-o", "json").out)["applications"][0]["fields"] == []


def edited(path: str, old: str, new: str) -> Callable[[Shell], None]:
    def edit(shell: Shell) -> None:
        text = shell.read(path)
        changed = re.sub(old, new, text, count=1, flags=re.MULTILINE)
        assert changed != text, path
        shell.write(path, changed)

    return edit


EDITS = {
    "a limit": edited("specs/demo.yaml", "latency: 10s", "latency: 9s"),
    "what is measured": edited("specs/demo.yaml", "callback: plan", "callback: other"),
    "a sent file": lambda shell: shell.write("specs/work.py", "print('other')\n"),
    "where machines are": edited("specs/demo.yaml", "cpus: 2..8", "cpus: 2..32"),
    "the budget": edited("specs/demo.yaml", r"budget: \$5", "budget: $0.01"),
    "a setting of the plan": edited(PLAN, "^  duration: .*", "  duration: 9min"),
    "a price of the plan": edited(PLAN, r"price: \$[0-9.]+/h", "price: $$0.001/h".replace("$$", "$")),
    "a figure of the results": edited("results/demo/aws-r1-a-small.yaml", "requests: 20", "requests: 21"),
    "the models": edited("compiled/demo/models.yaml", "kind: .*", "kind: Models2"),
    "the machine": edited(MANIFEST, "instance: .*", "instance: a.huge"),
    "when it ends": edited(MANIFEST, "^  ready_timeout: .*", "  ready_timeout: 9min"),
    "its price": edited(MANIFEST, r"price: \$[0-9.]+/h", "price: $9.99/h"),
    "the task, and its digest": lambda shell: forged(shell),
    "the catalog of the plan": edited(PLAN, r"    digest: sha256:.{4}", "    digest: sha256:0000"),
    "the menu, removed": lambda shell: (shell.folder / MENU).unlink(),
}


def forged(shell: Shell) -> None:
    """A task that does something else, in a manifest that approves it."""
    from fogspec.base.digest import of_bytes

    path = shell.folder / "compiled/demo/deploy.sky.yaml"
    before = path.read_bytes()
    after = before.replace(b"run: ", b"run: curl evil; ", 1)
    assert after != before
    path.write_bytes(after)
    shell.write(MANIFEST, shell.read(MANIFEST).replace(of_bytes(before), of_bytes(after)))


@pytest.mark.parametrize("what", EDITS)
@pytest.mark.parametrize("clone", ["a file"], indirect=True)
def test_all_that_does_not_rest_on_prices_is_judged(clone: Shell, what: str) -> None:
    EDITS[what](clone)
    assert {verb: clone(*words, code=None).code for verb, words in VERBS.items() if verb != "status"} == {
        "check": 3,
        "apply": 3,
    }


@pytest.mark.parametrize("clone", ["a file"], indirect=True)
def test_a_list_that_is_here_and_changed_is_red(clone: Shell) -> None:
    clone.write("offers.csv", CATALOG)
    assert "not judged again" not in clone("check").out
    clone.write("offers.csv", CATALOG.replace("0.10", "0.11"))
    assert "new catalog" in clone("check", code=3).out


@pytest.mark.parametrize("clone", ["a file"], indirect=True)
def test_what_needs_prices_says_which_list_is_missing(clone: Shell) -> None:
    for verb in ("menu", "explain", "compile"):
        assert "offers.csv: the catalog cannot be read" in clone(verb, "demo", code=1).err


def test_shapes_of_a_host_are_green_on_another_one(
    app: Callable[..., Deployed], monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = SPEC.replace("    machines: [local/1cpu-1gib, local/2cpu-1gib]\n", "").replace(
        "hardware: {cpus: 1..2, memory: 1GiB..2GiB}", "hardware: {cpus: 1}"
    )
    here = app(spec, None)
    assert here("check", "tiny").stdout.startswith("ok    tiny  manifest verified\n")
    assert "$0/h" in here.apply("--dry-run").stderr
    monkeypatch.setattr("fogspec.base.host.capacity", lambda: (64, 3.0))
    assert "manifest verified; prices as of shapes of this host, not judged again: " in here("check", "tiny").stdout
    assert here("status", "tiny").returncode == 0
    here.change("latency: 1s", "latency: 999ms")
    here("check", "tiny", code=3)


def test_shapes_that_a_spec_names_are_the_same_on_every_host(
    app: Callable[..., Deployed], monkeypatch: pytest.MonkeyPatch
) -> None:
    here = app(SPEC, None)
    monkeypatch.setattr("fogspec.base.host.capacity", lambda: (64, 256.0))
    assert here("check", "tiny").stdout.startswith("ok    tiny  manifest verified\n")
    before = (here.folder / MANIFEST.replace("demo", "tiny")).read_bytes()
    here("compile", "specs/tiny.yaml")
    assert (here.folder / MANIFEST.replace("demo", "tiny")).read_bytes() == before


def test_shapes_of_this_host_with_prices_of_their_own_are_green_too(tiny: Deployed) -> None:
    assert tiny("check", "tiny").returncode == 0
    (tiny.folder / "hosts.csv").unlink()
    assert "ok    tiny  manifest verified; prices as of" in tiny("check", "tiny").stdout
