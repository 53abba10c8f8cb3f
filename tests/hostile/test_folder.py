"""A checkout full of modules, programs and configuration that would run by accident: no verb runs any of it.

Each of them leaves a mark outside of the folder. What the user's own workload is made of runs, of course.
"""

import functools
import importlib.metadata
import json
import os
import stat
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from fogspec.backends.registry import owner_of
from fogspec.base.layout import Layout
from fogspec.cli import VERBS
from tests.corners.test_action import run_step
from tests.support.deployed import HOSTS, SPEC
from tests.support.github import serving

BIN = Path(sys.executable).parent
ROOT = Path(__file__).resolve().parents[2]
WORK = """\
number=0
while :; do
  number=$((number + 1))
  printf '{"name": "work", "start_s": %s.0, "latency_s": 0.01, "ok": true}\\n' "$number" >> "$FOGSPEC_TIMINGS"
  /bin/sleep 0.01
done
"""
PROGRAMS = (
    "git", "bash", "sh", "env", "python", "python3", "ssh", "rsync", "timeout", "head", "cut", "rm", "printf", "nvidia-smi",
    "docker-credential-evil", "cc", "gcc", "uname", "id", "sudo", "systemctl",
)  # fmt: skip
CLOUD = {
    "apiVersion": "fogspec.dev/v1alpha1", "kind": "LiveState", "metadata": {"name": "tiny"},
    "spec": {"spent": "$0.0", "machines": [{
        "name": "fogspec-tiny-01234567-abcdef", "deployer": "skypilot", "state": "serving", "manifest": "sha256:" + "0" * 64,
        "machine": {"infra": "aws/us-east-1", "instance": "m5.large", "cpus": 2, "memory": "8GiB", "price": "$0.1/h"},
        "runs": "sha256:" + "0" * 64, "files": {}, "fallback": 0, "at": "1s", "boot": "none",
        "since": "2026-01-01T00:00:00+00:00",
    }]},
}  # fmt: skip


REACHED = (
    "Could not connect to SkyPilot API server",
    "OutOfSync, Unknown",
)  # so its process was started, and imported it


@functools.cache
def installed() -> frozenset[str]:
    """Every importable name: a read of the metadata of hundreds of packages."""
    return frozenset(importlib.metadata.packages_distributions())


class Hostile:
    """The folder, and the marks that were left."""

    def __init__(self, folder: Path) -> None:
        self.project, self.marks, self.home = folder / "project", folder / "marks", folder / "home"
        for each in (self.project, self.marks, self.home):
            each.mkdir()
        for name, text in (
            ("specs/tiny.yaml", SPEC.replace("python3, work.py", "/bin/sh, work.sh")),
            ("hosts.csv", HOSTS),
        ):
            (self.project / name).parent.mkdir(exist_ok=True)
            (self.project / name).write_text(text)
        (self.project / "specs" / "work.sh").write_text(WORK)
        for trap in (self.project, self.project / "specs"):
            self.set(trap)
        self.git()

    def set(self, folder: Path) -> None:
        """Fill a folder with every module that anything here imports, and with programs."""
        third = {name for name in installed() if name.isidentifier()}
        others = {"sitecustomize", "usercustomize", "conftest", "fogspec_agent", "fogspec_probe", "pip", "backend"}
        for name in {*sys.stdlib_module_names, *third, *others}:
            if name not in ("fogspec", "sky"):
                (folder / f"{name}.py").write_text(self.leaves(f"module-{name}"))
        for name in ("fogspec", "sky", "fogspec/base", "fogspec/backends", "fogspec/cli"):
            (folder / name).mkdir()
            (folder / name / "__init__.py").write_text(self.leaves(f"package-{name.replace('/', '.')}"))
            (folder / name / "__main__.py").write_text(self.leaves(f"package-{name.replace('/', '.')}"))
        for name in PROGRAMS:
            self.program(folder / name)
        # It may name code and another API server. This one would end SkyPilot's process with another sentence.
        (folder / ".sky.yaml").write_text("api_server: 7\n")

    def leaves(self, name: str) -> str:
        return f"open({str(self.marks / name)!r}, 'a').close()\n"

    def program(self, path: Path) -> Path:
        path.write_text(f"#!/bin/sh\n: >> '{self.marks}/program-{path.name}'\n")
        path.chmod(path.stat().st_mode | stat.S_IXUSR)
        return path

    def git(self) -> None:
        """A repository whose configuration names programs wherever git would run one."""
        words = {
            "capture_output": True,
            "check": True,
            "cwd": self.project,
            "env": {**os.environ, "PATH": "/usr/bin:/bin"},
        }
        subprocess.run(["git", "init", "-q"], **words)
        subprocess.run(["git", "add", "specs/tiny.yaml", "hosts.csv"], **words)
        who = ["-c", "user.name=a", "-c", "user.email=a@example.org", "-c", "commit.gpgsign=false"]
        subprocess.run(["git", *who, "commit", "-q", "-m", "all"], **words)
        evil = self.program(self.project / "evil")
        for name in ("core.fsmonitor", "diff.external", "core.pager", "pager.show", "diff.evil.textconv", "filter.evil.smudge",
                     "filter.evil.clean", "filter.evil.process", "gpg.program", "core.sshCommand", "core.askPass",
                     "credential.helper", "interactive.diffFilter", "uploadpack.packObjectsHook"):  # fmt: skip
            subprocess.run(["git", "config", name, str(evil)], **words)
        subprocess.run(["git", "config", "diff.evil.command", str(evil)], **words)
        (self.project / ".gitattributes").write_text("* diff=evil filter=evil\n")
        # Of another time than in the index, they are read again, through their filter.
        for name in ("specs/tiny.yaml", "hosts.csv"):
            os.utime(self.project / name, (1_600_000_000, 1_600_000_000))
        hooks = self.project / ".git" / "hooks"
        for name in ("post-checkout", "post-index-change", "reference-transaction", "pre-commit"):
            self.program(hooks / name)

    def merged(self) -> list[str]:
        """Check out a merge as GitHub makes it; return its base, its head and itself."""

        def plumbing(*words: str) -> str:
            who = ["-c", "core.hooksPath=/dev/null", "-c", "user.name=a", "-c", "user.email=a@example.org"]
            run = ["/usr/bin/git", *who, *words]
            return subprocess.run(run, cwd=self.project, check=True, capture_output=True, text=True).stdout.strip()

        commits = [plumbing("rev-parse", "HEAD")]
        for parents in (1, 2):
            named = [word for parent in commits[:parents] for word in ("-p", parent)]
            commits.append(plumbing("commit-tree", "HEAD^{tree}", *named, "-m", "all"))
        plumbing("update-ref", "HEAD", commits[-1])
        return commits

    def __call__(self, *words: str, cwd: str = ".", program: str = "fogspec") -> "subprocess.CompletedProcess[str]":
        environment = {
            **os.environ,
            "PATH": os.pathsep.join([".", "", str(BIN), os.environ["PATH"]]),
            "HOME": str(self.home),
            "XDG_CACHE_HOME": str(self.home / "cache"),
            "SKYPILOT_API_SERVER_ENDPOINT": "http://127.0.0.1:9",  # nothing listens there, and nothing is sent elsewhere
            "SKYPILOT_DISABLE_USAGE_COLLECTION": "1",
        }
        environment.pop("PYTHONPATH", None)
        ended = subprocess.run(
            [str(BIN / program), *words],
            cwd=self.project / cwd,
            env=environment,
            capture_output=True,
            text=True,
            timeout=1200,
        )
        assert "Traceback" not in ended.stderr, ended.stderr
        assert not (left := self.left()), f"{words} ran {left}: {ended}"
        return ended

    def left(self) -> list[str]:
        return sorted(path.name for path in self.marks.iterdir())


@pytest.fixture
def hostile(tmp_path: Path) -> Iterator[Hostile]:
    found = Hostile(tmp_path)
    yield found
    found("down", "tiny")


LIFE = (
    ("init", "other"),
    ("validate", "specs/tiny.yaml"),
    ("explain", "spec.probe"),
    ("validate", "specs/tiny.yaml", "-o", "yaml"),
    ("lock", "--catalog", "hosts.csv", "specs/tiny.yaml"),
    ("compile", "specs/tiny.yaml"),
    ("bench", "specs/tiny.yaml", "--runner", "local"),
    ("compile", "specs/tiny.yaml"),
    ("explain", "specs/tiny.yaml"),
    ("menu", "tiny"),
    ("report", "tiny"),
    ("check", "tiny", "-o", "statement"),
    ("diff", "--since", "HEAD", "specs/tiny.yaml"),
    ("check", "specs/tiny.yaml"),
    ("apply", "tiny", "--yes"),
    ("status", "specs/tiny.yaml"),
    ("watch", "tiny", "--once", "--max-restarts", "0"),
    ("logs", "tiny"),
    ("diff", "specs/tiny.yaml"),
    ("apply", "tiny", "--adopt"),
    ("down", "tiny"),
)
NEVER_WELL = (("bench", "specs/tiny.yaml", "--dry-run"),)
LAB = (("library", "--out", "library.json.gz"), ("evaluate", "specs/tiny.yaml"))  # end never well, for lack of data


@pytest.mark.slow
def test_no_verb_runs_what_lies_in_the_working_folder(hostile: Hostile) -> None:
    assert {words[0] for words in (*LIFE, *NEVER_WELL)} == set(VERBS)
    for words in LIFE:
        ended = hostile(*words)
        assert ended.returncode == 0, f"{words}: {ended}"
    for words in NEVER_WELL:
        hostile(*words)
    ended = hostile("conformance", program="fogspec-lab")
    assert ended.returncode == 0, ended
    for words in LAB:
        hostile(*words, program="fogspec-lab")
    hostile("status", "tiny.yaml", cwd="specs")


# A package that needs no index: what the action installs there is ours, and every other step is the real one.
BACKEND = """\
import zipfile

def build_wheel(folder, *_):
    with zipfile.ZipFile(f"{folder}/small-1-py3-none-any.whl", "w") as wheel:
        wheel.writestr("small.py", "")
        wheel.writestr("small-1.dist-info/METADATA", "Metadata-Version: 2.1\\nName: small\\nVersion: 1\\n")
        wheel.writestr("small-1.dist-info/WHEEL", "Wheel-Version: 1.0\\nRoot-Is-Purelib: true\\nTag: py3-none-any\\n")
        wheel.writestr("small-1.dist-info/RECORD", "")
    return "small-1-py3-none-any.whl"
"""


@pytest.mark.slow
def test_no_step_of_the_action_runs_what_lies_in_the_checkout(hostile: Hostile, tmp_path: Path) -> None:
    small, temp = tmp_path / "small", tmp_path / "temp"
    for name, text in (
        ("pyproject.toml", '[build-system]\nrequires = []\nbuild-backend = "backend"\nbackend-path = ["."]\n'),
        ("backend.py", BACKEND), ("requirements/build.txt", "\n"), ("requirements/run.lock", "\n"),
    ):  # fmt: skip
        (small / name).parent.mkdir(parents=True, exist_ok=True)
        (small / name).write_text(text)
    temp.mkdir()
    assert all((hostile.project / name).exists() for name in ("venv.py", "ensurepip.py", "pip.py"))
    base, head, _ = hostile.merged()
    given = {
        "RUNNER_TEMP": str(temp), "HOME": str(hostile.home), "PATHS": "specs/tiny.yaml\n",
        "ALLOW_POLICY_CHANGE": "false", "BASE": base, "HEAD": head,
        "PULL_REQUEST": "7", "FILES": "https://example.org/raw", "RESOLVE_IMAGE": "false", "PIP_NO_INDEX": "1",
        **{f"GITHUB_{name}": str(temp / name) for name in ("PATH", "OUTPUT", "STEP_SUMMARY")},
    }  # fmt: skip
    with serving() as github:
        for name, code, action in (("install", 0, small), ("validate", 0, ROOT), ("base", 0, ROOT), ("review", 0, ROOT),
                                   ("comment", 0, ROOT), ("check", 0, ROOT)):  # fmt: skip
            ended = run_step(name, hostile.project, starts=True, **given, **github.environment(), ACTION=str(action))
            assert not (left := hostile.left()), f"{name} ran {left}: {ended}"
            assert ended.returncode == code, ended
    assert (temp / "OUTPUT").read_text() == f"base={base}\n"
    assert list(temp.glob("fogspec/lib/python*/site-packages/small.py"))
    assert len(github.comments) == 1


@pytest.mark.slow
@pytest.mark.parametrize("verb", ["status", "down", "bench"])
def test_skypilots_process_runs_nothing_of_it(hostile: Hostile, verb: str) -> None:
    """A live state that names a cloud machine starts SkyPilot, also for a verb that only looks."""
    state = hostile.project / ".fogspec" / "tiny" / "deployment.yaml"
    state.parent.mkdir(parents=True)
    ours = owner_of(Layout.of(hostile.project / "specs" / "tiny.yaml", "tiny")).deployment_name(
        "sha256:01234567", "abcdef"
    )
    state.write_text(json.dumps(CLOUD).replace("fogspec-tiny-01234567-abcdef", ours))
    hostile("compile", "specs/tiny.yaml")
    words = {
        "status": ["specs/tiny.yaml"],
        "down": ["tiny"],
        "bench": ["specs/tiny.yaml", "--runner", "skypilot", "--yes"],
    }
    ended = hostile(verb, *words[verb])
    assert any(word in ended.stdout + ended.stderr for word in REACHED), ended
    state.unlink(missing_ok=True)


@pytest.mark.slow
def test_the_suite_itself_notices(hostile: Hostile) -> None:
    """The traps are set where an interpreter, a shell and git would step into them."""
    for words, mark in (
        ([sys.executable, "-m", "fogspec", "validate"], "module-importlib"),
        ([sys.executable, "-c", "import queue"], "module-queue"),
        ([sys.executable, "-c", "import sky"], "package-sky"),
        (["/bin/sh", "-c", "PATH=.:$PATH; timeout 1"], "program-timeout"),
        (["/usr/bin/git", "status"], "program-evil"),
    ):
        subprocess.run(words, cwd=hostile.project, capture_output=True)
        left = hostile.left()
        for name in left:
            (hostile.marks / name).unlink()
        assert mark in left, words
