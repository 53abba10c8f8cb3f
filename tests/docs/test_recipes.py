"""CONTRIBUTING's recipes name files that exist, and two of them, performed on a copy as they are written, do what they say."""

import csv
import math
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import ROOT

RECIPES = re.findall(
    r"^### (.*?)\n(.*?)(?=^##)", (ROOT / "CONTRIBUTING.md").read_text("utf-8"), re.MULTILINE | re.DOTALL
)
SPEC = """\
apiVersion: fogspec.dev/v1alpha1
kind: Application
metadata: {name: app}
spec:
  cloud: [{cmd: [python3, work.py]}]
  probe: {callback: work}
  constraints: {latency: 100s}
  hardware: {cpus: 1..64, memory: 1GiB..256GiB}
  infra: [INFRA]
  benchmark: {machines: [MACHINES], budget: $20}
"""


class Copy:
    """The package in another directory, to be changed there, and a project beside it."""

    def __init__(self, folder: Path) -> None:
        self.package, self.project = folder / "source", folder / "project"
        ignored = shutil.ignore_patterns("__pycache__")
        for name in ("fogspec", "schemas", "templates", "specs", "lab"):
            shutil.copytree(ROOT / name, self.package / name, ignore=ignored)
        (self.project / "specs").mkdir(parents=True)
        (self.project / "specs" / "work.py").touch()
        self.changed: set[str] = set()

    def change(self, name: str, pattern: str, by: str) -> None:
        """Replace the one place in a file that the pattern matches."""
        text, count = re.subn(pattern, by, (self.package / name).read_text("utf-8"), flags=re.MULTILINE)
        assert count == 1, f"{name}: {count} places match {pattern}"
        (self.package / name).write_text(text, "utf-8")
        self.changed.add(name)

    def run(self, *words: str, of: str = "fogspec") -> subprocess.CompletedProcess[str]:
        """`fogspec WORDS` of the copy, in the project, or those of its lab."""
        folders = [str(self.package), str(self.package / "lab")]
        program = f"import sys; sys.path[:0] = {folders!r}; from {of}.__main__ import main; main()"
        command = [sys.executable, "-P", "-c", program, *words]
        return subprocess.run(command, cwd=self.project, capture_output=True, text=True, timeout=1200)

    def done(self, *words: str, of: str = "fogspec") -> str:
        """What it prints; it must succeed."""
        ended = self.run(*words, of=of)
        assert ended.returncode == 0, ended.stdout + ended.stderr
        return ended.stdout

    def spec(self, infra: str, machines: list[str]) -> str:
        """Write the spec of the project, and return its path."""
        text = SPEC.replace("INFRA", infra).replace("MACHINES", ", ".join(machines))
        (self.project / "specs" / "app.yaml").write_text(text, "utf-8")
        return "specs/app.yaml"


def recipe(title: str) -> str:
    return dict(RECIPES)[title]


@pytest.mark.parametrize(("title", "text"), RECIPES, ids=[title for title, _ in RECIPES])
def test_a_recipe_has_five_lines_and_its_files_exist(title: str, text: str) -> None:
    assert len(re.findall(r"^\d\. ", text, re.MULTILINE)) == 5
    places = re.findall(r"`((?:fogspec|docs|tests)/[\w./-]+)`", text)
    there = [one for one in places if "NAME" not in one and "nnn" not in one]
    assert there
    assert [one for one in there if not (ROOT / one).exists()] == []


def test_a_latency_family_is_added_by_its_recipe(tmp_path: Path) -> None:
    shapes = {
        "c6i.large": 2,
        "c6i.xlarge": 4,
        "c6i.2xlarge": 8,
        "c6i.4xlarge": 16,
        "c6i.8xlarge": 32,
        "c6i.12xlarge": 48,
    }
    copy = Copy(tmp_path)
    spec = copy.spec("aws/us-east-1", list(shapes))
    with (copy.project / "sweep.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["instance_type", "latency_s"])
        rows.writerows([name, 20 - 2 * math.sqrt(vcpus)] for name, vcpus in shapes.items())
    copy.done("compile", spec)
    copy.done("replay", spec, "--from", "sweep.csv", "--yes", of="fogspec_lab")
    copy.done("compile", spec)
    models = copy.project / "compiled" / "app" / "models.yaml"
    assert "sqrt" not in models.read_text("utf-8")

    families = "fogspec/numerics/families.py"
    copy.change(families, r'^(CPU_FAMILIES = \("constant", )', r'\1"root", ')
    copy.change(families, r'^(        case "linear":\n)', r'        case "root":\n            return [np.sqrt(x)]\n\1')
    copy.change(families, r'^(    "linear": \("\{b\}\*\{x\}",\),\n)', r'    "root": ("{b}*sqrt({x})",),\n\1')
    copy.done("compile", spec)
    found = models.read_text("utf-8")
    assert "cpu_family: root" in found
    assert "a + b*sqrt(c)" in found
    assert all(f"`{name}`" in recipe("Add a latency family") for name in copy.changed)


def test_a_cloud_is_added_by_its_recipe(tmp_path: Path) -> None:
    copy = Copy(tmp_path)
    spec = copy.spec("rainy/north", ["r.small", "r.large"])
    prices = copy.project / "rainy.csv"
    prices.write_text(
        "InstanceType,vCPUs,MemoryGiB,Price,Region\nr.small,2,4,0.05,north\nr.large,16,32,0.40,north\n", "utf-8"
    )
    refused = copy.run("validate", spec)
    assert refused.returncode == 1
    assert "rainy" in refused.stderr + refused.stdout

    copy.change("fogspec/base/clouds.py", r'^(    Cloud\(name="ibm".*\n)', r'\1    Cloud(name="rainy"),\n')
    copy.done("validate", spec)
    copy.done("compile", spec, "--catalog", "rainy.csv")
    tasks = sorted((copy.project / "compiled" / "app" / "tasks").iterdir())
    assert len(tasks) == 2
    assert all("infra: rainy/north" in one.read_text("utf-8") for one in tasks)
    assert all(f"`{name}`" in recipe("Add a cloud") for name in copy.changed)
