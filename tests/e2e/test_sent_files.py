"""What is verified is what runs: every change of a file that machines are sent, before every command."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.running import Shell, measure, project, shell, spec  # noqa: F401
from tests.support.scenes import Scene

MANIFEST = "compiled/demo/manifest.yaml"
VERBS = {
    "status": ("status", "--exit-code"),
    "compile --check": ("compile", "--check"),
    "lock --check": ("lock", "--check"),
    "diff": ("diff", "--exit-code"),
    "verify": ("verify", MANIFEST),
    "attest": ("attest", MANIFEST),
    "apply": ("apply", MANIFEST, "--dry-run"),
    "bench": ("bench", "specs/demo.yaml", "--runner", "skypilot", "--dry-run"),
}


def swapped(folder: Path) -> None:
    (folder / "latest").unlink()
    (folder / "latest").symlink_to("work.py")


def link_for_file(folder: Path) -> None:
    (folder / "lib/helper.py").rename(folder / "lib/other.py")
    (folder / "lib/helper.py").symlink_to("other.py")


CHANGES: dict[str, tuple[str, Callable[[Path], object]]] = {
    "an imported module": ("lib/helper.py", lambda folder: (folder / "lib/helper.py").write_text("x = 2\n")),
    "a mode": ("work.py", lambda folder: (folder / "work.py").chmod(0o755)),
    "a new module that hides another": ("json.py", lambda folder: (folder / "json.py").write_text("")),
    "a module that is gone": ("lib/helper.py", lambda folder: (folder / "lib/helper.py").unlink()),
    "a link that leads elsewhere": ("latest", swapped),
    "a link in place of a file": ("lib/helper.py", link_for_file),
}


@pytest.fixture
def locked(shell: Shell) -> Shell:
    """A project that is locked, compiled, measured and chosen; its node imports a module that the spec does not name."""
    shell.write("specs/lib/helper.py", "x = 1\n")
    shell.write("specs/parameters.yaml", "a: 1\n")
    (shell.folder / "specs/latest").symlink_to("lib/helper.py")
    project(shell)
    shell("lock", "--catalog", "offers.csv")
    shell("compile")
    measure(shell)
    shell("compile")
    for words in VERBS.values():
        shell(*words)
    return shell


@pytest.mark.parametrize("change", CHANGES)
def test_every_verb_names_the_file_that_changed(locked: Shell, change: str) -> None:
    name, make = CHANGES[change]
    make(locked.folder / "specs")
    for verb, words in VERBS.items():
        said = locked(*words, code=3)
        assert name in said.out + said.err, verb
        if name != "work.py":
            assert "work.py" not in (said.out + said.err).replace("link to work.py", ""), f"{verb} blames another file"
    said = locked("compile")
    assert f"{name}" in said.err
    assert "fogspec lock" in said.err


@pytest.mark.parametrize("change", CHANGES)
def test_what_was_measured_before_the_change_does_not_count_after_locking_it(locked: Shell, change: str) -> None:
    name, make = CHANGES[change]
    make(locked.folder / "specs")
    assert f": demo: {name}" in locked("lock").out
    assert f"{name} is locked to something else" in locked("status").out
    before = (locked.folder / MANIFEST).read_bytes()
    said = locked("compile")
    assert (locked.folder / MANIFEST).read_bytes() == before, "no manifest of what was not measured"
    assert f"measured something else: {name}" in said.out
    assert "stale: it stays, and apply refuses it" in said.out
    assert "measured something else" in locked("bench", "specs/demo.yaml", "--dry-run", code=None).err
    locked("lock", "--check")


def test_what_no_machine_is_sent_changes_nothing(locked: Shell) -> None:
    folder = locked.folder / "specs"
    for name in (".git/HEAD", "lib/__pycache__/helper.pyc", ".env", ".fogspec/x", ".venv/bin/python"):
        locked.write(f"specs/{name}", "left behind\n")
    (folder / "empty").mkdir()
    os.utime(folder / "lib/helper.py", (1, 1))
    locked.write("specs/other.yaml", spec(name="other"))
    for words in VERBS.values():
        if words[0] not in ("compile", "status", "diff", "lock"):  # the other spec is not compiled
            locked(*words)
    for verb in ("status", "diff"):
        locked(verb, "specs/demo.yaml", "--exit-code")
    locked("compile", "specs/demo.yaml", "--check")
    locked("lock", "specs/demo.yaml", "--check")


def test_a_spec_says_what_is_not_sent_and_the_manifest_says_it_too(locked: Shell) -> None:
    demo = locked.read("specs/demo.yaml")
    locked.write("specs/demo.yaml", demo + "  ignore: [parameters.yaml, notes/]\n")
    assert "parameters.yaml" in locked("status", "--exit-code", code=3).out, "what was locked is not sent any more"
    locked("lock")
    locked.write("specs/notes/today.md", "nothing\n")
    locked("lock", "--check")
    locked("compile")
    measure(locked)
    locked("compile")
    manifest = locked.read(MANIFEST)
    assert "- notes/\n" in manifest
    assert "    files: 3\n" in manifest
    before = manifest.partition("  sent:")[2].partition("digest: ")[2].split()[0]
    assert before.startswith("sha256:")
    locked.write("specs/lib/helper.py", "x = 2\n")
    locked("lock")
    locked("compile")
    measure(locked)
    locked("compile")
    assert before not in locked.read(MANIFEST), "a reviewer sees that other files are sent"


@pytest.mark.parametrize("goal", ["/etc/passwd", "../../elsewhere", "../offers.csv"])
def test_a_link_that_leads_outside_is_refused_before_anything_is_read(locked: Shell, goal: str) -> None:
    (locked.folder / "specs/stolen").symlink_to(goal)
    for verb, words in VERBS.items():
        said = locked(*words, code=1)
        assert "specs/stolen: leads outside specs" in said.err, verb
        assert "spec.ignore" in said.err


def test_five_thousand_files_are_listed_and_a_change_among_them_is_named(locked: Shell) -> None:
    for number in range(500):
        locked.write(f"specs/data/{number % 10}/{number}.txt", str(number))
    locked("lock")
    locked.write("specs/data/3/123.txt", "changed")
    said = locked("verify", MANIFEST, code=3)
    assert "data/3/123.txt is not what the lock says" in said.out
    for number in range(500):
        locked.write(f"specs/data/{number % 10}/{number}.txt", "all of them")
    said = locked("status", "--exit-code", code=3).out
    assert "and 494 more files" in said
    assert len(said) < 5000


# Each sample spoils the folder of the spec, and its own copy, and says which module it had.
SPOILING = """\
import os, time
import helper
import fogspec_probe
print("the helper is", helper.VERSION, flush=True)
for folder in (".", "../../../../../specs"):
    with open(os.path.join(folder, "helper.py"), "w") as file:
        file.write("VERSION = 'spoiled'\\n")
while True:
    fogspec_probe.start("work")
    time.sleep(0.01)
    fogspec_probe.stop("work")
"""


def test_every_sample_gets_the_files_that_were_there_when_the_bench_began(tmp_path: Path) -> None:
    scene = Scene.made(tmp_path / "scene", SPOILING)
    (scene.folder / "specs/helper.py").write_text("VERSION = 'measured'\n")
    (scene.folder / "specs/.env").write_text("KEY=1\n")
    assert scene.run("lock").returncode == 0
    assert scene.run("compile").returncode == 0
    ended = scene.bench()
    assert ended.returncode == 0, ended.stderr
    state = scene.folder / ".fogspec/tiny"
    logs = ["".join(path.read_text() for path in one.rglob("*.log")) for one in state.glob("attempts/*")]
    assert len(logs) == 2
    assert all("the helper is measured" in log for log in logs), logs
    assert not list(state.glob("attempts/*/work")), "no copy is left"
    assert not (state / "sent").exists()
    again = scene.bench()
    assert again.returncode == 3, "the next command sees what was changed meanwhile"
    assert "helper.py" in again.stderr
