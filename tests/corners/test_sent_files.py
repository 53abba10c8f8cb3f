"""What is verified is what runs: every change of a file that machines are sent, before every command."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.running import Shell, copied, measure, project, shell, spec  # noqa: F401
from tests.support.scenes import Scene

MANIFEST = "compiled/demo/manifest.yaml"
VERBS = {
    "diff": ("diff",),
    "check": ("check",),
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
    """A project that is compiled, measured and chosen, its catalog locked; its node imports a module that no spec names."""

    def fill(made: Shell) -> None:
        made.write("specs/lib/helper.py", "x = 1\n")
        made.write("specs/parameters.yaml", "a: 1\n")
        (made.folder / "specs/latest").symlink_to("lib/helper.py")
        project(made)
        made("lock", "--catalog", "offers.csv")
        made("compile")
        measure(made)
        made("compile")
        for words in VERBS.values():
            made.judged(*words, code=0)

    copied(shell, "a project whose node imports a module", fill)
    return shell


@pytest.mark.parametrize("change", CHANGES)
def test_every_verb_names_the_file_that_changed_until_it_is_as_it_was(locked: Shell, change: str) -> None:
    """What was measured before does not count, and counts again."""
    name, make = CHANGES[change]
    kept = locked.folder.with_name("kept")
    shutil.copytree(locked.folder / "specs", kept, symlinks=True)
    make(locked.folder / "specs")
    for verb, words in VERBS.items():
        said = locked.judged(*words, code=3)
        assert name in said.out + said.err, verb
        if name != "work.py":
            assert "work.py" not in (said.out + said.err).replace("link to work.py", ""), f"{verb} blames another file"
    before = (locked.folder / MANIFEST).read_bytes()
    said = locked("compile")
    assert (locked.folder / MANIFEST).read_bytes() == before, "no manifest of what was not measured"
    assert f"measured something else: {name}" in said.out
    assert "stale: it stays, and apply refuses it" in said.out
    assert "measured something else" in locked("bench", "specs/demo.yaml", "--dry-run", code=None).err
    shutil.rmtree(locked.folder / "specs")
    shutil.copytree(kept, locked.folder / "specs", symlinks=True)
    locked("compile")
    for words in VERBS.values():
        locked.judged(*words, code=0)


def test_what_no_machine_is_sent_changes_nothing(locked: Shell) -> None:
    folder = locked.folder / "specs"
    for name in (".git/HEAD", "lib/__pycache__/helper.pyc", ".env", ".fogspec/x", ".venv/bin/python"):
        locked.write(f"specs/{name}", "left behind\n")
    (folder / "empty").mkdir()
    os.utime(folder / "lib/helper.py", (1, 1))
    for words in VERBS.values():
        locked.judged(*words, code=0)


def test_a_neighbour_in_a_directory_of_its_own_changes_nothing(locked: Shell) -> None:
    locked.write("specs/two/two.yaml", spec(name="two"))
    locked.write("specs/two/work.py", "print('two')\n")
    for words in (*VERBS.values(), ("check", "demo")):
        if len(words) > 2 or words[0] in ("apply", "bench"):  # the new spec is not compiled
            locked(*words)
    locked("compile", "two", "--catalog", "offers.csv")
    locked.write("specs/two/work.py", "print('other')\n")
    locked("check", "demo")
    assert "work.py changed" in locked("status", "two").out


def test_a_neighbour_in_the_same_directory_must_be_told_apart(locked: Shell) -> None:
    locked.write("specs/other.yaml", spec(name="other"))
    said = locked("validate", code=1).err
    assert "error[FS567]: the directory of demo also holds other.yaml: name the files of each" in said
    assert "add 'files: [work.py]' to spec" in said
    files = "  files: [work.py, lib, parameters.yaml, latest]\n"
    for name in ("demo", "other"):
        locked.write(f"specs/{name}.yaml", spec(name=name) + files)
    locked("compile", "demo")
    locked("check", "demo")  # the same files are sent: the results count
    locked.write("specs/more.py", "")
    locked("check", "demo")
    locked.write("specs/lib/helper.py", "x = 2\n")
    assert "lib/helper.py" in locked("status", "demo").out


def test_only_listed_files_are_sent_and_the_manifest_has_their_digest(locked: Shell) -> None:
    demo = locked.read("specs/demo.yaml")
    locked.write("specs/demo.yaml", demo + "  files: [work.py, lib]\n")
    assert "parameters.yaml" in locked("status").out, "what was measured is not sent any more"
    locked("compile")
    measure(locked)
    locked("compile")
    manifest = locked.read(MANIFEST)
    assert "    files: 2\n" in manifest
    before = manifest.partition("  sent:")[2].partition("digest: ")[2].split()[0]
    assert before.startswith("sha256:")
    locked.write("specs/lib/helper.py", "x = 2\n")
    locked("compile")
    measure(locked)
    locked("compile")
    assert before not in locked.read(MANIFEST), "a reviewer sees that other files are sent"
    locked.write("specs/demo.yaml", demo + "  files: [lib]\n")
    assert "names work.py, which is not sent to machines" in locked("compile", code=1).err
    locked.write("specs/demo.yaml", demo + "  files: [work.py, lib, ../offers.csv]\n")
    assert "error[FS507]: spec.files[2] must be in the spec's folder" in locked("validate", code=1).err


@pytest.mark.parametrize("goal", ["/etc/passwd", "../../elsewhere", "../offers.csv"])
def test_a_link_that_leads_outside_is_refused_before_anything_is_read(locked: Shell, goal: str) -> None:
    (locked.folder / "specs/stolen").symlink_to(goal)
    for verb, words in VERBS.items():
        said = locked(*words, code=1)
        assert "specs/stolen: leads outside specs" in said.err, verb
        assert "spec.files" in said.err


def test_five_thousand_files_are_listed_and_a_change_among_them_is_named(locked: Shell) -> None:
    for number in range(500):
        locked.write(f"specs/data/{number % 10}/{number}.txt", str(number))
    locked("compile")
    measure(locked)
    locked("compile")
    locked.write("specs/data/3/123.txt", "changed")
    assert "data/3/123.txt changed" in locked("status").out
    for number in range(500):
        locked.write(f"specs/data/{number % 10}/{number}.txt", "all of them")
    said = locked("status").out
    assert "and 494 more" in said
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
