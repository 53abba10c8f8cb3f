"""The interface of the probes: what a spec says, which on-machine half starts, and what set-up installs for it."""

import shutil
import subprocess

import pytest

from fogspec.base.templates import render
from fogspec.compile.tasks import deployed_processes, measured_processes, ros_environment
from fogspec.language.probe import ProbeParts, kind_of, player, probe_parts, via
from fogspec.language.schema import Application, Spec
from tests.support.jobs import GENERATED

TOPICS = {"request": "in", "response": "/out"}


def spec(probe: dict, **more) -> Spec:
    whole = {"cloud": [{"cmd": ["node"]}], "probe": probe, "infra": ["aws"], **more}
    return Application.model_validate(
        {"apiVersion": "fogspec.dev/v1alpha1", "kind": "Application", "metadata": {"name": "app"}, "spec": whole}
    ).spec


def words(*argv: str) -> tuple[str, ...]:
    return ("python3", "-m", *argv)


@pytest.mark.parametrize(
    ("probe", "expected"),
    [
        ({"callback": "plan"}, ProbeParts()),
        (
            TOPICS,
            ProbeParts(beside=(words("fogspec_agent.topics", "--request", "/in", "--response", "/out", "--match", "stamp"),)),
        ),
        (
            {**TOPICS, "match": "order", "via": "preload"},
            ProbeParts(inside=(
                *words("fogspec_agent.preload", "--request", "/in", "--response", "/out", "--match", "order"), "--",
            )),
        ),
        ({"service": "plan"}, ProbeParts(inside=(*words("fogspec_agent.preload", "--service", "/plan"), "--"))),
        ({"action": "/go"}, ProbeParts(beside=(words("fogspec_agent.topics", "--action", "/go"),))),
        ({"action": "/go", "via": "preload"}, ProbeParts(inside=(*words("fogspec_agent.preload", "--action", "/go"), "--"))),
        (
            {**TOPICS, "bag": "run", "success": "x == 1", "timeout": "2s"},
            ProbeParts(
                afterwards=words(
                    "fogspec_agent.bag", "--bag", "run", "--request", "/in", "--response", "/out",
                    "--match", "stamp", "--success", "x == 1", "--timeout", "2",
                )
            ),
        ),
    ],
)  # fmt: skip
def test_each_probe_starts_its_half(probe: dict, expected: ProbeParts) -> None:
    assert probe_parts(spec(probe)) == expected


def test_metrics_are_heard_beside_every_probe() -> None:
    metrics = {"length": {"topic": "plan", "field": "cost.total"}, "own": {"callback": "own"}}
    heard = words("fogspec_agent.topics", "--metric", "length=/plan:cost.total")
    for probe in ({"callback": "plan"}, {"service": "/plan"}):
        assert probe_parts(spec(probe, metrics=metrics)).beside == (heard,)
    assert probe_parts(spec({"action": "/go"}, metrics=metrics)).beside[0][3:] == ("--action", "/go", *heard[3:])


def test_only_the_measured_nodes_have_the_library_in_their_process() -> None:
    client = {"benchmark": {"budget": "$1", "workload": {"node": {"cmd": ["client"]}}}}
    measured, client_argv = measured_processes(spec({"service": "/plan"}, **client))
    assert isinstance(measured, dict)
    assert measured["argv"][-2:] == ["--", "node"]
    assert client_argv == {"argv": ["client"], "name": "client"}


@pytest.mark.parametrize(
    ("probe", "workload", "held"),
    [
        ({"match": "order"}, {"node": {"cmd": ["client"]}}, 1),
        ({"match": "order"}, {"bag": "drive", "rate": "5/s"}, 1),
        ({"match": "order"}, {"bag": "drive"}, 0),  # one request after the other
        ({"match": "order", "via": "preload"}, {"node": {"cmd": ["client"]}}, 0),  # inside of the node from its start
        ({}, {"node": {"cmd": ["client"]}}, 0),
    ],
)
def test_what_sends_requests_without_stamps_is_held(probe: dict, workload: dict, held: int) -> None:
    one = spec({**TOPICS, **probe}, benchmark={"budget": "$1", "workload": workload})
    processes = measured_processes(one)
    assert len([each for each in processes if isinstance(each, dict) and each.get("held")]) == held
    assert [word for argv in probe_parts(one).beside for word in argv].count("--hold") == held
    assert (
        processes[-1] == {"argv": processes[-1]["argv"], "name": "client", "held": True}
        if held and "node" in workload
        else True
    )


@pytest.mark.parametrize(
    ("probe", "workload", "expected"),
    [
        (TOPICS, {"bag": "drive"}, ["--bag", "drive", "--request", "/in", "--response", "/out"]),
        ({"service": "/s", "timeout": "2s", "success": "a == 1"}, {"bag": "b", "rate": "5/s"},
         ["--bag", "b", "--service", "/s", "--success", "a == 1", "--rate", "5", "--timeout", "2"]),
        ({"service": "/s"}, {}, None),
    ],
)  # fmt: skip
def test_bags_are_played_to_whom_the_probe_watches(probe: dict, workload: dict, expected: list[str] | None) -> None:
    found = player(spec(probe, benchmark={"budget": "$1", "workload": workload}))
    assert found == ([] if expected is None else [[*words("fogspec_agent.player"), *expected]])


def test_a_deployment_is_watched_by_the_same_library_and_starts_without_it() -> None:
    app = {"apiVersion": "fogspec.dev/v1alpha1", "kind": "Application", "metadata": {"name": "app"}}
    whole = {"cloud": [{"cmd": ["node"]}], "probe": {"service": "/s"}, "infra": ["aws"]}
    found = deployed_processes(Application.model_validate({**app, "spec": whole}))
    argv = [*words("fogspec_agent.preload", "--service", "/s", "--optional", "--"), "node"]
    assert found == [{"argv": argv, "name": "node"}]
    found = deployed_processes(Application.model_validate({**app, "spec": {**whole, "probe": {"callback": "plan"}}}))
    assert found == [{"argv": ["node"], "name": "node"}]


def test_kinds_and_ways() -> None:
    probes = [TOPICS, {"service": "/s"}, {"action": "/a"}, {"callback": "c"}, {**TOPICS, "bag": "b"}]
    found = [spec(probe).probe for probe in probes]
    assert [(kind_of(one), via(one)) for one in found] == [
        ("topics", "rclpy"), ("service", "preload"), ("action", "rclpy"), ("callback", None), ("bag", None),
    ]  # fmt: skip


@pytest.mark.parametrize("distro", ["humble", "jazzy", "kilted", "lyrical", "rolling"])
@pytest.mark.parametrize(
    ("probe", "workload", "installed"),
    [
        (TOPICS, {}, []),
        ({"service": "/s"}, {}, ["apt gcc libc6-dev"]),
        ({"service": "/s"}, {"bag": "b"}, ["apt gcc libc6-dev", "apt python3-pip", "pip mcap rosbags"]),
        ({**TOPICS, "bag": "run"}, {}, ["apt python3-pip", "pip mcap rosbags"]),
    ],
)
def test_set_up_installs_what_the_probe_needs(tmp_path, distro, probe, workload, installed) -> None:
    """The real script in a real bash; only the programs that would change this host are stand-ins."""
    tools, ros = tmp_path / "bin", tmp_path / "ros" / distro
    for folder in (tools, ros):
        folder.mkdir(parents=True)
    (ros / "setup.bash").touch()
    for name in ("mkdir", "tee", "touch", "id"):
        (tools / name).symlink_to(str(shutil.which(name)))
    said = tmp_path / "said"
    python = f'case "$*" in *--version) exit 1;; esac; echo "pip $*" >> {said}'
    for name, body in {"apt-get": f'echo "apt $*" >> {said}', "sudo": 'shift; "$@"', "python3": python}.items():
        (tools / name).write_text(f"#!/bin/sh\n{body}\n")
        (tools / name).chmod(0o755)
    one = spec(probe, ros={"distro": distro}, benchmark={"budget": "$1", "workload": workload})
    script = render("setup.sh.j2", **GENERATED, **ros_environment(one)).replace("/opt/ros", str(ros.parent))
    script = "\n".join(
        line if not line.startswith("export PATH=") else f"export PATH={tools}" for line in script.splitlines()
    )
    ran = subprocess.run(["/bin/bash", "-c", script], cwd=tmp_path, timeout=600, capture_output=True, text=True,
                         env={"PATH": str(tools), "HOME": str(tmp_path)})  # fmt: skip
    assert ran.returncode == 0, ran.stdout + ran.stderr
    lines = said.read_text().splitlines() if said.exists() else []
    for what in installed:
        program, *names = what.split()
        assert any(line.startswith(program) and all(name in line for name in names) for line in lines), (what, lines)
    assert sum("install" in line for line in lines) == len(installed)


def test_the_script_with_everything_passes_shellcheck(tmp_path) -> None:
    if shutil.which("shellcheck") is None:
        pytest.skip("needs shellcheck: apt-get install shellcheck")
    one = spec({"service": "/s"}, ros={}, benchmark={"budget": "$1", "workload": {"bag": "b"}})
    (tmp_path / "script.sh").write_text(render("setup.sh.j2", **GENERATED, **ros_environment(one)))
    ran = subprocess.run(["shellcheck", "-e", "SC1091", str(tmp_path / "script.sh")], capture_output=True, text=True)
    assert ran.returncode == 0, ran.stdout
