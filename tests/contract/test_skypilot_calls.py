"""The SkyPilots of the supported range have the calls that fogspec makes, and nothing can reach a machine that is not ours."""

import base64
import importlib.util
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from fogspec.base.clouds import CLOUDS, DISK_GIB, NO_END

PYTHONS = [sys.executable, *filter(None, os.environ.get("FOGSPEC_SKYPILOT_PYTHONS", "").split(os.pathsep))]


# Nothing here may start an API server or look at the user's machines.
ALONE = {"SKYPILOT_DISABLE_LOCAL_API_SERVER": "1", "SKYPILOT_DISABLE_USAGE_COLLECTION": "1"}
# Importing SkyPilot takes seconds: each script has a process that comes of one which has it, and SkyPilot as it was imported.
FORKING = """
import json, os, sys, traceback
from fogspec.backends.skypilot import api
for line in sys.stdin:
    script, out, environment = json.loads(line)
    if (child := os.fork()) == 0:
        code = 1
        try:
            os.dup2(os.open(out, os.O_WRONLY | os.O_CREAT), 1)
            os.dup2(1, 2)
            os.environ |= environment
            exec(compile(script, "script", "exec"), {"__name__": "__main__"})
            code = 0
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            os._exit(code)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""


@pytest.fixture(scope="module")
def forking(tmp_path_factory: pytest.TempPathFactory) -> Iterator["subprocess.Popen[str]"]:
    if not importlib.util.find_spec("sky"):
        pytest.skip("needs SkyPilot: pip install 'fogspec[sky]'")
    environment = os.environ | ALONE | {"HOME": str(tmp_path_factory.mktemp("home"))}
    with tempfile.TemporaryFile("w+") as log:
        process = subprocess.Popen([sys.executable, "-c", FORKING], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log,
                                   text=True, env=environment)  # fmt: skip
        with process:
            yield process


@pytest.fixture
def skypilot(forking: "subprocess.Popen[str]", tmp_path: Path) -> Callable[..., str]:
    """Runs a script to its end and returns what it printed."""

    def run(script: str, **environment: str) -> str:
        assert forking.stdin is not None
        assert forking.stdout is not None
        out = tmp_path / "said"
        # SkyPilot asks the aws command what kind of credentials there are: that of this environment, for who has no other.
        path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath)])
        given = {"HOME": str(tmp_path), "PATH": path, **environment}
        forking.stdin.write(json.dumps([script, str(out), given]) + "\n")
        forking.stdin.flush()
        code = forking.stdout.readline()
        assert code == "0\n", out.read_text()[-2000:] if out.exists() else "SkyPilot was not imported"
        return out.read_text()

    return run


def refusing(said: dict[str, dict[str, list[str]]], feature: str) -> set[str]:
    return {name for name, refused in said["refused"].items() if feature in refused}


@pytest.mark.parametrize("python", PYTHONS)
def test_the_calls_and_exceptions_are_there(python: str, tmp_path: Path) -> None:
    if python == sys.executable and not importlib.util.find_spec("sky"):
        pytest.skip("needs SkyPilot: pip install 'fogspec[sky]'")
    script, environment = (
        str(Path(__file__).with_name("sky_has_calls.py")),
        os.environ | ALONE | {"HOME": str(tmp_path)},
    )
    ended = subprocess.run([python, script], capture_output=True, text=True, timeout=1200, env=environment)
    assert ended.returncode == 0, ended.stderr[-2000:]
    said = json.loads(ended.stdout.splitlines()[-1])
    assert said["missing"] == []
    assert set(said["clouds"]) <= {*CLOUDS}
    assert said["disks"] == ["gp3", 3500, 218, "pd-balanced", "Premium_LRS"]
    assert {*said["plain"]} == {"c4", "c4d", "c4a", "n4d", "n4a", "h4d", "m4", "x4"}, "it can start these now"
    assert all(re.match(CLOUDS["gcp"].unstartable or "", f"{one}-") for one in said["plain"])
    rows = {name: CLOUDS[name] for name in said["refused"]}
    assert {name for name, row in rows.items() if row.unstartable == NO_END} == refusing(said, "AUTODOWN")
    assert {name for name, row in rows.items() if not row.containers} == refusing(said, "DOCKER_IMAGE")
    assert {name for name, row in rows.items() if not row.opens_ports} == refusing(said, "OPEN_PORTS")
    assert said["least_gib"] + 64 <= DISK_GIB < said["default_gib"] == 256


SCRIPT = """
from fogspec.backends.skypilot import api
for op, words in [("end", {"name": "production"}), ("launch", {"task": {"run": "true"}, "name": "x", "root": "/"}),
                  ("jobs", {"name": "x"}), ("autostop", {"name": "x", "idle_minutes": 1}), ("find", {"name": "fogspe"}),
                  ("clusters", {"prefix": ""}), ("log", {"name": "x", "job": 1, "root": "/", "path": "/dev/null", "limit": 1})]:
    try:
        api.OPERATIONS[op](**words)
    except ValueError as refused:
        assert "not ours" in str(refused), (op, refused)
    else:
        raise AssertionError(op)
"""


def test_what_is_not_ours_is_refused_before_skypilot_is_asked(skypilot: Callable[..., str]) -> None:
    skypilot(SCRIPT)


PULLED = """
from sky.provision.docker_utils import DockerLoginConfig
pulled = DockerLoginConfig("me", "you", "x.example").format_image
assert [pulled(one) for one in ("nodes:1", "x.example/nodes:1")] == ["x.example/nodes:1"] * 2
assert pulled("y.example/nodes:1") == "x.example/y.example/nodes:1"
"""


def test_an_image_is_pulled_from_the_server_of_the_login(skypilot: Callable[..., str]) -> None:
    skypilot(PULLED)


HANDED = """
import os, sky
from pathlib import Path
from fogspec.backends.skypilot import api, secrets_file
from fogspec.backends.skypilot.errors import CloudProblem

def launched(task, cluster_name):
    given = task._to_yaml_config(redact_secrets=False)
    assert "hunter2" not in str(given), given
    assert given["secrets"] == {"SKYPILOT_DOCKER_USERNAME": "me", "SKYPILOT_DOCKER_PASSWORD": "you",
                                "SKYPILOT_DOCKER_SERVER": "x.example"}, given
    path = Path(given["file_mounts"][secrets_file.THERE])
    assert (path.stat().st_mode & 0o777, path.read_text()) == (0o600, "export API_KEY='hunter2 '\\"'\\"'$x'\\n")
    return "a request"

sky.launch = launched
docker = ["SKYPILOT_DOCKER_USERNAME", "SKYPILOT_DOCKER_PASSWORD", "SKYPILOT_DOCKER_SERVER"]
os.environ |= {"API_KEY": "hunter2 '$x", **dict(zip(docker, ["me", "you", "x.example"]))}
task = {"run": "true", "secrets": dict.fromkeys(["API_KEY", *docker])}
assert api.launch(task, "fogspec-a", "/") == {"request": "a request"}
assert secrets_file.place("fogspec-a").exists(), "a local API server reads it later"
api.sky.api_status = lambda *_, **__: []
api._job_of = lambda name: 1
api.launched("a request", "fogspec-a")
assert not secrets_file.place("fogspec-a").exists()
def refused(task, cluster_name):
    raise ValueError("no such thing")
sky.launch = refused
try:
    api.launch(task, "fogspec-a", "/")
except ValueError:
    assert not secrets_file.place("fogspec-a").exists()
try:
    api.launch({"run": "true", "secrets": {"NOT_THERE": None}}, "fogspec-a", "/")
except CloudProblem as problem:
    assert "NOT_THERE" in problem.detail
"""


def test_secrets_are_in_no_task_that_skypilot_gets_but_in_a_file_of_their_own(
    tmp_path: Path, skypilot: Callable[..., str]
) -> None:
    skypilot(HANDED, XDG_RUNTIME_DIR=str(tmp_path))


ENDED = """
from types import SimpleNamespace
from fogspec.backends.skypilot import api

log, machines = [], []
def launch(status):
    return SimpleNamespace(request_id="r", cluster_name="fogspec-a", name="sky.launch", created_at=1, status=status)
def asked(ids=None, all_status=True, **_):
    return [one for one in launches if all_status or one.status in api.UNFINISHED]
def down(name):
    log.append("down")
    if not machines:
        raise api.exceptions.ClusterDoesNotExist("it is not there")
    machines.clear()
def cancel(ids, silent):
    log.append("cancel")
    launches[:] = [launch("CANCELLED")]
def arrives(seconds):
    log.append(f"{seconds:g} s")
    launches.append(launch("PENDING"))
api.sky.api_status, api.sky.down, api.sky.api_cancel, api.sky.get = asked, down, cancel, lambda value: value
api.clusters, api.await_gone = lambda **_: machines, lambda name, until_s: 0
api.time = SimpleNamespace(sleep=arrives, time=lambda: 0.0)

launches = []
api.end("fogspec-a")
assert log == ["down", "5 s", "cancel", "down"], ("a launch that arrives late is broken off", log)
log.clear()
api.end("fogspec-a")
assert log == ["down"], ("its launch is known: no other comes", log)
log.clear()
launches, machines = [], ["fogspec-a"]
api.end("fogspec-a")
assert log == ["down"], ("the machine was there", log)
"""


def test_what_skypilot_knows_nothing_of_is_looked_for_once_more(skypilot: Callable[..., str]) -> None:
    skypilot(ENDED)


POWER_OFF = """
import json, re, yaml
from importlib import resources
from jinja2 import Template
from sky import skypilot_config
from sky.server.requests import payloads
from sky.utils.annotations import client_api
from fogspec.backends.skypilot.internals import launch_settings

def user_data(task):
    \"\"\"What SkyPilot's API server writes into the user data of a machine on AWS, from what its client sends.\"\"\"
    with launch_settings(task):
        sent = client_api(lambda: json.loads(json.dumps(payloads.get_override_skypilot_config_from_client())))()
    with skypilot_config.override_skypilot_config(sent):
        runcmd = skypilot_config.get_effective_region_config(
            cloud="aws", region="us-east-1", keys=("post_provision_runcmd",), default_value=None)
    template = resources.files("sky").joinpath("templates/aws-ray.yml.j2").read_text()
    part = re.search(r"UserData: [|]\\n(.*?)TagSpecifications", template, re.DOTALL)[1]
    return yaml.safe_load(Template(part).render(runcmd=runcmd))

def task(infra, **autostop):
    return {"resources": {"infra": infra, "autostop": {"idle_minutes": 15, "down": True, **autostop}}}

skypilot_config.reload_config()  # of this process's home
before = skypilot_config.to_dict()
sample = user_data(task("aws/us-east-1", wait_for="none"))
print(json.dumps({
    "sample": sample.get("runcmd"), "first_boot": sorted(sample),
    "deployment": user_data(task("aws/us-east-1")).get("runcmd"),
    "gcp": user_data(task("gcp/us-central1", wait_for="none")).get("runcmd"),
    "left": skypilot_config.to_dict() == before,
}))
"""


@pytest.mark.parametrize("theirs", [None, "modprobe fuse"])
def test_the_first_boot_on_aws_arms_a_timer_that_turns_the_machine_off(
    tmp_path: Path, theirs: str | None, skypilot: Callable[..., str]
) -> None:
    """Fifteen minutes of lifetime, after five until SkyPilot's own end is armed: in the user data that the cloud gets."""
    if theirs is not None:
        (tmp_path / ".sky").mkdir()
        (tmp_path / ".sky" / "config.yaml").write_text(f"aws: {{post_provision_runcmd: [{theirs}]}}\n")
    said, kept = json.loads(skypilot(POWER_OFF).splitlines()[-1]), [theirs] if theirs else []
    for kind, seconds in (("sample", "1200"), ("deployment", "")):
        ours, *others = said[kind]
        assert others == kept, "the user's own commands stay"
        assert f"\nseconds={seconds}\n" in base64.b64decode(ours.removeprefix("echo ").partition(" ")[0]).decode()
    assert said["gcp"] == (kept or None)
    assert "runcmd" in said["first_boot"]
    assert said["left"]


CREDENTIALS = """
import json, os
from sky import check, skypilot_config
from sky.server.requests import payloads
from sky.utils import registry
from sky.utils.annotations import client_api
from fogspec.backends.skypilot.internals import launch_settings

home = os.path.expanduser("~")
for cloud in registry.CLOUD_REGISTRY.values():
    for local in cloud.get_credential_file_mounts().values():
        os.makedirs(os.path.dirname(os.path.expanduser(local)), exist_ok=True)
        open(os.path.expanduser(local), "a").close()
for name in (".aws/credentials", ".oci/config", ".config/gcloud/application_default_credentials.json"):
    os.makedirs(os.path.dirname(f"{home}/{name}"), exist_ok=True)
    open(f"{home}/{name}", "a").close()
skypilot_config.reload_config()

def copied(infra):
    # It asks for each cloud's setting so: backends/backend_utils.py, write_cluster_config.
    with launch_settings({"resources": {"infra": infra}}):
        sent = client_api(lambda: json.loads(json.dumps(payloads.get_override_skypilot_config_from_client())))()
    with skypilot_config.override_skypilot_config(sent):
        kept = [cloud for name, cloud in registry.CLOUD_REGISTRY.items() if "NO_UPLOAD" ==
                skypilot_config.get_effective_workspace_region_config(
                    cloud=name.lower(), region="r1", keys=("remote_identity",), default_value=None)]
        return sorted(check.get_cloud_credential_file_mounts(kept))

all_of_them = sorted(check.get_cloud_credential_file_mounts([]))
print(json.dumps({"all": all_of_them, **{one: copied(one) for one in
                  ("aws", "gcp/us-central1", "vast", "kubernetes/lab", "lambda")}}))
"""


@pytest.mark.parametrize(
    "theirs", ["", "aws: {remote_identity: LOCAL_CREDENTIALS}\n", "aws: {remote_identity: [{x: role}]}\n"]
)
def test_a_machine_gets_the_credentials_of_its_own_cloud_alone(
    tmp_path: Path, theirs: str, skypilot: Callable[..., str]
) -> None:
    """As far as SkyPilot's settings go: those of a few others are a file each, which a page names."""
    (tmp_path / ".sky").mkdir()
    (tmp_path / ".sky" / "config.yaml").write_text(theirs)
    said = json.loads(skypilot(CREDENTIALS).splitlines()[-1])
    mine = {"aws": "~/.aws/", "gcp/us-central1": "~/.config/gcloud/", "vast": "~/.config/vastai/", "kubernetes/lab": "~/.kube/",
            "azure": "~/.azure/"}  # fmt: skip
    for infra in ("aws", "gcp/us-central1", "vast", "kubernetes/lab", "lambda"):
        found = {name for name, folder in mine.items() if any(path.startswith(folder) for path in said[infra])}
        assert found == {infra} & mine.keys(), infra
    assert any(path.startswith("~/.lambda_cloud") for path in said["lambda"])
    assert {one for one in mine if any(path.startswith(mine[one]) for path in said["all"])} >= {
        "aws",
        "azure",
        "kubernetes/lab",
    }
