"""A link in each place that fogspec keeps files in: nothing behind it is written, emptied, renamed or deleted by any verb."""

import os
import re
import shutil
from pathlib import Path

import pytest

from fogspec.backends import registry
from fogspec.backends.registry import owner_of
from fogspec.base.errors import CloudError
from fogspec.base.layout import Layout
from tests.support.deployed import Deployed
from tests.support.running import Ended, Shell, shell  # noqa: F401

NAME = "tiny"
SPEC = f"specs/{NAME}.yaml"
# What reads or writes everything that there is.
VERBS = {
    "init": ("init", "other"),
    "lock": ("lock", "--catalog", "hosts.csv"),
    "compile": ("compile", SPEC),
    "bench": ("bench", SPEC, "--runner", "local"),
    "status": ("status", SPEC),
    "diff": ("diff", SPEC),
    "menu": ("menu", NAME),
    "report": ("report", NAME),
    "explain": ("explain", SPEC),
    "check": ("check", NAME),
    "diff --since": ("diff", "--since", "HEAD", SPEC),
    "apply": ("apply", NAME, "--dry-run", "--yes"),
    "measure": ("bench", SPEC, "--runner", "local", "--only", "local-1cpu-1gib"),
    "start": ("apply", NAME, "--yes"),
    "down": ("down", NAME),
}
STARTING = ("measure", "start")  # seconds each, so only where they may write
FOLDERS = ("compiled", f"compiled/{NAME}", f"compiled/{NAME}/tasks", f"compiled/{NAME}/scripts", f"compiled/{NAME}/link",
           "results", f"results/{NAME}", f"results/{NAME}/timings", ".fogspec", f".fogspec/{NAME}", f".fogspec/{NAME}/attempts",
           f".fogspec/{NAME}/deployed", "schemas")  # fmt: skip
# The user's own, and no paths.
NOT_MANAGED = {
    "root",
    "spec",
    "files",
    "beside_spec",
    "name",
    "application",
    "environment",
    "overlay",
    "argument",
    "measured",
}


def managed() -> list[str]:
    """Every path of the layout, so that one that is added is tried too."""
    layout = Layout(Path(), Path(SPEC), NAME)
    names = [name for name, value in vars(Layout).items() if isinstance(value, property) and name not in NOT_MANAGED]
    paths = [getattr(layout, name) for name in names]
    paths += [layout.task("local-1cpu-1gib"), layout.fallback(1), Path("schemas/Application.json")]
    return list(dict.fromkeys([*map(str, paths), *FOLDERS]))


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project with all that can be there, as far as it stays when nothing runs."""
    folder = tmp_path_factory.mktemp("links") / "measured"
    Deployed.made(folder)
    state = folder / ".fogspec" / NAME
    for path in (state / "attempts" / "fogspec-x", state / "deployed" / "Documents",
                 folder / f"compiled/{NAME}/link", folder / f"compiled/{NAME}/tasks", folder / "schemas"):  # fmt: skip
        path.mkdir(parents=True)
        (path / "precious.txt").write_text("precious")
    for path in (state / "lock", state / "journal.jsonl", folder / f"compiled/{NAME}/link/link.sh",
                 folder / f"compiled/{NAME}/deploy.fallback-1.sky.yaml", folder / "schemas/Application.json",
                 folder / f"compiled/{NAME}/report.html"):  # fmt: skip
        path.write_text("")
    return folder


def fingerprint(folder: Path) -> dict[str, tuple[object, ...]]:
    return {
        str(path.relative_to(folder)): (
            path.lstat().st_mtime_ns, path.lstat().st_mode, path.lstat().st_ino, path.read_bytes() if path.is_file() else b"",
        )
        for path in [folder, *sorted(folder.rglob("*"))]
    }  # fmt: skip


class Linked:
    """The project with one path replaced by a link to what stood there, outside."""

    def __init__(self, shell: Shell, measured: Path, path: str) -> None:
        self.of_timings = path.startswith(f"results/{NAME}") and not path.endswith(".yaml")
        self.shell, self.outside = shell, shell.folder.parent / "outside"
        shutil.copytree(measured, shell.folder, dirs_exist_ok=True)
        self.outside.mkdir()
        there, target = shell.folder / path, self.outside / "target"
        if there.exists():
            there.rename(target)
        else:
            target.write_text("precious")
        there.parent.mkdir(parents=True, exist_ok=True)
        there.symlink_to(target)
        self.before = fingerprint(self.outside)
        host = registry.deployment_backend

        def without_skypilot(infra: str) -> object:
            if infra != "local":
                raise CloudError("SkyPilot is not installed here")
            return host(infra)

        shell.monkeypatch.setattr(registry, "deployment_backend", without_skypilot)

    def __call__(self, verb: str) -> Ended:
        ended = self.shell(*VERBS[verb], code=None)
        assert fingerprint(self.outside) == self.before, f"{verb} touched what is outside: {ended}"
        said = (ended.out + ended.err).count("it is a link, which may lead out of the project")
        # `verify` and `attest` say it of a link of the chain that breaks; for `down`, what it cannot read may name a cloud.
        # Of raw timings it is a warning, or a reason why results are stale.
        refused = (1, 6) if verb == "down" and said else (0, 1, 3) if self.of_timings else (1, 3)
        assert ended.code in (refused if said else (0, 1, 2, 3, 5)), ended
        return ended


@pytest.mark.slow
@pytest.mark.parametrize("path", managed())
def test_no_verb_touches_what_a_link_leads_to(shell: Shell, measured: Path, path: str) -> None:
    linked = Linked(shell, measured, path)
    verbs = [verb for verb in VERBS if path.startswith(".fogspec") or verb not in STARTING]
    said = [verb for verb in verbs if "it is a link" in (ended := linked(verb)).out + ended.err]
    # Events are read and written where a watch restarts something.
    assert said or path.endswith("events.jsonl"), "a verb must name the link"
    assert os.path.islink(shell.folder / path), "the link is the user's to remove"


EVIL = ("../../../../evil", "..", "/tmp/evil", "a/b", ".hidden", "")


@pytest.mark.slow
@pytest.mark.parametrize("id", EVIL)
@pytest.mark.parametrize("path", [f"compiled/{NAME}/plan.yaml", f"results/{NAME}/local-1cpu-1gib.yaml"])
def test_an_id_that_is_a_path_is_refused_where_it_stands(shell: Shell, measured: Path, path: str, id: str) -> None:
    shutil.copytree(measured, shell.folder, dirs_exist_ok=True)
    file = shell.folder / path
    text = file.read_text()
    assert "id: local-1cpu-1gib" in text
    file.write_text(text.replace("id: local-1cpu-1gib", f"id: '{id}'"))
    before = fingerprint(shell.folder.parent)
    ended = shell("bench", SPEC, "--runner", "local", code=1)
    assert f"{path}:" in ended.err
    assert "id" in ended.err
    after = fingerprint(shell.folder.parent)
    own = re.compile(r"^(\.|cache)$|^cache/|\.fogspec")  # the cache of price lists
    left, there = ({name: value for name, value in found.items() if not own.search(name)} for found in (after, before))
    assert left == there


@pytest.mark.slow
def test_down_removes_what_is_its_own_and_says_so(shell: Shell, measured: Path) -> None:
    shutil.copytree(measured, shell.folder, dirs_exist_ok=True)
    (shell.folder / f".fogspec/{NAME}/journal.jsonl").unlink()
    layout = Layout(shell.folder, shell.folder / SPEC, NAME)
    ours = layout.deployed / owner_of(layout).deployment_name("sha256:01234567", "abcdef")
    (ours / "out").mkdir(parents=True)
    ended = shell("down", NAME)
    assert f".fogspec/{NAME}/deployed/{ours.name}: removed" in ended.err
    assert not ours.exists()
    assert (layout.deployed / "Documents" / "precious.txt").read_text() == "precious"


@pytest.mark.slow
def test_compile_removes_what_it_wrote_and_says_so(shell: Shell, measured: Path) -> None:
    shutil.copytree(measured, shell.folder, dirs_exist_ok=True)
    tasks = shell.folder / f"compiled/{NAME}/tasks"
    (tasks / "old.sky.yaml").write_text("# Generated by fogspec: do not edit.\n")
    (tasks / "mine.sky.yaml").write_text("# mine\n")
    ended = shell("compile", SPEC)
    assert f"compiled/{NAME}/tasks/old.sky.yaml: removed: it no longer follows from its inputs" in ended.err
    assert "mine" not in ended.err
    assert not (tasks / "old.sky.yaml").exists()
    assert (tasks / "mine.sky.yaml").exists()
