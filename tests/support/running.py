"""Running the command line on files, in this process, as a user would in a shell."""

import json
import os
import pickle
import shutil
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from fogspec.backends.protocol import Unreachable
from fogspec.backends.skypilot.client import Client
from fogspec.choice import relaxed
from fogspec.cli import ALWAYS, ENDS, main
from fogspec.language.loader import read_document
from fogspec.model import fit
from fogspec.plan.schema import Plan
from fogspec.results.schema import LatencySummary, Measured, ResultsBody
from tests.support.once import once
from tests.support.results import write


@dataclass
class Ended:
    """How a command ended."""

    code: int
    out: str
    err: str


@dataclass
class Shell:
    """A folder to run commands in."""

    folder: Path
    monkeypatch: pytest.MonkeyPatch
    capsys: pytest.CaptureFixture[str]

    def write(self, name: str, text: str) -> Path:
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
        return path

    def neighbour(self, name: str, text: str) -> str:
        """Write a spec and its workload into a directory of their own; return the path of the spec."""
        self.write(f"specs/{name}/work.py", "print('work')\n")
        path = f"specs/{name}/{name}.yaml"
        self.write(path, text)
        return path

    def read(self, name: str) -> str:
        return (self.folder / name).read_text(encoding="utf-8")

    def __call__(self, *words: str, code: int | None = 0, run: Callable[[Sequence[str]], None] = main) -> Ended:
        """Run a command line, by default of fogspec."""
        self.capsys.readouterr()
        before = os.getcwd()
        os.chdir(self.folder)
        try:
            with pytest.raises(SystemExit) as ended:
                run(words)
        finally:
            os.chdir(before)
        said = self.capsys.readouterr()
        found = Ended(int(ended.value.code or 0), said.out, said.err)
        assert code is None or found.code == code, f"{words}: {found}"
        if run is main and words and words[0] in ENDS:
            assert found.code in (*ALWAYS, *ENDS[words[0]]), f"{words[0]} --help does not name {found.code}: {words}"
        return found

    def judged(self, *words: str, code: int | None = None) -> Ended:
        """The same of a verb that judges; of `diff`, which reports, 3 is the code where it reports what is not approved."""
        found = self(*words, code=None)
        if words[0] == "diff" and not found.code:
            listed = json.loads(self(*words, "-o", "json").out)["applications"]
            edited = [sample for one in listed for sample in one["samples"] if sample["how"] == "edited"]
            found.code = 3 if edited or any(one["running"] or not one["fresh"] for one in listed) else 0
        assert code is None or found.code == code, f"{words}: {found}"
        return found


PARSE = YAML.parse


EVENTS: dict[str, tuple[Any, ...]] = {}


def _parsed(yaml: YAML, text: str) -> Iterator[Any]:
    """Yield the events of a text, which follow from it alone, and take ruamel.yaml a third of a command's time.

    Commands of one test, and tests of one worker, read the same files again and again, and each command would be a process that
    parses them. Only what was read to its end is kept: a reader stops early in what is wrong, and the rest may take minutes.
    """
    if text in EVENTS:
        yield from EVENTS[text]
        return
    found = []
    for event in PARSE(yaml, text):
        found.append(event)
        yield event
    if len(text) < 100_000:
        if len(EVENTS) >= 1000:
            EVENTS.clear()
        EVENTS[text] = tuple(found)


COMPUTED: dict[bytes, Any] = {}


def _computed(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function whose result follows from its arguments alone, and which computes it once for equal ones.

    Every command on a project fits the same few samples, and relaxes the same choice: a quarter of its time.
    """

    def once_each(*arguments: Any, **options: Any) -> Any:
        key = pickle.dumps((function.__name__, arguments, options))
        if key not in COMPUTED:
            if len(COMPUTED) >= 1000:
                COMPUTED.clear()
            COMPUTED[key] = function(*arguments, **options)
        return COMPUTED[key]

    return once_each


FIT_ALL, RELAX = _computed(fit.fit_all), _computed(relaxed.relax)


def _unanswered(client: Client, _op: str, **_arguments: Any) -> Future[Any]:
    """Answer as SkyPilot does where no API server may be started, as in tests, but without its process, which takes seconds."""
    _ = client.version
    call = Future[Any]()
    call.set_exception(Unreachable("no API server runs here, and none may be started"))
    return call


@pytest.fixture
def shell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Shell:
    """An empty folder, with a cache of its own, no docker configuration, none of SkyPilot's catalogs and no answer of it."""
    monkeypatch.setattr(Client, "begin", _unanswered)
    monkeypatch.setattr(YAML, "parse", _parsed)
    monkeypatch.setattr(fit, "fit_all", FIT_ALL)
    monkeypatch.setattr(relaxed, "relax", RELAX)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("SKY_RUNTIME_DIR", str(tmp_path / "sky"))
    monkeypatch.setenv("DOCKER_CONFIG", str(tmp_path / "docker"))
    monkeypatch.delenv("CI", raising=False)  # where tests run in CI, a project without a commit is deployed as well
    folder = tmp_path / "project"
    folder.mkdir()
    return Shell(folder, monkeypatch, capsys)


def copied(shell: Shell, key: str, fill: Callable[[Shell], None]) -> None:
    """Fill the folder with what `fill` writes, which is made once for all tests that ask for it by this key."""
    made = once(key, lambda folder: fill(replace(shell, folder=folder)))
    shutil.copytree(made, shell.folder, symlinks=True, dirs_exist_ok=True)


CATALOG = """InstanceType,AcceleratorName,AcceleratorCount,vCPUs,MemoryGiB,Price,SpotPrice,Region,AvailabilityZone
a.small,,,2,4,0.10,0.03,r1,
a.large,,,8,16,0.40,0.12,r1,
a.huge,,,32,64,1.60,0.48,r1,
b.small,,,2,8,0.12,,r1,
b.large,,,8,32,0.48,,r1,
b.huge,,,32,128,1.92,,r1,
g.small,T4,1,4,16,0.60,,r1,
g.large,T4,1,16,64,1.20,,r1,
"""


def spec(name: str = "demo", **parts: str) -> str:
    """A spec in YAML; `parts` are lines of its body in place of the usual ones. Its samples are the grid's unless it says."""
    body = {
        "cloud": "[{cmd: [python3, work.py]}]",
        "probe": "{callback: plan}",
        "constraints": "{latency: 10s, cost: $1/request}",
        "objective": "{alpha: 0.5}",
        "hardware": "{cpus: 2..8}",
        "infra": "[aws/r1]",
        "benchmark": "{budget: $5, stop: {requests: 20, duration: 1min}, ready_timeout: 1min}",
        **parts,
    }
    body.setdefault("library", "none")  # machines are made up, and each case has a model of its own
    if "sampler" not in body["benchmark"]:
        body["benchmark"] = body["benchmark"].removesuffix("}") + ", sampler: grid}"
    head = f"apiVersion: fogspec.dev/v1alpha1\nkind: Application\nmetadata: {{name: {name}}}\nspec:\n"
    return head + "".join(f"  {key}: {value}\n" for key, value in body.items())


def project(shell: Shell, work: str = "print('work')\n", **parts: str) -> None:
    """A spec, its workload and a catalog, compiled; once for all tests that begin with the same in an empty folder."""

    def fill(made: Shell) -> None:
        made.write("offers.csv", CATALOG)
        made.write("specs/work.py", work)
        made.write("specs/demo.yaml", spec(**parts))
        made("compile", "specs/demo.yaml", "--catalog", "offers.csv")

    if any(shell.folder.iterdir()):
        fill(shell)
    else:
        copied(shell, f"a project: {work} {sorted(parts.items())}", fill)


def chosen(shell: Shell) -> None:
    """The usual project, measured, with its manifest."""

    def fill(made: Shell) -> None:
        project(made)
        measure(made)
        made("compile", "specs/demo.yaml", "--catalog", "offers.csv")

    copied(shell, "a project with its manifest", fill)


def measure(shell: Shell, only: int | None = None, name: str = "demo") -> None:
    """Results for the plan's samples, as a bench would write them, with latencies that follow from the machines."""
    path = shell.folder / f"compiled/{name}/plan.yaml"
    plan = read_document(path, Plan)
    body = plan.spec
    records = [
        Measured(
            id=one.id, machine=one.machine, measured_on="test", state="ok", requests=20, duration=60.0,
            latency=LatencySummary(mean=0.5 + 4 / one.machine.cpus), spent=one.machine.price / 60,
        )
        for one in body.samples[:only]
    ]  # fmt: skip
    write(shell.folder / f"results/{name}", ResultsBody(inputs=body.inputs, runner="local", samples=records))
