"""The installed SkyPilot reads every task that the golden cases compile, offline, and finds in it what was planned."""

import importlib.metadata
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from fogspec.base.clouds import cloud_of
from fogspec.catalog.sources import load_catalog
from fogspec.language.loader import read_document
from fogspec.plan.schema import Plan
from tests.support.forking import forked

ROOT = Path(__file__).resolve().parents[2]
SPECS = ("grasp-planning-recorded", "vslam-recorded", "motion-planning-recorded")
HEAD = ("InstanceType", "AcceleratorName", "AcceleratorCount", "vCPUs", "MemoryGiB", "GpuInfo", "Price", "SpotPrice",
        "Region", "AvailabilityZone", "Arch")  # fmt: skip
GCP = """InstanceType,vCPUs,MemoryGiB,AcceleratorName,AcceleratorCount,GpuInfo,Region,AvailabilityZone,Price,SpotPrice
n1-standard-4,4.0,15.0,,,,us-central1,us-central1-a,0.19,0.04
n1-standard-8,8.0,30.0,,,,us-central1,us-central1-a,0.38,0.08
n2-standard-4,4.0,16.0,,,,us-central1,us-central1-a,0.194236,0.04
,,,T4,1.0,{'Gpus': [{'MemoryInfo': {'SizeInMiB': 16384}}]},us-central1,us-central1-a,0.35,0.14
"""
AZURE = """InstanceType,AcceleratorName,AcceleratorCount,vCPUs,MemoryGiB,GpuInfo,Price,SpotPrice,Region,Generation
Standard_D2s_v5,,,2,8,,0.096,0.02,eastus,V1
Standard_NC4as_T4_v3,T4,1,4,28,"{'Gpus': [{'MemoryInfo': {'SizeInMiB': 16384}}]}",0.526,0.2,eastus,V1
"""
EVERYWHERE = """apiVersion: fogspec.dev/v1alpha1
kind: Application
metadata: {name: everywhere}
spec:
  cloud: [{package: p, executable: e, parameters: {text: "a 'b' $(c) `d` \\\\ é"}}]
  ros: {image: ros:jazzy, workspace: "my ws", setup: ["echo 'x: [y]' # z"]}
  probe: {request: /a, response: /b}
  hardware: {gpus: [none, T4], spot: true}
  infra: [gcp/us-central1, azure/eastus, slurm/lab, kubernetes]
  benchmark: {sampler: grid, budget: $50}
  secrets: [API_KEY]
"""
# Partitions are in tests/slurm: SkyPilot asks the cluster for them while it reads a task.
SLURM = "InstanceType,vCPUs,MemoryGiB,Price,Region\n2CPU--4GB,2,4,0.085,lab\n16CPU--32GB,16,32,0.68,lab\n"
KUBERNETES = "InstanceType,vCPUs,MemoryGiB,Price,Region\n2CPU--4GB,2,4,0.085,\n16CPU--32GB,16,32,0.68,\n"


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with compiled golden specs, and one for the other clouds; SkyPilot's home is beside it."""
    base = tmp_path_factory.mktemp("sky")
    project, tables = base / "project", base / "home" / ".sky" / "catalogs" / "v8"
    for folder in ("specs", "results"):
        shutil.copytree(ROOT / folder, project / folder)
    own = project / "specs" / "everywhere"
    (own / "my ws" / "src" / "p").mkdir(parents=True)
    (own / "everywhere.yaml").write_text(EVERYWHERE)
    (own / "my ws" / "src" / "p" / "package.xml").write_text("<package><name>p</name></package>")
    for cloud, text in (("gcp", GCP), ("azure", AZURE), ("slurm", SLURM), ("kubernetes", KUBERNETES),
                        ("aws", snapshot())):  # fmt: skip
        (tables / cloud).mkdir(parents=True)
        (tables / cloud / "vms.csv").write_text(text)
    (tables / "aws" / "images.csv").write_text("Tag,Region,OS,OSVersion,ImageId,CreationDate,BaseImageId\n")
    (base / "home" / ".slurm").mkdir()
    (base / "home" / ".slurm" / "config").write_text("Host lab\n  HostName 127.0.0.1\n  User nobody\n")
    (tables / "common").mkdir()
    (tables / "common" / "accelerators.csv").write_text("AcceleratorName,Clouds\nT4,\"['AWS', 'GCP', 'Azure']\"\n")
    environment = {"HOME": str(base / "home"), "XDG_CACHE_HOME": str(base / "cache")}
    for spec, more in [(f"specs/{name}.yaml", []) for name in SPECS] + [
        ("specs/everywhere/everywhere.yaml", ["--catalog", "skypilot"])
    ]:  # fmt: skip
        ended = forked(project, ["compile", spec, *more], environment)
        assert ended.returncode == 0, ended.stderr
    return project


def snapshot() -> str:
    """The bundled catalog in SkyPilot's layout."""
    catalog = load_catalog(None, [])
    rows = [",".join(HEAD)]
    for row in range(len(catalog)):
        gpu = [catalog.gpu[row], f"{catalog.gpu_count[row]:g}"] if catalog.gpu[row] else ["", ""]
        rows.append(",".join([
            catalog.instance[row], *gpu, f"{catalog.vcpus[row]:g}", f"{catalog.memory_gib[row]:g}", "",
            repr(float(catalog.price_usd_per_hour[row])), "", catalog.region[row], "", catalog.arch[row],
        ]))  # fmt: skip
    return "\n".join(rows) + "\n"


# Python interpreters with other SkyPilots of the range that is supported, such as the oldest.
PYTHONS = [sys.executable, *filter(None, os.environ.get("FOGSPEC_SKYPILOT_PYTHONS", "").split(os.pathsep))]


@pytest.fixture(scope="module", params=PYTHONS)
def understood(request: pytest.FixtureRequest, project: Path) -> dict[str, dict]:
    """What SkyPilot understands, by path of the task."""
    if request.param == sys.executable and not importlib.util.find_spec("sky"):
        pytest.skip("needs SkyPilot: pip install 'fogspec[sky]'")
    tasks = sorted(str(path.relative_to(project)) for path in project.glob("compiled/**/*.sky.yaml"))
    environment = os.environ | {"HOME": str(project.parent / "home"), "SKYPILOT_DISABLE_LOCAL_API_SERVER": "1",
                                "SKYPILOT_DISABLE_USAGE_COLLECTION": "1"}  # fmt: skip
    environment.pop("SKY_RUNTIME_DIR", None)
    ended = subprocess.run([request.param, str(Path(__file__).with_name("sky_reads_tasks.py")), *tasks], cwd=project,
                           env=environment, capture_output=True, text=True, timeout=1200)  # fmt: skip
    assert ended.returncode == 0, ended.stderr[-3000:]
    lines = [json.loads(line) for line in ended.stdout.splitlines() if line.startswith("{")]
    assert len(lines) == len(tasks)
    return {line["path"]: line for line in lines}


def test_every_task_is_one_that_skypilot_takes(understood: dict[str, dict]) -> None:
    assert {path: one["wrong"] for path, one in understood.items() if one["wrong"]} == {}
    assert all(one["same_run"] for one in understood.values()), "both readers of YAML read the same script"


def test_skypilot_finds_the_machine_that_was_planned(project: Path, understood: dict[str, dict]) -> None:
    seen = set()
    for path in sorted(project.glob("compiled/*/plan.yaml")):
        plan = read_document(path, Plan)
        for sample in plan.spec.samples:
            machine = sample.machine
            if machine.infra == "local":
                assert sample.task is None
                continue
            one = understood[f"compiled/{plan.metadata.name}/tasks/{sample.id}.sky.yaml"]
            assert one["name"] == plan.metadata.name
            assert one["autostop"] == [one["autostop"][0], True, "none"]
            assert one["labels"]["fogspec-sample"] == sample.id
            seen.add(machine.infra.split("/")[0])
            assert one["infra"] == machine.infra
            shaped = machine.infra.startswith(("slurm", "kubernetes"))
            assert one["instance"] == (None if shaped else machine.instance)
            if shaped:
                assert one["shape"] == [f"{machine.cpus:g}", f"{machine.memory:g}"]
            assert one["spot"] == machine.spot
            assert one["disk"] == (cloud_of(machine.infra).disk_gib or 256)
            assert (one["accelerators"] or {}).keys() == ({machine.gpu.name} if machine.gpu else set())
            if not shaped:
                assert one["price"] == pytest.approx(machine.price, abs=1e-4), sample.id
    assert seen == {"aws", "gcp", "azure", "slurm", "kubernetes"}


def test_skypilot_takes_the_time_limit_of_each_engine_that_has_one(project: Path, understood: dict[str, dict]) -> None:
    plan = read_document(project / "compiled" / "everywhere" / "plan.yaml", Plan)
    most_s, seen = plan.spec.commitment.machine_s, set()
    for sample in plan.spec.samples:
        one = understood[f"compiled/everywhere/tasks/{sample.id}.sky.yaml"]
        assert one["allowed"]
        assert one["pod_problem"] is None
        cloud = sample.machine.infra.split("/")[0]
        if cloud == "slurm":
            assert one["directives"] == ["#SBATCH", f"--time={most_s / 60:g}"]
        elif cloud == "kubernetes":
            assert one["limits"] == {
                "kubernetes": {
                    "set_pod_resource_limits": True,
                    "pod_config": {"spec": {"activeDeadlineSeconds": most_s}},
                }
            }
        else:
            assert one["limits"] == {}
        seen.add(cloud)
    assert seen == {"gcp", "azure", "slurm", "kubernetes"}


def test_slurm_gets_no_image_and_the_plan_says_so(project: Path, understood: dict[str, dict]) -> None:
    slurm = [one for path, one in understood.items() if "slurm" in path]
    assert slurm
    assert all(one["image"] is None for one in slurm)
    assert any(one["image"] for path, one in understood.items() if "azure" in path)
    plan = read_document(project / "compiled/everywhere/plan.yaml", Plan)
    assert {"code": "left_out", "what": "image", "cloud": "slurm", "image": "ros:jazzy"} in plan.spec.notes


def test_no_job_gets_credentials_of_the_api_server(understood: dict[str, dict]) -> None:
    assert understood
    assert {one["server_access"] for one in understood.values()} == {False}


def test_labels_are_valid_in_every_cloud(understood: dict[str, dict]) -> None:
    for one in understood.values():
        for key, value in one["labels"].items():
            assert re.fullmatch(r"[a-z][a-z0-9-]{0,62}", key)
            assert re.fullmatch(r"[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?", value)


def test_the_installed_skypilot_is_in_the_range_that_is_supported() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    low, high = re.fullmatch(r"skypilot>=([\d.]+),<([\d.]+)", extras["sky"][0]).groups()
    here = tuple(map(int, importlib.metadata.version("skypilot").split(".")[:2]))
    assert tuple(map(int, low.split("."))) <= here < tuple(map(int, high.split(".")))
