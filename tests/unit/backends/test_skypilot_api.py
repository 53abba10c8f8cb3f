"""What SkyPilot is asked to do, with a SkyPilot in its place that only keeps books: launches, prices, machines, requests."""

import base64
import contextlib
import importlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from datetime import datetime
from functools import partial
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from fogspec.backends.skypilot.errors import CloudProblem, classify

NAME = "fogspec-lab-demo-one"
MODULES = ("api", "internals")


class ClusterDoesNotExist(Exception):
    pass


@dataclass
class Sky:
    """The books: every call in order, what is up, what is asked for, and what its cloud still has."""

    calls: list[tuple[Any, ...]] = field(default_factory=list)
    prices: list[float | None] = field(default_factory=lambda: [1.0])
    requests: list[SimpleNamespace] = field(default_factory=list)
    up: list[str] = field(default_factory=list)
    undead: int = 0
    config: Any = None
    at_the_cloud: list[dict[str, Any]] = field(default_factory=list)
    slept_s: list[float] = field(default_factory=list)
    task: Any = None
    now_s: float = 0.0
    commands: list[str] | None = None
    override: Any = None
    configured: Any = None
    enabled: list[str] = field(default_factory=lambda: ["AWS", "Kubernetes"])
    health: Exception | None = None
    to_find: list[str] = field(default_factory=list)
    when_asleep: Callable[[], object] = lambda: None

    def names(self) -> list[str]:
        return [str(call[0]) for call in self.calls]

    def sleep(self, seconds: float) -> None:
        self.slept_s.append(seconds)
        self.now_s += seconds
        self.when_asleep()

    def request(self, status: str, name: str = NAME, what: str = "sky.launch", at: float = 1.0) -> SimpleNamespace:
        one = SimpleNamespace(
            request_id=f"r{len(self.requests)}",
            cluster_name=name,
            name=what,
            created_at=at,
            status=status,
            user_id="ada",
        )
        self.requests.append(one)
        return one

    def module(self) -> ModuleType:
        """What `import sky` gives."""
        sky: Any = ModuleType("sky")
        for name in ("launch", "api_info", "api_status", "api_cancel", "down", "status"):
            setattr(sky, name, getattr(self, name))
        for name in ("queue", "autostop", "tail_logs", "api_stop"):
            setattr(sky, name, lambda *words, called=name, **more: self.calls.append((called, *words, more)))
        sky.get = lambda value: value
        sky.Task = SimpleNamespace(from_yaml_config=self.from_config)
        sky.StatusRefreshMode = SimpleNamespace(FORCE="force", NONE="none")
        sky.exceptions = SimpleNamespace(ClusterDoesNotExist=ClusterDoesNotExist, ClusterNotUpError=ValueError)
        sky.skypilot_config = SimpleNamespace(get_nested=self.nested, override_skypilot_config=self.overridden)
        sky.global_user_state = SimpleNamespace(get_cluster_yaml_dict=self.config_of)
        schema = {one: {"properties": {"remote_identity": {}}} for one in ("aws", "gcp", "azure")}
        sky.utils = SimpleNamespace(
            schemas=SimpleNamespace(get_config_schema=lambda: {"properties": schema | {"lambda": {}}})
        )
        sky.client = SimpleNamespace(sdk=SimpleNamespace(check=self.check, enabled_clouds=self.enabled_clouds))
        sky.provision = SimpleNamespace(query_instances=self.instances, terminate_instances=self.terminated)
        return sky

    def api_info(self) -> None:
        self.calls.append(("api_info",))
        if self.health is not None:
            raise self.health

    def enabled_clouds(self) -> list[str]:
        self.calls.append(("enabled_clouds",))
        return list(self.enabled)

    def check(self, infra: tuple[str, ...], verbose: bool) -> None:
        self.calls.append(("check", infra, verbose))
        self.enabled += self.to_find

    def from_config(self, given: Any) -> Any:
        self.task = given
        return SimpleNamespace(resources=[SimpleNamespace(get_cost=partial(_cost, price)) for price in self.prices])

    def launch(self, task: Any, cluster_name: str) -> str:
        self.calls.append(("launch", cluster_name))
        self.configured = self.override
        return "request-1"

    def nested(self, keys: tuple[str, ...], default_value: Any) -> Any:
        return self.commands if keys == ("aws", "post_provision_runcmd") else default_value

    @contextlib.contextmanager
    def overridden(self, more: Any) -> Iterator[None]:
        self.override = more
        yield
        self.override = None

    def api_status(self, ids: Any = None, *, cluster_name: Any = None, all_status: bool) -> list[Any]:
        self.calls.append(("api_status", cluster_name, all_status))
        known = [one for one in self.requests if all_status or one.status in ("PENDING", "RUNNING")]
        return [one for one in known if ids is None or one.request_id in ids]

    def api_cancel(self, ids: list[str], silent: bool) -> None:
        self.calls.append(("api_cancel", *ids))
        for one in self.requests:
            if one.request_id in ids:
                one.status = "CANCELLED"

    def down(self, name: str) -> None:
        self.calls.append(("down", name))
        if name not in self.up:
            raise ClusterDoesNotExist
        if not self.undead:
            self.up.remove(name)

    def status(
        self, names: list[str] | None, *, refresh: str = "none", all_users: bool = False
    ) -> list[dict[str, Any]]:
        self.calls.append(("status", names, refresh, all_users))
        shown = [one for one in self.up if names is None or one in names]
        state = SimpleNamespace(value="UP")
        return [{"name": one, "status": state, "launched_at": 5, "handle": None} for one in shown]

    def config_of(self, file: str) -> dict[str, Any]:
        if self.config is None:
            raise ValueError("no such file")
        assert file == f"{NAME}.yml"
        return self.config

    def instances(self, module: str, name: str, there: str, provider: Any, non_terminated_only: bool) -> Any:
        self.calls.append(("query", module, name, there, non_terminated_only))
        return self.at_the_cloud.pop(0) if len(self.at_the_cloud) > 1 else self.at_the_cloud[0]

    def terminated(self, *words: Any) -> None:
        self.calls.append(("terminate", *words))


def _cost(price_usd_per_hour: float | None, seconds: float) -> float:
    if price_usd_per_hour is None:
        raise RuntimeError("no price is known")
    return price_usd_per_hour * seconds / 3600


@pytest.fixture
def sky(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Sky:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return Sky()


@pytest.fixture
def api(sky: Sky, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The product's module, imported beside these books."""
    monkeypatch.setitem(sys.modules, "sky", sky.module())
    monkeypatch.setitem(sys.modules, "sky.client", sys.modules["sky"].client)
    monkeypatch.setitem(sys.modules, "sky.utils", sys.modules["sky"].utils)
    kept = {name: sys.modules.pop(f"fogspec.backends.skypilot.{name}", None) for name in MODULES}
    clock = SimpleNamespace(sleep=sky.sleep, monotonic=lambda: sky.now_s, time=lambda: sky.now_s)
    internals = importlib.import_module("fogspec.backends.skypilot.internals")
    monkeypatch.setattr(internals, "time", clock)
    module = importlib.import_module("fogspec.backends.skypilot.api")
    monkeypatch.setattr(module, "time", clock)
    yield module
    for name, old in kept.items():
        whole = f"fogspec.backends.skypilot.{name}"
        sys.modules.pop(whole)
        if old is not None:
            sys.modules[whole] = old


# The price at the moment of the launch


@pytest.mark.parametrize(
    ("prices", "starts"),
    [
        ([0.9999], True),
        ([1.0], True),
        ([1.0000001], True),
        ([1.00001], False),
        ([2.0], False),
        ([0.5, 2.0], False),
        ([0.5, 0.6], True),
        ([None], True),
        ([None, 2.0], False),
        ([0.0], True),
    ],
)
def test_a_machine_above_the_price_of_its_task_is_not_launched(
    api: Any, sky: Sky, prices: list[float | None], starts: bool
) -> None:
    sky.prices = prices
    task = {"run": "true", "resources": {"max_hourly_cost": 1.0}}
    if starts:
        assert api.launch(task, NAME, "/") == {"request": "request-1"}
        assert sky.calls == [("launch", NAME)]
    else:
        with pytest.raises(CloudProblem, match="the task allows") as refused:
            api.launch(task, NAME, "/")
        assert (refused.value.reason, refused.value.again, refused.value.refused) == ("budget", False, True)
        assert f"${max(one or 0 for one in prices):g} per hour" in refused.value.detail
        assert sky.calls == [], "nothing was asked for"


@pytest.mark.parametrize("resources", [None, {}, {"max_hourly_cost": None}])
def test_a_task_without_a_highest_price_is_launched(api: Any, sky: Sky, resources: object) -> None:
    sky.prices = [1e6]
    api.launch({"run": "true", "resources": resources}, NAME, "/")
    assert sky.names() == ["launch"]


def test_a_refused_launch_leaves_no_secret_behind(api: Any, sky: Sky, tmp_path: Path) -> None:
    os.environ["A_KEY"] = "hunter2"
    try:
        task = {"run": "true", "secrets": {"A_KEY": None}, "resources": {"max_hourly_cost": 1.0}}
        api.launch(task, NAME, "/")
        (kept,) = [path for path in tmp_path.iterdir() if path.is_file()]
        assert kept.read_text() == "export A_KEY=hunter2\n"
        assert kept.stat().st_mode & 0o777 == 0o600
        assert "hunter2" not in str(sky.task)
        sky.prices = [2.0]
        with pytest.raises(CloudProblem):
            api.launch(task, NAME, "/")
        assert not [path for path in tmp_path.iterdir() if path.is_file()]
    finally:
        del os.environ["A_KEY"]


def test_paths_of_a_task_are_those_of_its_project(api: Any, sky: Sky) -> None:
    mounts = {"~/.fogspec/agent.pyz": "compiled/agent.pyz", "/data": "s3://bucket/data", "/x": {"name": "store"}}
    api.launch({"run": "true", "workdir": "specs", "file_mounts": mounts}, NAME, "/project")
    assert sky.task["workdir"] == "/project/specs"
    assert sky.task["file_mounts"] == {**mounts, "~/.fogspec/agent.pyz": "/project/compiled/agent.pyz"}
    api.launch({"run": "true", "workdir": "/a/snapshot"}, NAME, "/project")
    assert sky.task["workdir"] == "/a/snapshot"


# Only what is ours


@pytest.mark.parametrize("name", ["production", "fogspe-x", "Fogspec-x", "", "xfogspec-a"])
def test_no_operation_asks_for_a_machine_that_is_not_ours(api: Any, sky: Sky, name: str) -> None:
    sky.up = [name]
    for op in (
        lambda: api.launch({"run": "x"}, name, "/"),
        lambda: api.find(name),
        lambda: api.jobs(name),
        lambda: api.end(name),
        lambda: api.autostop(name, 5),
        lambda: api.clusters(prefix=name),
        lambda: api.waiting(prefix=name),
    ):
        with pytest.raises(ValueError, match="it is not ours"):
            op()
    assert sky.calls == []
    assert sky.up == [name]


def test_others_machines_are_in_no_list(api: Any, sky: Sky) -> None:
    sky.up = ["production", "fogspec-a", "fogspec-b", "myfogspec-c"]
    assert [one["name"] for one in api.clusters()] == ["fogspec-a", "fogspec-b"]
    assert [one["name"] for one in api.clusters(prefix="fogspec-b")] == ["fogspec-b"]
    assert sky.calls[-1] == ("status", None, "none", True), "machines of all users of the server are looked at"
    for name in ("fogspec-a", "production", "fogspec-a", "myfogspec-c"):
        sky.request("PENDING", name)
    sky.request("PENDING", "fogspec-d", what="sky.status")
    sky.request("SUCCEEDED", "fogspec-e")
    assert api.waiting() == ["fogspec-a"]


# The end of a machine


def test_an_end_takes_down_breaks_off_and_asks_the_cloud(api: Any, sky: Sky) -> None:
    sky.up = ["production", NAME]
    sky.request("SUCCEEDED")
    sky.request("RUNNING", "production")
    api.end(NAME)
    assert sky.up == ["production"]
    assert "api_cancel" not in sky.names()
    assert ("status", [NAME], "force", True) in sky.calls, "the cloud itself is asked"
    assert sky.slept_s == []
    assert sky.requests[1].status == "RUNNING", "a launch of another machine goes on"


@pytest.mark.parametrize("status", ["PENDING", "RUNNING"])
def test_a_launch_on_its_way_is_broken_off_first(api: Any, sky: Sky, status: str) -> None:
    sky.request(status)
    api.end(NAME)
    assert sky.names().index("api_cancel") < sky.names().index("down")
    assert sky.slept_s == [], "it is known: no other comes"


def test_what_nobody_knows_is_looked_for_once_more(api: Any, sky: Sky) -> None:
    sky.when_asleep = lambda: sky.up.append(NAME)
    api.end(NAME)
    assert sky.slept_s == [5.0]
    assert sky.up == []
    assert sky.names().count("down") == 2


def test_a_machine_that_is_still_there_is_not_gone(api: Any, sky: Sky) -> None:
    sky.up, sky.undead = [NAME], 1
    with pytest.raises(CloudProblem, match="is still there") as problem:
        api.end(NAME)
    assert (problem.value.again, problem.value.gone) == (True, False)


def test_a_launch_that_cannot_be_broken_off_is_not_gone(api: Any, sky: Sky, monkeypatch: pytest.MonkeyPatch) -> None:
    sky.request("RUNNING")
    monkeypatch.setattr(api.sky, "api_cancel", lambda ids, silent: None)
    with pytest.raises(CloudProblem, match="is still there"):
        api.end(NAME)


# What its cloud still has


@pytest.fixture
def deployed(sky: Sky) -> Sky:
    sky.config = {"provider": {"module": "sky.provision.aws"}, "cluster_name": f"{NAME}-1234"}
    return sky


def test_gone_is_what_the_cloud_has_no_more(api: Any, deployed: Sky) -> None:
    running, ending = {"i-1": ("running", None)}, {"i-1": ("shutting-down", None)}
    deployed.request("SUCCEEDED")
    deployed.up, deployed.at_the_cloud = [NAME], [running, ending, {"i-1": (None, None)}]
    assert api.end(NAME) == 1
    assert deployed.slept_s == [1.0, 1.0]
    assert deployed.calls[-1] == ("query", "aws", NAME, f"{NAME}-1234", False), "also those that have ended"


@pytest.mark.parametrize("status", ["FAILED", "RUNNING"])
def test_a_machine_that_appears_after_its_launch_was_cut_off_is_terminated(
    api: Any, deployed: Sky, status: str
) -> None:
    deployed.now_s = 1000.0
    deployed.request(status).finished_at = 990.0
    appears: list[dict[str, Any]] = [{}, {}, {"i-1": ("pending", None)}, {"i-1": (None, None)}]
    deployed.at_the_cloud = appears
    assert api.end(NAME) == 1
    assert deployed.calls.count(("terminate", "aws", f"{NAME}-1234", deployed.config["provider"])) == 1
    assert sum(deployed.slept_s) == (20.0 if status == "FAILED" else 30.0), "as long as EC2 may not show it"


def test_a_launch_that_was_refused_had_no_machine(api: Any, deployed: Sky) -> None:
    deployed.now_s = 1000.0
    deployed.request("FAILED").finished_at = 900.0
    deployed.at_the_cloud = [{}]
    assert api.end(NAME) == 0
    assert deployed.slept_s == []
    assert "terminate" not in deployed.names()


def test_elsewhere_a_machine_that_is_being_ended_is_only_waited_for(api: Any, deployed: Sky) -> None:
    deployed.config["provider"]["module"] = "sky.provision.slurm"
    deployed.request("CANCELLED")
    deployed.at_the_cloud = [{"7": ("running", None)}, {}]
    assert api.end(NAME) is None, "it does not say how many there were"
    assert "terminate" not in deployed.names()
    assert deployed.calls[-1] == ("query", "slurm", NAME, f"{NAME}-1234", True)


def test_a_cloud_that_keeps_it_is_said_after_a_while_and_not_before(api: Any, deployed: Sky) -> None:
    deployed.request("SUCCEEDED")
    deployed.up, deployed.at_the_cloud = [NAME], [{"i-2": ("running", None), "i-1": ("running", None)}]
    with pytest.raises(CloudProblem, match="its cloud still has i-1, i-2") as problem:
        api.end(NAME)
    assert (problem.value.reason, problem.value.again) == ("setup", True)
    assert 90 < sum(deployed.slept_s) < 93


def test_without_a_record_of_its_cloud_the_answer_of_down_stands(api: Any, sky: Sky) -> None:
    sky.up = [NAME]
    assert api.end(NAME) is None
    assert "query" not in sky.names()


# Logs


def test_a_log_is_written_up_to_its_limit(api: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    asked: dict[str, Any] = {}

    def tail(name: str, job: int, **words: Any) -> Iterator[str | None]:
        asked.update(words, name=name, job=job)
        yield from ("12345", None, "é6", "over")
        raise AssertionError("a log without an end is read on")

    monkeypatch.setattr(api.sky, "tail_logs", tail)
    path = tmp_path / "log"
    words: dict[str, Any] = {"root": str(tmp_path)} if "root" in api.log.__code__.co_varnames else {}
    assert api.log(NAME, 7, path=str(path), limit=8, follow=True, tail=3, **words) == 8
    assert path.read_bytes() == "12345é6".encode()
    assert asked == {"name": NAME, "job": 7, "follow": True, "tail": 3, "preload_content": False}


def test_a_machine_gets_its_own_end(api: Any, sky: Sky) -> None:
    api.autostop(NAME, 12)
    assert sky.calls == [("autostop", NAME, {"idle_minutes": 12, "down": True})]


# Launches and jobs that are asked about


def test_a_launch_is_followed_to_its_job_and_its_secrets_go(api: Any, sky: Sky, tmp_path: Path) -> None:
    secret = tmp_path / f"{NAME}.secrets"
    one = sky.request("RUNNING")
    secret.write_text("export A=b\n")
    assert api.launched(one.request_id, NAME) is None
    assert secret.exists(), "a local API server reads it later"
    one.status = SimpleNamespace(value="SUCCEEDED")
    answers: dict[Any, Any] = {one.request_id: (7, "a handle")}
    sky_get = api.sky.get
    api.sky.get = lambda value: answers.get(value, value) if isinstance(value, str) else sky_get(value)
    assert api.launched(one.request_id, NAME) == {"job": 7}
    assert not secret.exists()


def test_a_launch_that_the_providers_api_did_not_answer_is_told_as_such() -> None:
    said = 'Read timeout on endpoint URL: "https://ec2.us-east-1.amazonaws.com/"'
    problem = classify(RuntimeError("Max attempts exceeded."), f"AWS handler error: {said}\n")
    assert problem.detail == f"{said} | Max attempts exceeded."


@pytest.mark.parametrize("readable", [True, False])
def test_a_launch_that_failed_is_told_in_the_providers_words(api: Any, sky: Sky, readable: bool) -> None:
    one = sky.request("FAILED")

    def logged(request: str, *, follow: bool, output_stream: Any) -> None:
        assert (request, follow) == (one.request_id, False)
        if not readable:
            raise OSError("no answer")
        output_stream.write("An error occurred (VcpuLimitExceeded) when calling the RunInstances operation: too many\n")

    def failed(value: Any) -> Any:
        if value == one.request_id:
            raise RuntimeError("Max attempts exceeded.")
        return value

    api.sky.stream_and_get, api.sky.get = logged, failed
    with pytest.raises(CloudProblem) as found:
        api.launched(one.request_id, NAME)
    said = (
        ("quota", "VcpuLimitExceeded: too many | Max attempts exceeded.")
        if readable
        else ("setup", "Max attempts exceeded.")
    )
    assert (found.value.reason, found.value.detail) == said


def test_a_launch_that_the_server_forgot_is_found_by_its_job_or_gone(api: Any, sky: Sky, tmp_path: Path) -> None:
    secret = tmp_path / f"{NAME}.secrets"
    secret.write_text("export A=b\n")
    rows = [
        {"job_id": number, "status": SimpleNamespace(value="RUNNING"), "submitted_at": 1, "start_at": 2, "end_at": None}
        for number in (2, 10, 9)
    ]
    api.sky.queue = lambda name, all_users: rows if (name, all_users) == (NAME, True) else []
    assert api.launched("r99", NAME) == {"job": 10}, "the newest"
    assert not secret.exists()
    assert api.find(NAME) == {"job": 10}
    assert [row["job"] for row in api.jobs(NAME)] == [10, 9, 2]
    assert api.jobs(NAME)[0] == {"job": 10, "status": "RUNNING", "submitted_at": 1, "start_at": 2, "end_at": None}
    rows.clear()
    assert api.find(NAME) is None
    with pytest.raises(CloudProblem, match="does not know this launch") as forgotten:
        api.launched("r99", NAME)
    assert (forgotten.value.reason, forgotten.value.again, forgotten.value.gone) == ("setup", True, True)
    for missing in (ClusterDoesNotExist, ValueError):
        api.sky.queue = lambda name, all_users, missing=missing: (_ for _ in ()).throw(missing())
        assert api.find(NAME) is None


def test_the_newest_launch_of_a_machine_is_found(api: Any, sky: Sky) -> None:
    for at, what, name in (
        (3.0, "launch", NAME),
        (5.0, "sky.launch", NAME),
        (9.0, "status", NAME),
        (8.0, "launch", "x"),
    ):
        sky.request("FAILED", name, what, at)
    assert api.find(NAME) == {"request": "r1"}


def test_secrets_go_beside_other_mounts_and_skypilots_own_stay_with_it(
    api: Any, sky: Sky, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("A_KEY", "it's")
    monkeypatch.setenv("SKYPILOT_DOCKER_PASSWORD", "p")
    task = {"run": "x", "secrets": dict.fromkeys(["SKYPILOT_DOCKER_PASSWORD", "A_KEY"]), "file_mounts": {"/a": "b"}}
    api.launch(task, NAME, "/project")
    assert sky.task["file_mounts"] == {"/a": "/project/b", "~/.fogspec/secrets": str(tmp_path / f"{NAME}.secrets")}
    assert sky.task["secrets"] == {"SKYPILOT_DOCKER_PASSWORD": "p"}
    assert (tmp_path / f"{NAME}.secrets").read_text() == "export A_KEY='it'\"'\"'s'\n"
    assert set(task["secrets"]) == {"SKYPILOT_DOCKER_PASSWORD", "A_KEY"}, "the caller's task stays as it is"
    api.launch({"run": "x"}, NAME, "/project")
    assert not set(sky.task) & {"secrets", "file_mounts"}
    monkeypatch.delenv("A_KEY")
    with pytest.raises(CloudProblem, match="does not have A_KEY") as refused:
        api.launch(task, NAME, "/project")
    assert refused.value.reason == "setup"
    assert sky.names() == ["launch", "launch"]


def test_secrets_are_written_to_a_new_file_of_their_own(
    api: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from fogspec.backends.skypilot import secrets_file

    (tmp_path / "mine").write_text("precious")
    (tmp_path / f"{NAME}.secrets").symlink_to(tmp_path / "mine")
    before = os.umask(0)
    try:
        path = secrets_file.write(NAME, {"A": "1"})
    finally:
        os.umask(before)
    assert not path.is_symlink()
    assert (path.stat().st_mode & 0o777, path.read_text()) == (0o600, "export A=1\n")
    assert (tmp_path / "mine").read_text() == "precious"
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    assert secrets_file.place(NAME) == Path(tempfile.gettempdir(), f"{NAME}.secrets")
    secrets_file.check({"secrets": {}})
    secrets_file.check({})
    with pytest.raises(CloudProblem, match="NOT_SET_ANYWHERE"):
        secrets_file.check({"secrets": {"NOT_SET_ANYWHERE": None}})


def test_what_is_told_of_a_machine(api: Any, sky: Sky, monkeypatch: pytest.MonkeyPatch) -> None:
    class Slurm:
        pass

    class AWS:
        pass

    def handle(cloud: object, price: float | None) -> Any:
        resources = SimpleNamespace(
            infra=SimpleNamespace(to_str=lambda: "aws/r1"), instance_type="c6i.large", labels={"a": "b"}, cloud=cloud,
            get_cost=partial(_cost, price),
        )  # fmt: skip
        addresses = [("10.0.0.7", "192.0.2.1")]
        return SimpleNamespace(
            launched_resources=resources, head_ip="192.0.2.9", stable_internal_external_ips=addresses
        )

    def told(one: Any) -> dict[str, Any]:
        record = {"name": NAME, "status": SimpleNamespace(value="UP"), "launched_at": 5, "handle": one}
        monkeypatch.setattr(api.sky, "status", lambda *_, **__: [record])
        return api.clusters()[0]  # type: ignore[no-any-return]

    assert told(handle(AWS(), 1.5)) == {
        "name": NAME, "status": "UP", "infra": "aws/r1", "instance": "c6i.large", "price_usd_per_hour": 1.5,
        "launched_at": 5, "ip": "192.0.2.9", "labels": {"a": "b"},
    }  # fmt: skip
    assert told(handle(Slurm(), None))["ip"] == "10.0.0.7"
    assert told(handle(Slurm(), None))["price_usd_per_hour"] is None
    bare = told(None)
    assert (bare["infra"], bare["instance"], bare["ip"], bare["labels"]) == (None, None, None, {})


def test_a_server_that_answers_is_told_by_its_version(api: Any, sky: Sky) -> None:
    api.sky.__version__ = "0.14.1"
    assert api.hello() == {"version": "0.14.1"}
    assert sky.calls[0][:2] == ("status", ["fogspec-none"])


def caused(by: Exception) -> Exception:
    problem = RuntimeError("max retries exceeded")
    problem.__context__ = by
    return problem


@pytest.mark.parametrize(
    ("health", "serves"),
    [(None, True), (TimeoutError(), True), (caused(OSError()), True), (caused(ConnectionRefusedError()), False)],
)
def test_a_server_that_may_run_is_not_taken_for_none(
    api: Any, sky: Sky, health: Exception | None, serves: bool
) -> None:
    sky.health = health
    assert api.serves() is serves
    assert sky.names() == ["api_info"]


def test_a_server_that_others_use_is_not_ended(api: Any, sky: Sky) -> None:
    sky.request("RUNNING", "", "sky.status-refresh").user_id = "skypilot-system"
    other = sky.request("RUNNING", "anothers")
    api.end_server()
    assert sky.names() == ["api_status"]
    other.status = "SUCCEEDED"
    api.end_server()
    assert sky.names() == ["api_status", "api_status", "api_stop"]


# An end that needs nobody


def sample_task(minutes: int = 13, infra: str = "aws/us-east-1", **autostop: object) -> dict[str, Any]:
    end = {"idle_minutes": minutes, "down": True, "wait_for": "none", **autostop}
    return {"run": "x", "resources": {"infra": infra, "autostop": end}}


def first_boot(sky: Sky, folder: Path, enable: int = 0) -> list[str]:
    """What the first boot of the machine that is configured asks of systemd; the units that it writes are in the folder."""
    (command, *theirs) = sky.configured["aws"]["post_provision_runcmd"]
    assert theirs == (sky.commands or [])
    assert re.fullmatch(r"echo [A-Za-z0-9+/=]+ [|] base64 -d [|] sh", command), "it is YAML as it stands"
    return run_script(command, folder, enable)


def run_script(command: str, folder: Path, enable: int = 0) -> list[str]:
    script = base64.b64decode(command.split()[1]).decode().replace("/etc/systemd/system", str(folder))
    for name in ("systemctl", "systemd-run"):
        (folder / name).write_text(f'#!/bin/sh\necho {name} "$@"\n[ "$1" != enable ] || exit {enable}\n')
        (folder / name).chmod(0o755)
    ran = subprocess.run(
        ["sh", "-c", script], capture_output=True, text=True, env={"PATH": f"{folder}:{os.environ['PATH']}"}
    )
    assert ran.stderr == ""
    return [line for line in ran.stdout.splitlines() if "daemon-reload" not in line]


def verified(folder: Path) -> None:
    units = [str(one) for one in folder.iterdir() if one.suffix in (".service", ".timer")]
    assert units
    if shutil.which("systemd-analyze") is not None:
        done = subprocess.run(
            ["systemd-analyze", "verify", "--recursive-errors=no", *units], capture_output=True, text=True
        )
        assert (done.returncode, done.stderr) == (0, "")


def test_a_samples_machine_on_aws_turns_itself_off_also_after_a_reboot(api: Any, sky: Sky, tmp_path: Path) -> None:
    sky.commands = ["the user's own"]
    before_s = time.time()
    api.launch(sample_task(), NAME, "/")
    said = first_boot(sky, tmp_path)
    assert said == ["systemctl enable fogspec-rebooted.timer", "systemctl enable --now fogspec-end.timer"]
    end = (tmp_path / "fogspec-end.timer").read_text()
    # 13 minutes of life, and 5 until autostop is armed.
    assert "\nOnBootSec=1080\n" in end
    (date,) = re.findall(r"^OnCalendar=(.*) UTC$", end, re.MULTILINE)
    at_s = datetime.fromisoformat(f"{date}+00:00").timestamp()
    assert before_s + 1079 <= at_s <= time.time() + 1080
    assert "\nPersistent=true\n" in end, "a date that passes while the machine is down counts at its next boot"
    rebooted = (tmp_path / "fogspec-rebooted.timer").read_text()
    assert "\nOnBootSec=900\n" in rebooted
    for timer in (end, rebooted):
        assert "\nUnit=fogspec-end.service\n" in timer
        assert "\nWantedBy=timers.target\n" in timer
    assert "\nExecStart=/usr/bin/systemctl poweroff\n" in (tmp_path / "fogspec-end.service").read_text()
    verified(tmp_path)
    assert sky.override is None, "the next launch is another one's"
    sky.commands = None
    api.launch(sample_task(1), NAME, "/")
    assert first_boot(sky, tmp_path, enable=1)[-1] == "systemd-run --on-boot=360 systemctl poweroff", (
        "if units are refused"
    )


def test_a_deployment_without_an_end_on_aws_turns_off_after_a_reboot_alone(api: Any, sky: Sky, tmp_path: Path) -> None:
    api.launch(sample_task(wait_for="jobs"), NAME, "/")
    assert first_boot(sky, tmp_path) == ["systemctl enable fogspec-rebooted.timer"]
    assert not (tmp_path / "fogspec-end.timer").exists()
    verified(tmp_path)


@pytest.mark.parametrize("setup", [None, "bash setup.sh"])
def test_a_machine_on_google_cloud_turns_itself_off_from_its_set_up_on(
    api: Any, sky: Sky, tmp_path: Path, setup: str | None
) -> None:
    """Where its login has expired, or it was rebooted, nothing else ends it."""
    task = sample_task(infra="gcp/r1") | ({} if setup is None else {"setup": setup})
    api.launch(task, NAME, "/")
    command, _, theirs = sky.task["setup"].partition("\n")
    assert theirs == (setup or "")
    assert command.endswith("| sudo -n sh || echo 'this machine does not turn itself off' >&2")
    assert run_script(command, tmp_path) == [
        "systemctl enable fogspec-rebooted.timer", "systemctl enable --now fogspec-end.timer",
    ]  # fmt: skip
    assert "\nOnBootSec=1080\n" in (tmp_path / "fogspec-end.timer").read_text()
    verified(tmp_path)
    (tmp_path / "later").mkdir()
    api.launch(sample_task(infra="gcp/r1", wait_for="jobs"), NAME, "/")
    command = sky.task["setup"].partition("\n")[0]
    assert run_script(command, tmp_path / "later") == ["systemctl enable fogspec-rebooted.timer"]


IN_A_CONTAINER = {"infra": "gcp/r1", "image_id": "docker:ros:jazzy"}


@pytest.mark.parametrize(
    "resources", [{"infra": "azure/r1"}, {"infra": "lambda"}, IN_A_CONTAINER, {"infra": "slurm"}, {}]
)
def test_other_machines_have_no_such_timer(api: Any, sky: Sky, resources: dict[str, Any]) -> None:
    """Elsewhere one that has turned itself off is paid as before, and a container cannot."""
    api.launch({"run": "x", "resources": resources}, NAME, "/")
    assert "setup" not in sky.task
    assert "post_provision_runcmd" not in sky.configured["aws"]


@pytest.mark.parametrize("cloud", ["aws", "gcp", "azure", "lambda"])
def test_no_machine_gets_the_credentials_of_another_cloud(api: Any, sky: Sky, cloud: str) -> None:
    api.launch(sample_task(infra=f"{cloud}/r1"), NAME, "/")
    kept = {name for name, of in sky.configured.items() if of.get("remote_identity") == "NO_UPLOAD"}
    assert kept == {"aws", "gcp", "azure"} - {cloud}
    assert sky.override is None, "the next launch is another one's"


# Access


def test_clouds_that_are_enabled_are_not_checked_once_more(api: Any, sky: Sky) -> None:
    assert api.denied(["aws", "kubernetes"]) == []
    assert api.denied([]) == []
    assert sky.names() == ["enabled_clouds"]


def test_only_what_is_not_enabled_is_checked(api: Any, sky: Sky) -> None:
    sky.to_find = ["GCP"]
    assert api.denied(["aws", "gcp", "azure"]) == ["azure"]
    assert sky.calls[1] == ("check", ("gcp", "azure"), False)
