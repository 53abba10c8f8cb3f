"""Running the command line on files, in this process, as a user would in a shell."""

import os
from dataclasses import dataclass
from pathlib import Path

import pytest

from fogspec.base import digest
from fogspec.cli import main
from fogspec.plan.schema import Plan
from fogspec.results.schema import LatencySummary, Measured, ResultsBody, with_checksum
from fogspec.results.standing import measured_values
from fogspec.spec import fingerprints
from fogspec.spec.loader import load, read_document
from tests.support.files import write_yaml


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

    def read(self, name: str) -> str:
        return (self.folder / name).read_text(encoding="utf-8")

    def __call__(self, *words: str, code: int | None = 0) -> Ended:
        self.capsys.readouterr()
        before = os.getcwd()
        os.chdir(self.folder)
        try:
            with pytest.raises(SystemExit) as ended:
                main(words)
        finally:
            os.chdir(before)
        said = self.capsys.readouterr()
        found = Ended(int(ended.value.code or 0), said.out, said.err)
        assert code is None or found.code == code, f"{words}: {found}"
        return found


@pytest.fixture
def shell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Shell:
    """An empty folder, with a cache of its own, no docker configuration and none of SkyPilot's catalogs."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("SKY_RUNTIME_DIR", str(tmp_path / "sky"))
    monkeypatch.setenv("DOCKER_CONFIG", str(tmp_path / "docker"))
    folder = tmp_path / "project"
    folder.mkdir()
    return Shell(folder, monkeypatch, capsys)


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
        "benchmark": "{budget: $5, stop: {requests: 20, duration: 1min}, setup_timeout: 1min}",
        **parts,
    }
    if "sampler" not in body["benchmark"]:
        body["benchmark"] = body["benchmark"].removesuffix("}") + ", sampler: grid}"
    head = f"apiVersion: fogspec.dev/v1alpha1\nkind: Application\nmetadata: {{name: {name}}}\nspec:\n"
    return head + "".join(f"  {key}: {value}\n" for key, value in body.items())


def project(shell: Shell, **parts: str) -> None:
    """A spec, its workload and a catalog, compiled."""
    shell.write("offers.csv", CATALOG)
    shell.write("specs/work.py", "print('work')\n")
    shell.write("specs/demo.yaml", spec(**parts))
    shell("compile", "specs/demo.yaml", "--catalog", "offers.csv")


def measure(shell: Shell, only: int | None = None) -> None:
    """Results for the plan's samples, as a bench would write them, with latencies that follow from the machines."""
    plan = read_document(shell.folder / "compiled/demo/plan.yaml", Plan)
    body = plan.spec
    records = [
        Measured(
            id=one.id, machine=one.machine, measured_on="test", state="ok", requests=20, duration=60.0,
            latency=LatencySummary(mean=0.5 + 4 / one.machine.cpus), spent=one.machine.price / 60,
        )
        for one in body.samples[:only]
    ]  # fmt: skip
    results = with_checksum(plan.metadata, ResultsBody(
        application=fingerprints.measured_digest(load([str(shell.folder / "specs/demo.yaml")])[0].application),
        plan=digest.of_bytes((shell.folder / "compiled/demo/plan.yaml").read_bytes()), pins=body.pins or None,
        field_digests=body.application.field_digests, runner="local",
        measured=measured_values(load([str(shell.folder / "specs/demo.yaml")])[0].application),
        spent=round(sum(one.spent for one in records), 6), samples=records,
    ))  # fmt: skip
    write_yaml(shell.folder / "results/demo.yaml", results.model_dump(mode="json", exclude_none=True), "a test")
