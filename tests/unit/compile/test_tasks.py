"""Compiled tasks: what is in them, and that everything in them is quoted for its language."""

import hashlib
import json
import math
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from fogspec.base.layout import Layout
from fogspec.base.templates import render
from fogspec.base.yaml.writer import yaml_text
from fogspec.catalog.machine import Gpu, Machine
from fogspec.compile.tasks import (
    asks,
    command,
    deploy_comment,
    deploy_task,
    deploy_work,
    deployed_processes,
    image_use,
    launched_together,
    left_out,
    measured_processes,
    parameter,
    ros_environment,
    sample_comment,
    sample_task,
    sample_work,
)
from fogspec.language.lockfile import REGISTRY_LOGIN
from fogspec.language.schema import Application, Node
from fogspec.language.warned import sentence
from fogspec.plan.commitment import Commitment
from fogspec.plan.schema import Sample
from tests.support.agent import AGENT
from tests.support.jobs import GENERATED

COMMITMENT = Commitment(measuring_s=301, setup_s=300)
NASTY = """it's "$(touch owned)" `x` \\ $HOME ; & | é"""


def application(**spec) -> Application:
    base = {"cloud": [{"package": "p", "executable": "e"}], "probe": {"callback": "x"}, "infra": ["aws/us-east-1"]}
    return Application.model_validate(
        {"apiVersion": "fogspec.dev/v1alpha1", "kind": "Application", "metadata": {"name": "app"}, "spec": base | spec}
    )


def sample(**machine) -> Sample:
    shape = {"infra": "aws/us-east-1", "instance": "g4dn.xlarge", "cpus": 4.0, "memory": 16.0, "price": 0.526}
    return Sample(id="one", machine=Machine(**(shape | machine)), reason="because")


LAYOUT = Layout(Path(), Path("specs/app.yaml"), "app")


def task_of(app: Application, one: Sample) -> dict:
    return sample_task(app, one, COMMITMENT, sample_work(app, one, LAYOUT, {}))


def deployed(app: Application, one: Sample) -> dict:
    return deploy_task(app, one.machine, deploy_work(app, LAYOUT))


def test_every_task_ends_its_machine_by_itself():
    resources = task_of(application(), sample())["resources"]
    assert resources["autostop"] == {"idle_minutes": 16, "down": True, "wait_for": "none"}
    task = deployed(application(), sample())
    assert task["resources"]["autostop"]["down"] is True


@pytest.mark.parametrize(
    ("infra", "config"),
    [
        ("slurm/lab/cpu", {"slurm": {"sbatch_options": {"time": 21}}}),
        (
            "kubernetes",
            {"kubernetes": {"set_pod_resource_limits": True, "pod_config": {"spec": {"activeDeadlineSeconds": 1260}}}},
        ),
        ("ssh/pool", {"ssh": {"pod_config": {"spec": {"activeDeadlineSeconds": 1260}}}}),
        ("gcp/us-central1", None),
        ("local", None),
    ],
)
def test_an_engine_with_a_time_limit_of_its_own_is_given_it(infra, config):
    """Provisioning and lifetime, from the machine's start: 5 min and 16 min."""
    assert task_of(application(), sample(infra=infra)).get("config") == config
    task = deployed(application(), sample(infra=infra))
    limits = {"kubernetes": {"set_pod_resource_limits": True}} if infra == "kubernetes" else None
    assert task.get("config") == limits, "a deployment has no longest time"


def test_a_task_states_its_machine_and_the_most_that_it_may_cost():
    assert sample_comment(sample(), COMMITMENT) == (
        "g4dn.xlarge on aws/us-east-1: because. $0.526/h, and $0.028/h for disk and address, at most 23 min, "
        "at most $0.2122."
    )
    assert sample_comment(sample(price=0.0), COMMITMENT).endswith("No price, at most 23 min.")
    app = application(deployment={"until": "2h", "budget": "$1.5"})
    assert deploy_comment(app.spec, sample().machine, "the choice") == (
        "g4dn.xlarge on aws/us-east-1: the choice. $0.526/h, and $0.028/h for disk and address, until 2h, at most $1.50."
    )
    hostile = yaml_text({"name": "app"}, "fogspec compile", "a\nrun: curl evil\u2028")
    assert hostile.splitlines()[-1] == "name: app"
    assert "\nrun" not in hostile


def test_the_machine_is_pinned_with_its_accelerators_spot_and_image():
    app = application(ros={"image": "docker.io/library/ros:jazzy"})
    resources = task_of(app, sample(gpu=Gpu(name="T4", count=1), spot=True))["resources"]
    assert (resources["infra"], resources["instance_type"]) == ("aws/us-east-1", "g4dn.xlarge")
    assert (resources["accelerators"], resources["use_spot"]) == ("T4:1", True)
    assert resources["image_id"] == "docker:docker.io/library/ros:jazzy"


def test_a_local_shape_has_no_infra_but_its_size():
    resources = task_of(application(), sample(infra="local", instance="2cpu-1gib", cpus=2.0, memory=1.0, price=0.0))[
        "resources"
    ]
    assert (resources["cpus"], resources["memory"]) == ("2", "1")
    assert "infra" not in resources


def test_secrets_are_names_only():
    assert task_of(application(secrets=["HF_TOKEN"]), sample())["secrets"] == {"HF_TOKEN": None}


def test_files_are_sent_only_when_something_names_them():
    assert "workdir" not in task_of(application(), sample())
    assert task_of(application(cloud=[{"cmd": ["./x"]}]), sample())["workdir"] == "specs"


def test_ros_words_become_ros_arguments():
    node = Node(package="p", executable="e", name="n", namespace="/a", arguments=["--fast"], env={"B": "2", "A": "1"},
                parameters={"gain": 38.0, "n": 3, "deep": {"on": True}, "text": "7"}, parameter_files=["p.yaml"],
                remappings={"x": "/y", "/x": "/z", "a": "/b"})  # fmt: skip
    assert command(node) == [
        "env", "A=1", "B=2", "ros2", "run", "p", "e", "--fast", "--ros-args", "-r", "__node:=n", "-r", "__ns:=/a",
        "--params-file", "p.yaml", "-p", "deep.on:=true", "-p", "gain:=38.0", "-p", "n:=3", "-p", 'text:="7"', "-r", "x:=/y",
        "-r", "/x:=/z", "-r", "a:=/b",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("value", "text"), [(38.0, "38.0"), (38, "38"), (True, "true"), ("7", '"7"'), ([1.0, 2.0], "[1.0, 2.0]")]
)
def test_parameters_keep_their_type(value, text):
    assert parameter(value) == text


def test_topics_are_listened_to_by_a_process_of_their_own():
    app = application(probe={"request": "/in", "response": "/out"})
    first = measured_processes(app.spec)[0]
    assert first == [
        "python3",
        "-m",
        "fogspec_agent.topics",
        "--request",
        "/in",
        "--response",
        "/out",
        "--match",
        "stamp",
    ]


def rendered_sample(app: Application) -> str:
    return render("measure.sh.j2", **GENERATED, **ros_environment(app.spec), limits=["--after", "5"], lifetime_s=600.0,
                  processes=measured_processes(app.spec))  # fmt: skip


def test_hostile_words_reach_the_process_unchanged(tmp_path):
    app = application(cloud=[{"cmd": ["printf", "%s", NASTY]}])
    fake = tmp_path / "agent.pyz"
    fake.write_text("import json, sys\nprint(json.dumps(sys.argv))")
    run = subprocess.run(["bash", "-c", rendered_sample(app)], capture_output=True, text=True, cwd=tmp_path,
                         env={"PATH": "/usr/bin:/bin", "HOME": str(tmp_path), "FOGSPEC_AGENT": str(fake),
                              "FOGSPEC_OUT": str(tmp_path / "out")})  # fmt: skip
    words = json.loads(run.stdout)
    assert json.loads(words[words.index("--process") + 1]) == {
        "argv": ["printf", "%s", NASTY], "name": "printf %s",
    }  # fmt: skip
    assert not (tmp_path / "owned").exists()


def test_a_node_with_respawn_is_a_process_of_its_own():
    plain = application(
        cloud=[{"cmd": ["python3", "a.py"], "launch": {"respawn": True, "respawn_delay": "2s"}}, {"cmd": ["b"]}]
    )
    assert deployed_processes(plain) == [
        {"argv": ["python3", "a.py"], "name": "python3 a.py", "respawn": "always", "respawn_delay": 2.0},
        {"argv": ["b"], "name": "b"},
    ]  # fmt: skip
    nodes = [
        {"package": "p", "executable": "e", "launch": {"respawn": "on_failure"}},
        {"package": "p", "executable": "f", "name": "g"},
    ]
    ros = application(cloud=nodes, ros={"distro": "jazzy"})
    launch, node = deployed_processes(ros)
    assert "ros2 launch" in launch[-1]
    assert (node["name"], node["respawn"], node["argv"]) == ("e", "on_failure", ["ros2", "run", "p", "e"])
    assert [one.executable for one in launched_together(ros.spec)] == ["f"]
    alone = application(cloud=nodes[:1], ros={"distro": "jazzy"})
    assert [one["name"] for one in deployed_processes(alone)] == ["e"]


ASKED = ["python3", "-m", "fogspec_agent.declared", "--of", "planner", "gain"]
DEPLOYED = {"ready": ["true"], "listeners": [["sleep", "1"]], "asks": ASKED, "link": None, "ends": True}


def test_a_deployment_runs_its_words_unchanged_and_ends_when_one_node_ends(tmp_path):
    processes = [["sh", "-c", 'printf %s "$1" > said', "x", NASTY], ["sleep", "60"]]
    script = render("deploy.sh.j2", **GENERATED, **ros_environment(application().spec), processes=processes, **DEPLOYED)
    environment = {
        "PATH": "/usr/bin:/bin",
        "HOME": "/",
        "FOGSPEC_AGENT": str(AGENT),
        "FOGSPEC_OUT": str(tmp_path / "out"),
        "FOGSPEC_LIFETIME_S": "3600",
        "FOGSPEC_ENDS": "4000000000",
    }
    subprocess.run(["bash", "-c", script], cwd=tmp_path, timeout=600, env=environment)
    assert (tmp_path / "said").read_text() == NASTY


@pytest.mark.parametrize("template", ["measure.sh.j2", "deploy.sh.j2", "setup.sh.j2"])
def test_scripts_pass_shellcheck(tmp_path, template):
    app = application(ros={"workspace": "ros2_ws", "apt": ["x y"], "setup": ["echo hello"]}, cloud=[{"cmd": [NASTY]}])
    script = tmp_path / "script.sh"
    words = {"limits": ["--after", "5"], "lifetime_s": 9.0, "processes": measured_processes(app.spec)}
    script.write_text(render(template, **GENERATED, **ros_environment(app.spec), **DEPLOYED, **words))
    try:
        checked = subprocess.run(["shellcheck", "-s", "bash", "-S", "warning", "-e", "SC1091,SC2016", str(script)],
                                 capture_output=True, text=True)  # fmt: skip
    except FileNotFoundError:
        pytest.skip("needs shellcheck: apt-get install shellcheck")
    assert checked.returncode == 0, checked.stdout


FAKE_AGENT = """import json, os, sys
out = sys.argv[sys.argv.index("--out") + 1]
os.makedirs(out)
with open(out + "/outcome.json", "w") as file:
    file.write(json.dumps({"omp": os.environ.get("OMP_NUM_THREADS", "")}) + "\\n")
with open(out + "/timings.jsonl", "w") as file:
    file.write('{"latency_s": 1.5}\\n' * 2)
sys.exit(3)
"""


def test_without_a_runner_that_reads_folders_the_lines_are_in_the_log(tmp_path):
    fake = tmp_path / "agent.pyz"
    fake.write_text(FAKE_AGENT)
    environment = {"PATH": "/usr/bin:/bin", "HOME": str(tmp_path), "FOGSPEC_AGENT": str(fake)}
    for more, omp in (({}, "1"), ({"SKYPILOT_TASK_ID": "x"}, "")):
        run = subprocess.run(["bash", "-c", rendered_sample(application())], capture_output=True, text=True, cwd=tmp_path,
                             env=environment | {"OMP_NUM_THREADS": "1"} | more)  # fmt: skip
        assert run.returncode == 3, run.stderr
        assert run.stdout.splitlines() == [
            "=== fogspec measures ===",
            "=== fogspec begin outcome.json ===", json.dumps({"omp": omp}), "=== fogspec end outcome.json ===",
            "=== fogspec begin packages.txt ===", "=== fogspec end packages.txt ===",
            "=== fogspec begin timings.jsonl ===", *['{"latency_s": 1.5}'] * 2, "=== fogspec end timings.jsonl ===",
        ]  # fmt: skip


def pythons(folder: Path, *places: str) -> str:
    """Make a python3 in each place that says where it is and what it is given, and return them as a PATH."""
    for place in places:
        (folder / place).mkdir(parents=True, exist_ok=True)
        (folder / place / "python3").write_text(f"#!/bin/sh\necho {place} $OMP_NUM_THREADS $PYTHONPATH $VIRTUAL_ENV\n")
        (folder / place / "python3").chmod(0o755)
    return ":".join([*(f"{folder}/{one}" for one in places), "/usr/bin", "/bin"])


RUNNERS = ("skypilot-runtime/bin", "miniconda3/condabin", "miniconda3/bin", "mine/bin")  # SkyPilot's are first in PATH


def test_python_is_that_of_the_set_up_and_not_the_job_runners(tmp_path: Path) -> None:
    script = rendered_sample(application(ros={})).replace("/opt/ros/jazzy/setup.bash", "/dev/null")
    given = {
        "PATH": pythons(tmp_path, *RUNNERS),
        "HOME": str(tmp_path),
        "SKYPILOT_TASK_ID": "x",
        "OMP_NUM_THREADS": "1",
    }
    run = subprocess.run(["bash", "-c", script], capture_output=True, text=True, cwd=tmp_path, timeout=600, env=given)
    assert "mine/bin" in run.stdout.splitlines(), run.stderr


def test_the_graph_s_own_variables_reach_all_that_runs_in_it(tmp_path: Path) -> None:
    env = {"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp", "CYCLONEDDS_URI": f"<a>'{NASTY}</a>"}
    spec = application(ros={"distro": "humble", "env": env}).spec
    (tmp_path / "python3").write_text('#!/bin/sh\nprintf %s "$RMW_IMPLEMENTATION $CYCLONEDDS_URI"\n')
    (tmp_path / "python3").chmod(0o755)
    deploys = render("deploy.sh.j2", **GENERATED, **ros_environment(spec), processes=[], **DEPLOYED)
    given = {"PATH": f"{tmp_path}:/usr/bin:/bin", "HOME": str(tmp_path), "FOGSPEC_LIFETIME_S": "1", "FOGSPEC_ENDS": "1"}
    for script in (rendered_sample(application(ros={"distro": "humble", "env": env})), deploys):
        script = script.replace("/opt/ros/humble/setup.bash", "/dev/null")
        run = subprocess.run(["bash", "-c", script], capture_output=True, text=True, cwd=tmp_path, env=given)
        assert f"rmw_cyclonedds_cpp {env['CYCLONEDDS_URI']}" in run.stdout, run.stderr
    assert "needs ros-humble-rmw-cyclonedds-cpp" in render("setup.sh.j2", **GENERATED, **ros_environment(spec))


@pytest.mark.parametrize("own", ["miniconda3/bin", "mine/bin"])
def test_in_a_container_the_environment_is_the_images(tmp_path: Path, own: str) -> None:
    """It may have a Miniconda of its own. SkyPilot sets one thread, and what an image sets only its first process has."""
    apart = ["unshare", "--map-root-user", "--pid", "--fork", "--mount-proc"]
    if not shutil.which("unshare") or subprocess.run([*apart, "true"], capture_output=True).returncode:
        pytest.skip("needs namespaces of an ordinary user")
    script = rendered_sample(application(ros={"image": "docker.io/library/ros:jazzy"}))
    script = script.replace("/opt/ros/jazzy/setup.bash", "/dev/null")
    image = {"PATH": pythons(tmp_path, own), "OMP_NUM_THREADS": "4", "PYTHONPATH": "/image/lib", "VIRTUAL_ENV": "/image",
             "HOME": str(tmp_path)}  # fmt: skip
    job = [f"PATH={pythons(tmp_path, *RUNNERS)}", "SKYPILOT_TASK_ID=x", "OMP_NUM_THREADS=1", "PYTHONPATH=/skypilot"]
    first = 'env "$@" & wait $!'  # the first process, which the job's is not
    words = [*apart, "bash", "-c", first, "bash", "-u", "VIRTUAL_ENV", *job, "bash", "-c", script]
    run = subprocess.run(words, capture_output=True, text=True, cwd=tmp_path, timeout=600, env=image)
    assert f"{own} 4 /image/lib /image" in run.stdout.splitlines(), run.stdout + run.stderr


HOSTILE = """import os, sys
out = sys.argv[sys.argv.index("--out") + 1]
os.makedirs(out)
os.symlink("/etc/passwd", out + "/outcome.json")
with open(out + "/timings.jsonl", "wb") as file:
    file.write(b'{"latency_s": 1.5}\\ntorn')
    file.truncate(2**40 if "SPARSE" in os.environ else file.tell())
"""


@pytest.mark.slow
def test_what_nodes_put_in_place_of_results_is_not_followed_and_fills_no_disk(tmp_path):
    """A terabyte without a byte on disk, and a link to somebody else's file."""
    (tmp_path / "agent.pyz").write_text(HOSTILE)
    environment = {"PATH": "/usr/bin:/bin", "HOME": str(tmp_path), "FOGSPEC_AGENT": str(tmp_path / "agent.pyz")}
    script = rendered_sample(application())
    run = subprocess.run(["bash", "-c", script], capture_output=True, text=True, cwd=tmp_path, env=environment)
    assert run.stdout.splitlines()[1:] == [
        "=== fogspec begin outcome.json ===", "=== fogspec end outcome.json ===",
        "=== fogspec begin packages.txt ===", "=== fogspec end packages.txt ===",
        "=== fogspec begin timings.jsonl ===", '{"latency_s": 1.5}', "torn", "=== fogspec end timings.jsonl ===",
    ]  # fmt: skip
    log = tmp_path / "log"
    with open(log, "wb") as out:
        subprocess.run(["bash", "-c", script], stdout=out, cwd=tmp_path, env=environment | {"SPARSE": "1"}, timeout=600)
    *before, marker = log.read_bytes().splitlines()
    assert (max(map(len, before)), marker) == (2**16, b"=== fogspec end timings.jsonl ===")


def test_secrets_come_in_a_file_that_is_gone_before_a_node_starts(tmp_path):
    (tmp_path / "agent.pyz").write_text('import os\nprint(os.environ["API_KEY"], os.path.exists(".fogspec/secrets"))')
    (tmp_path / ".fogspec").mkdir()
    handed = tmp_path / ".fogspec" / "secrets"
    handed.write_text("export API_KEY='it'\"'\"'s; $(touch owned)'\n")
    environment = {"PATH": "/usr/bin:/bin", "HOME": str(tmp_path), "FOGSPEC_AGENT": str(tmp_path / "agent.pyz"),
                   "FOGSPEC_OUT": str(tmp_path / "out"), "SKYPILOT_TASK_ID": "x"}  # fmt: skip
    script = rendered_sample(application(secrets=["API_KEY"]))
    run = subprocess.run(["bash", "-c", script], capture_output=True, text=True, cwd=tmp_path, env=environment)
    assert run.stdout == "it's; $(touch owned) False\n", run.stderr
    assert not handed.exists()
    assert not (tmp_path / "owned").exists()
    assert "secrets" not in rendered_sample(application())


def test_the_login_to_the_registry_is_not_passed_to_the_nodes(tmp_path):
    said = 'print([name for name in os.environ if "DOCKER" in name], os.environ["API_KEY"])'
    (tmp_path / "agent.pyz").write_text(f"import os\n{said}")
    environment = {"PATH": "/usr/bin:/bin", "HOME": str(tmp_path), "FOGSPEC_AGENT": str(tmp_path / "agent.pyz")}
    environment |= {"FOGSPEC_OUT": str(tmp_path / "out"), "API_KEY": "kept", **dict.fromkeys(REGISTRY_LOGIN, "login")}
    app = application(secrets=["API_KEY", *REGISTRY_LOGIN], ros={"image": "registry.example.org/team/nodes:1"})
    task = task_of(app, sample())
    assert task["secrets"] == dict.fromkeys(["API_KEY", *REGISTRY_LOGIN])
    script = rendered_sample(app).replace("/opt/ros/jazzy", str(tmp_path))
    (tmp_path / "setup.bash").touch()
    for job in ({}, {"SKYPILOT_TASK_ID": "x"}):
        run = subprocess.run(
            ["bash", "-c", script], capture_output=True, text=True, cwd=tmp_path, env=environment | job
        )
        assert run.stdout == "[] kept\n", run.stderr


@pytest.mark.parametrize(
    ("infra", "logs_in"),
    [
        (["aws/us-east-1"], True),
        (["kubernetes", "aws"], True),
        (["kubernetes"], False),
        (["slurm/lab"], False),
        (["local"], False),
    ],
)
def test_only_machines_of_clouds_log_in_to_a_registry(infra, logs_in):
    spec = application(infra=infra, secrets=["API_KEY", *REGISTRY_LOGIN], ros={"image": "x.example/nodes:1"}).spec
    assert image_use(spec, measures=True).secrets == (list(REGISTRY_LOGIN) if logs_in else [])


@pytest.mark.parametrize(
    ("infra", "waits", "logs_in"), [("runpod", True, True), ("aws", True, False), ("slurm/lab", False, False)]
)
def test_machines_need_an_image_that_starts_in_time_and_for_their_user(infra, waits, logs_in):
    name = "SKYPILOT_RUNPOD_DOCKER_USERNAME"
    spec = application(infra=[infra], secrets=["API_KEY", name], ros={"image": "x.example/nodes:1"}).spec
    measured, served = image_use(spec, measures=True), image_use(spec, measures=False)
    limits = [spec.benchmark.ready_timeout, spec.deployment.ready_timeout] if waits else [math.inf, math.inf]
    assert [measured.timeout_s, served.timeout_s] == limits
    assert (measured.timeout, served.timeout) == ("spec.benchmark.ready_timeout", "spec.deployment.ready_timeout")
    assert (measured.user_variable, measured.secrets) == ((name, [name]) if logs_in else (None, []))


def test_where_an_image_or_its_login_is_not_used_is_said():
    image = "registry.example.org/team/nodes:1"
    app = application(secrets=["API_KEY", *REGISTRY_LOGIN], ros={"image": image})
    (said,) = left_out(app.spec, sample(infra="kubernetes/lab", instance="4CPU--16GB").machine)
    assert sentence(said).startswith("SKYPILOT_DOCKER_USERNAME, ")
    assert "imagePullSecrets" in sentence(said)
    here = sample(infra="local", instance="4cpu-16gib")
    [said] = left_out(app.spec, here.machine)
    assert sentence(said) == f"image {image} is left out on this host: its own ROS 2 is used"
    assert "image_id" not in task_of(app, here)["resources"]
    assert left_out(app.spec, sample().machine) == []


def test_slurm_has_neither_images_nor_spot_and_it_is_said():
    app = application(ros={"image": "docker.io/library/ros:jazzy"})
    one = sample(infra="slurm/lab", instance="4CPU--16GB", spot=True)
    resources = task_of(app, one)["resources"]
    assert not {"image_id", "use_spot", "ports"} & resources.keys()
    assert [(found["what"], found["cloud"]) for found in left_out(app.spec, one.machine)] == [
        ("image", "slurm"), ("spot", "slurm")
    ]  # fmt: skip
    assert left_out(app.spec, sample().machine) == []


def test_places_without_a_list_of_types_are_asked_for_the_shape_whatever_its_name():
    app = application(ros={"image": "docker.io/library/ros:jazzy"})
    for infra, image in (("slurm/lab/fast", False), ("kubernetes/me@lab", True), ("ssh/rack", True)):
        resources = task_of(app, sample(infra=infra, instance="the big one"))["resources"]
        assert (resources["infra"], resources["cpus"], resources["memory"]) == (infra, "4", "16")
        assert "instance_type" not in resources
        assert ("image_id" in resources) == image


FAKES = {
    "apt-get": 'echo "apt-get $*" >> "$HOME/said"',
    "curl": 'while [ "$1" != -o ]; do shift; done; : > "$2"; echo "curl" >> "$HOME/said"',
    "rosdep": 'echo "rosdep $*" >> "$HOME/said"',
    "colcon": 'echo "colcon $* in $PWD" >> "$HOME/said"; mkdir -p install; echo "export BUILT=1" > install/setup.bash',
    "sudo": '[ "$1" = -E ] && shift; "$@"',
    "dpkg-query": "exit 1",
}


def test_setting_up_twice_installs_builds_and_logs_and_runs_its_own_lines_once(tmp_path):
    """The real script in a real bash; only the programs that would change this host are stand-ins."""
    home, tools, ros = tmp_path / "home", tmp_path / "bin", tmp_path / "ros"
    workspace = "my ws $(touch owned) '\""
    for folder in (home, tools, tmp_path / workspace / "src", ros / "jazzy"):
        folder.mkdir(parents=True)
    for name, body in FAKES.items():
        (tools / name).write_text(f"#!/bin/sh\n{body}\n")
        (tools / name).chmod(0o755)
    app = application(ros={"workspace": workspace, "apt": ["ros-jazzy-x", "a b"], "setup": ["echo mine >> ~/said"]})
    script = render("setup.sh.j2", **GENERATED, **ros_environment(app.spec))
    script = script.replace("/opt/ros", str(ros)).replace("export PATH=", f"export PATH={tools}:")
    (ros / "jazzy" / "setup.bash").write_text("export ROS_DISTRO=jazzy; : $UNBOUND")
    for _ in range(2):
        subprocess.run(["bash", "-c", script], cwd=tmp_path, check=True, capture_output=True, text=True, timeout=600,
                       env={"PATH": "/usr/bin:/bin", "HOME": str(home)})  # fmt: skip
    said = (home / "said").read_text()
    assert said.count("mine") == 1
    assert said.count(" update\n") == 2, "once each time"
    assert " install -y --no-install-recommends -- ros-jazzy-x a b\n" in said
    assert said.count("apt-get ") == said.count("apt-get -qq -o DPkg::Lock::Timeout=300 -o Acquire::Retries=5 ")
    assert said.count(f"in {tmp_path / workspace}") == 2
    assert "curl" not in said, "ROS 2 is there already"
    assert "ROS 2 jazzy is ready" in (home / ".fogspec" / "setup.log").read_text()
    assert not list(tmp_path.rglob("owned"))


@pytest.mark.parametrize(("state", "code"), [("installed", 0), ("config-files", 1)])
def test_nothing_is_asked_of_root_where_all_is_there_and_who_cannot_be_root_is_told(tmp_path, state, code):
    """A user of a Slurm cluster, whose nodes have what the spec names, or lack it."""
    tools, ros = tmp_path / "bin", tmp_path / "ros"
    (ros / "jazzy").mkdir(parents=True)
    (ros / "jazzy" / "setup.bash").write_text("")
    tools.mkdir()
    for name, body in (FAKES | {"id": "echo 1000", "sudo": "exit 1", "dpkg-query": f"printf {state}"}).items():
        (tools / name).write_text(f"#!/bin/sh\n{body}\n")
        (tools / name).chmod(0o755)
    script = render("setup.sh.j2", **GENERATED, **ros_environment(application(ros={"apt": ["ros-jazzy-x"]}).spec))
    script = script.replace("/opt/ros", str(ros)).replace("export PATH=", f"export PATH={tools}:")
    run = subprocess.run(["bash", "-c", script], cwd=tmp_path, capture_output=True, text=True, timeout=600,
                         env={"PATH": "/usr/bin:/bin", "HOME": str(tmp_path)})  # fmt: skip
    assert run.returncode == code
    assert not (tmp_path / "said").exists()
    named = "only root can install packages here, and this user is not: ros-jazzy-x"
    assert (named in (tmp_path / ".fogspec" / "setup.log").read_text()) == bool(code)


@pytest.mark.parametrize("there", [True, False])
def test_who_is_not_root_builds_the_workspace_with_what_is_there(tmp_path, there):
    """Neither rosdep nor apt is asked, for both want root; without colcon it ends with what is missing."""
    tools, ros = tmp_path / "bin", tmp_path / "ros"
    for folder in (tools, tmp_path / "ws" / "src", ros / "jazzy"):
        folder.mkdir(parents=True)
    (ros / "jazzy" / "setup.bash").write_text("")
    for name, body in (FAKES | {"id": "echo 1000", "sudo": "exit 1"}).items():
        if there or name != "colcon":
            (tools / name).write_text(f"#!/bin/sh\n{body}\n")
            (tools / name).chmod(0o755)
    script = render("setup.sh.j2", **GENERATED, **ros_environment(application(ros={"workspace": "ws"}).spec))
    script = script.replace("/opt/ros", str(ros)).replace("export PATH=", f"export PATH={tools}:")
    run = subprocess.run(["bash", "-c", script], cwd=tmp_path, capture_output=True, text=True, timeout=600,
                         env={"PATH": "/usr/bin:/bin", "HOME": str(tmp_path)})  # fmt: skip
    log = (tmp_path / ".fogspec" / "setup.log").read_text()
    if there:
        assert (run.returncode, (tmp_path / "said").read_text().count("colcon build")) == (0, 1)
        assert "rosdep installs nothing, for this user is not root" in log
        assert "rosdep" not in (tmp_path / "said").read_text()
    else:
        assert run.returncode == 1
        assert "this user is not: python3-colcon-common-extensions" in log


def test_what_machines_and_servers_do_now_and_then_does_not_end_a_set_up(tmp_path: Path) -> None:
    """A source that cannot be read, a server of rosdep's that fails twice, a sudo that keeps nothing, 16 CPUs with 8 GiB."""
    tools, ros = tmp_path / "bin", tmp_path / "ros"
    for folder in (tools, tmp_path / "ws" / "src", ros / "jazzy"):
        folder.mkdir(parents=True)
    (ros / "jazzy" / "setup.bash").write_text("")
    fakes = FAKES | {
        "id": "echo 1000",
        "sudo": f'[ "$1" = -n ] && exit; exec env -i PATH="{tools}:$PATH" HOME="$HOME" "$@"',
        "apt-get": 'echo "apt-get $DEBIAN_FRONTEND $https_proxy $*" >> "$HOME/said"; case $* in *update*) exit 100; esac',
        "rosdep": 'echo "rosdep $*" >> "$HOME/said"; [ "$(grep -c "rosdep update" "$HOME/said")" -gt 2 ] || [ "$1" != update ]',
        "colcon": f'echo "colcon $MAKEFLAGS $*" >> "$HOME/said"; {FAKES["colcon"]}',
        "sleep": "exit 0", "nproc": "echo 16",
    }  # fmt: skip
    for name, body in fakes.items():
        (tools / name).write_text(f"#!/bin/sh\n{body}\n")
        (tools / name).chmod(0o755)
    (tmp_path / "meminfo").write_text("MemTotal: 8388608 kB\nMemAvailable: 7864320 kB\n")
    (tmp_path / "limit").write_text("max\n")
    app = application(
        ros={"workspace": "ws", "apt": ["x"], "setup": ['echo "pip $PIP_BREAK_SYSTEM_PACKAGES" >> ~/said']}
    )
    script = render("setup.sh.j2", **GENERATED, **ros_environment(app.spec)).replace("/opt/ros", str(ros))
    script = script.replace("export PATH=", f"export PATH={tools}:").replace("/proc/meminfo", str(tmp_path / "meminfo"))
    script = script.replace("/sys/fs/cgroup/memory.max", str(tmp_path / "limit"))

    def compilers() -> str:
        subprocess.run(["bash", "-c", script], cwd=tmp_path, check=True, capture_output=True, timeout=600,
                       env={"PATH": "/usr/bin:/bin", "HOME": str(tmp_path), "https_proxy": "http://here:3128"})  # fmt: skip
        (asked,) = (line for line in (tmp_path / "said").read_text().splitlines() if line.startswith("colcon -j"))
        return asked

    assert compilers().startswith("colcon -j5 build --executor sequential ")
    said = (tmp_path / "said").read_text()
    assert said.count("rosdep update") == 3
    assert "apt-get noninteractive http://here:3128 -qq" in said
    assert "pip 1" in said
    log = (tmp_path / ".fogspec" / "setup.log").read_text()
    assert "apt-get update failed: continuing with the package lists that are here" in log
    assert "in 20 s once more: rosdep update --rosdistro jazzy" in log
    assert "once more: rosdep install" not in log
    (tools / "rosdep").write_text('#!/bin/sh\ncase $* in install*) echo "rosdep $*" >> "$HOME/said"; exit 1; esac\n')
    (tmp_path / "said").unlink()
    subprocess.run(["bash", "-c", script], cwd=tmp_path, capture_output=True, timeout=600,
                   env={"PATH": "/usr/bin:/bin", "HOME": str(tmp_path)})  # fmt: skip
    assert (tmp_path / "said").read_text().count("rosdep install") == 1, "a key that no list has is asked for once"
    (tools / "rosdep").write_text(f"#!/bin/sh\n{fakes['rosdep']}\n")
    (tmp_path / "limit").write_text(f"{4 * 2**30}\n")
    (tmp_path / "said").write_text("rosdep update\n" * 2)
    assert compilers().startswith("colcon -j2 "), "a pod has no more than its limit"


@pytest.mark.parametrize(
    ("codename", "intact", "renews"), [("noble", True, True), ("noble", False, False), ("jammy", True, False)]
)
def test_an_image_whose_key_of_ros_has_expired_gets_the_new_one(
    tmp_path: Path, codename: str, intact: bool, renews: bool
) -> None:
    """Its list of ROS 2 gives way to that of the package with the new key, if that is the package which was expected."""
    tools, ros, lists = tmp_path / "bin", tmp_path / "ros", tmp_path / "lists"
    for folder in (tools, ros / "jazzy", lists):
        folder.mkdir(parents=True)
    (ros / "jazzy" / "setup.bash").write_text("")
    old = "deb [ signed-by=/usr/share/keyrings/old.gpg ] http://packages.ros.org/ros2/ubuntu noble main\n"
    (lists / "ros2.list").write_text(old)
    (lists / "own.list").write_text("deb http://mirror.example/ubuntu noble main\n")
    (tmp_path / "os-release").write_text(f"VERSION_CODENAME={codename}\n")
    fakes = FAKES | {
        "id": "echo 0",
        "apt-get": f"""echo "apt-get $*" >> "$HOME/said"
case $* in *update*) ! grep -q ros2 {lists}/*.list ;; esac""",
    }
    for name, body in fakes.items():
        (tools / name).write_text(f"#!/bin/sh\n{body}\n")
        (tools / name).chmod(0o755)
    script = render("setup.sh.j2", **GENERATED, **ros_environment(application(ros={"apt": ["ros-jazzy-x"]}).spec))
    script = script.replace("/opt/ros", str(ros)).replace("export PATH=", f"export PATH={tools}:")
    script = script.replace("/etc/apt/sources.list.d", str(lists)).replace("/etc/os-release", f"{tmp_path}/os-release")
    if intact:
        script = re.sub("[0-9a-f]{64}(?= [$]package)", hashlib.sha256(b"").hexdigest(), script)
    run = subprocess.run(["bash", "-c", script], cwd=tmp_path, capture_output=True, text=True, timeout=600,
                         env={"PATH": "/usr/bin:/bin", "HOME": str(tmp_path)})  # fmt: skip
    assert run.returncode == 0, run.stdout
    assert ("continuing with the package lists that are here" in run.stdout) == (not renews)
    assert (lists / "ros2.list").read_text() == ("" if renews else old)
    assert (lists / "own.list").read_text().startswith("deb ")
    said = (tmp_path / "said").read_text()
    assert said.count(" update\n") == 1 + renews
    assert ("ros2-apt-source" in said or ".deb" in said) == renews
    assert said.rstrip().endswith("-- ros-jazzy-x")


@pytest.mark.parametrize(
    ("codename", "code", "said"), [("noble", 7, ""), ("bookworm", 1, "and this is Toy OS: name an image")]
)
def test_a_set_up_that_fails_says_so_and_stops(tmp_path, codename, code, said):
    for name, body in FAKES.items():
        (tmp_path / name).write_text(f"#!/bin/sh\n{'exit 7' if name == 'apt-get' else body}\n")
        (tmp_path / name).chmod(0o755)
    (tmp_path / "os-release").write_text(f"VERSION_CODENAME={codename}\nPRETTY_NAME='Toy OS'\n")
    script = render("setup.sh.j2", **GENERATED, **ros_environment(application(ros={}).spec))
    script = script.replace("export PATH=", f"export PATH={tmp_path}:").replace(
        "/etc/os-release", f"{tmp_path}/os-release"
    )
    run = subprocess.run(["bash", "-c", script], cwd=tmp_path, capture_output=True, text=True, timeout=600,
                         env={"PATH": "/usr/bin:/bin", "HOME": str(tmp_path)})  # fmt: skip
    assert run.returncode == code
    assert said in run.stdout
    assert "is ready" not in run.stdout


def test_nodes_are_asked_for_the_parameters_that_the_spec_sets() -> None:
    nodes = [
        {"package": "p", "executable": "e", "parameters": {"gain": 1.0, "pid": {"i": 2}}},
        {"package": "p", "executable": "e", "name": "arm", "parameters": {"a": 1}},
        {"package": "p", "executable": "e", "name": "arm", "namespace": "left", "parameters": {"a": 1}},
        {"package": "p", "executable": "e", "name": "$(env ARM)", "parameters": {"a": 1}},
        {"package": "p", "executable": "e", "name": "files_may_be_for_others", "parameter_files": ["x.yaml"]},
        {"package": "rclcpp_components", "executable": "component_container", "name": "box",
         "composable_node_descriptions": [{"package": "p", "plugin": "p::E", "name": "eye", "parameters": {"fps": 5}},
                                          {"package": "p", "plugin": "p::E", "parameters": {"fps": 6}}]},
    ]  # fmt: skip
    asked = asks([Node.model_validate(one) for one in nodes])
    assert asked is not None
    assert " ".join(asked) == (
        "python3 -m fogspec_agent.declared --of p/e gain pid.i --of arm a --of /left/arm a --of p/e a --of eye fps"
        " --of rclcpp_components/component_container fps"
    )
    assert asks([Node.model_validate(nodes[4])]) is None
