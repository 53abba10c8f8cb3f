"""The pods that SkyPilot would send to Kubernetes for compiled tasks: rendered by SkyPilot itself, sent to nobody."""

import importlib.util
import json
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from fogspec.language.loader import read_document
from fogspec.plan.schema import Plan
from tests.support.forking import forked

DIGEST = f"sha256:{'a' * 64}"
SPEC = f"""apiVersion: fogspec.dev/v1alpha1
kind: Application
metadata: {{name: pods}}
spec:
  cloud: [{{cmd: [python3, work.py]}}]
  probe: {{callback: work}}
  ros: {{image: "docker.io/library/ros@{DIGEST}"}}
  constraints: {{latency: 1s, cost: $1/request}}
  hardware: {{gpus: [none, T4]}}
  infra: [kubernetes/lab]
  benchmark: {{sampler: grid, budget: $50}}
"""
PRICES = """Cloud,InstanceType,vCPUs,MemoryGiB,Price,Region,AcceleratorName,AcceleratorCount
kubernetes,2CPU--4GB,2,4,0.085,lab,,
kubernetes,16CPU--32GB,16,32,0.68,lab,,
kubernetes,4CPU--16GB--T4:1,4,16,0.5,lab,T4,1
"""

Rendered = dict[str, dict[str, Any]]


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Plan]:
    """A compiled project for a context named lab."""
    project = tmp_path_factory.mktemp("pods")
    for name, text in (("specs/pods.yaml", SPEC), ("specs/work.py", ""), ("prices.csv", PRICES)):
        (project / name).parent.mkdir(exist_ok=True)
        (project / name).write_text(text)
    ended = forked(project, ["compile", "pods", "--catalog", "prices.csv"])
    assert ended.returncode == 0, ended.stderr
    return project, read_document(project / "compiled" / "pods" / "plan.yaml", Plan)


@pytest.fixture(scope="module")
def rendered(plan: tuple[Path, Plan]) -> Rendered:
    """What SkyPilot would send, by sample."""
    if not importlib.util.find_spec("sky"):
        pytest.skip("needs SkyPilot: pip install 'fogspec[sky]'")
    project, _ = plan
    home = project / "home"
    home.mkdir()
    tasks = sorted(str(path.relative_to(project)) for path in project.glob("compiled/pods/tasks/*.sky.yaml"))
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("SKY", "KUBE"))}
    environment |= {
        "HOME": str(home),
        "SKYPILOT_DISABLE_LOCAL_API_SERVER": "1",
        "SKYPILOT_DISABLE_USAGE_COLLECTION": "1",
    }
    ended = subprocess.run([sys.executable, str(Path(__file__).with_name("sky_renders_pods.py")), *tasks], cwd=project,
                           env=environment, capture_output=True, text=True, timeout=1200)  # fmt: skip
    assert ended.returncode == 0, ended.stderr[-3000:]
    lines = [json.loads(line) for line in ended.stdout.splitlines() if line.startswith("{")]
    assert len(lines) == len(tasks) == 3
    return {Path(line["path"]).name.removesuffix(".sky.yaml"): line for line in lines}


@pytest.mark.slow
def test_a_pod_is_the_shape_that_was_planned_and_no_more(plan: tuple[Path, Plan], rendered: Rendered) -> None:
    _, planned = plan
    assert {one.id for one in planned.spec.samples} == set(rendered)
    for sample in planned.spec.samples:
        (container,) = rendered[sample.id]["pod"]["spec"]["containers"]
        requested, limited = container["resources"]["requests"], container["resources"]["limits"]
        assert (requested["cpu"], requested["memory"]) == (sample.machine.cpus, f"{sample.machine.memory}G")
        assert limited == requested, "otherwise it would be measured with what its node has to spare"
        gpu = {"nvidia.com/gpu": 1} if sample.machine.gpu else {}
        assert {key: value for key, value in requested.items() if key not in ("cpu", "memory")} == gpu


@pytest.mark.slow
def test_a_pod_has_the_image_by_digest_its_labels_and_its_end(plan: tuple[Path, Plan], rendered: Rendered) -> None:
    _, planned = plan
    for sample in planned.spec.samples:
        pod = rendered[sample.id]["pod"]
        (container,) = pod["spec"]["containers"]
        assert container["image"] == f"docker.io/library/ros@{DIGEST}"
        assert pod["metadata"]["labels"].items() >= {
            "fogspec-application": "pods", "fogspec-sample": sample.id,
        }.items()  # fmt: skip
        assert pod["spec"]["activeDeadlineSeconds"] == math.ceil(planned.spec.commitment.machine_s)
        assert pod["spec"]["restartPolicy"] == "Never"
        assert not pod["spec"].get("hostNetwork")
        assert not container.get("securityContext", {}).get("privileged")
        selected = json.dumps(pod["spec"].get("affinity", {}).get("nodeAffinity", {}))
        assert ("Tesla-T4" in selected) == (sample.machine.gpu is not None)
        env = {one["name"]: one.get("value") for one in container["env"]}
        assert (env.get("NVIDIA_VISIBLE_DEVICES") == "none") == (sample.machine.gpu is None)


@pytest.mark.slow
def test_it_goes_to_the_context_of_the_place_and_nothing_was_changed_there(rendered: Rendered) -> None:
    for one in rendered.values():
        assert (one["provider"]["context"], one["provider"]["namespace"]) == ("lab", "robots")
        assert one["changed"] == []
        assert one["infras"] == ["kubernetes/lab"], "the names by which a context that is missing is noticed"
