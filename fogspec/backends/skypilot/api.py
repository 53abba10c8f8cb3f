"""The operations on SkyPilot's public Python API, one function each. Each may block; only the worker calls them.

https://docs.skypilot.co/en/latest/reference/api.html. No operation touches a machine whose name lacks the prefix.
"""

import contextlib
import io
import os
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import sky
from sky import exceptions
from sky.client import sdk  # `sky.check` is a module

from fogspec.backends.skypilot import secrets_file
from fogspec.backends.skypilot.errors import CloudProblem, classify
from fogspec.backends.skypilot.internals import await_gone, launch_settings, with_own_end
from fogspec.base.project_files import ProjectFiles

PREFIX = "fogspec-"
LAUNCHES = ("launch", "sky.launch")
SYSTEM = "skypilot-system"  # the user of the API server's own requests
UNFINISHED = ("PENDING", "RUNNING")
SETTLE_S = 5.0  # for a launch request that is still in flight


def hello() -> dict[str, Any]:
    """Return SkyPilot's version; a local API server is started if none runs."""
    sky.get(sky.status([PREFIX + "none"]))
    return {"version": sky.__version__}


def serves() -> bool:
    """Return whether an API server runs, also one that does not answer; none is started."""
    try:
        sky.api_info()
    except Exception as problem:
        cause: BaseException | None = problem  # that of `requests`, because of that of urllib3, because of the system's
        while cause is not None and not isinstance(cause, ConnectionRefusedError):
            cause = cause.__cause__ or cause.__context__
        return cause is None
    return True


def end_server() -> None:
    """End the API server on this computer, unless it has requests of others than itself."""
    if all(one.user_id == SYSTEM for one in sky.api_status(all_status=False)):
        sky.api_stop()


def denied(clouds: Sequence[str]) -> list[str]:
    """Return the clouds, by SkyPilot's names, to which it has no access; those it does not know of are checked first."""
    left = _not_enabled(clouds)
    if left:
        sky.get(sdk.check(tuple(left), verbose=False))
    return _not_enabled(left)


def _not_enabled(clouds: Sequence[str]) -> list[str]:
    enabled = {str(one).lower() for one in sky.get(sdk.enabled_clouds())} if clouds else set[str]()
    return [one for one in clouds if one.lower() not in enabled]


def infras() -> list[str]:
    """Return the places that SkyPilot has access to, with the names of contexts, node pools and Slurm clusters."""
    return [str(one) for one in sky.get(sdk.enabled_clouds(expand=True))]


def launch(task: Mapping[str, Any], name: str, root: str) -> dict[str, Any]:
    """Request the task on a new machine of this name; return the request's id."""
    given = with_own_end(_with_secrets(_absolute(task, Path(root)), _ours(name)))
    try:
        wanted = sky.Task.from_yaml_config(given)
        _afford(wanted, task)
        with launch_settings(task):
            return {"request": str(sky.launch(wanted, cluster_name=name))}
    except BaseException:
        secrets_file.forget(name)
        raise


def _with_secrets(task: dict[str, Any], name: str) -> dict[str, Any]:
    """Return the task with its secrets in a file, except those that SkyPilot itself needs."""
    secrets = secrets_file.values(task.pop("secrets", None) or ())
    if own := {one: value for one, value in secrets.items() if one.startswith(secrets_file.SKYPILOTS)}:
        task["secrets"] = own
    if handed := {one: value for one, value in secrets.items() if one not in own}:
        file = secrets_file.write(name, handed)
        task["file_mounts"] = {**(task.get("file_mounts") or {}), secrets_file.THERE: str(file)}
    return task


def _absolute(task: Mapping[str, Any], root: Path) -> dict[str, Any]:
    """Return the task with absolute paths."""
    whole = dict(task)
    if isinstance(whole.get("workdir"), str):
        whole["workdir"] = str(root / whole["workdir"])
    mounts = whole.get("file_mounts")
    if isinstance(mounts, Mapping):
        whole["file_mounts"] = {to: _source(source, root) for to, source in mounts.items()}
    return whole


def _source(source: object, root: Path) -> object:
    if not isinstance(source, str) or "://" in source:
        return source
    return str(root / os.path.expanduser(source))


def _afford(wanted: Any, task: Mapping[str, Any]) -> None:
    """Check `max_hourly_cost`, which SkyPilot ignores for a named machine; raise CloudProblem."""
    resources = task.get("resources")
    most = resources.get("max_hourly_cost") if isinstance(resources, Mapping) else None
    if most is None:
        return
    for one in wanted.resources:
        price = None
        with contextlib.suppress(Exception):  # no price is known here: the plan's price stands
            price = one.get_cost(3600)
        if price is not None and price > float(most) * (1 + 1e-6):
            raise CloudProblem(
                "budget", f"it costs ${price:g} per hour now, and the task allows ${float(most):g}", refused=True
            )


def launched(request: str, name: str) -> dict[str, Any] | None:
    """Return the launch's job; None while it runs. Raise the error that it failed with."""
    found = sky.api_status([request], all_status=True)
    if not found:
        # A restarted API server has forgotten it, and the machine may still be up.
        if (job := _job_of(name)) is None:
            raise CloudProblem(
                "setup", "SkyPilot's API server does not know this launch any more", again=True, gone=True
            )
        secrets_file.forget(name)
        return {"job": job}
    if _word(found[0].status) in UNFINISHED:
        return None
    secrets_file.forget(name)
    try:
        answer: Any = sky.get(cast(Any, request))
    except Exception as problem:
        raise classify(problem, _log_of(request)) from problem
    return {"job": answer[0]}


def _log_of(request: str) -> str:
    """Return what SkyPilot logged of a request; nothing if it cannot be read."""
    file = io.StringIO()
    with contextlib.suppress(Exception):  # the request has failed, and with what is known without its log
        sky.stream_and_get(cast(Any, request), follow=False, output_stream=file)
    return file.getvalue()


def find(name: str) -> dict[str, Any] | None:
    """Return the machine's last launch that the API server knows, or its job; None if there is neither."""
    if launches := _launches(name, finished=True):
        return {"request": launches[0].request_id}
    return None if (job := _job_of(name)) is None else {"job": job}


def _job_of(name: str) -> int | None:
    try:
        rows = jobs(name)
    except (exceptions.ClusterDoesNotExist, exceptions.ClusterNotUpError):
        return None
    return rows[0]["job"] if rows else None


def _launches(name: str, finished: bool) -> list[Any]:
    """Return the launch requests of this machine, newest first."""
    asked = sky.api_status(cluster_name=_ours(name), all_status=finished)
    found = [one for one in asked if one.cluster_name == name and one.name in LAUNCHES]
    return sorted(found, key=lambda one: -float(one.created_at))


def jobs(name: str) -> list[dict[str, Any]]:
    """Return the machine's jobs, newest first, with their times in seconds since the epoch."""
    records = sky.get(sky.queue(_ours(name), all_users=True))
    rows = [
        {
            "job": one["job_id"],
            "status": _word(one["status"]),
            "submitted_at": one["submitted_at"],
            "start_at": one["start_at"],
            "end_at": one["end_at"],
        }
        for one in records
    ]
    return sorted(rows, key=lambda row: -int(row["job"]))


def log(name: str, job: int, root: str, path: str, limit: int, follow: bool = False, tail: int = 0) -> int:
    """Write a job's log so far, or to its end, to `path` below `root`; return the bytes written.

    `limit` is the most bytes to write; `tail` limits the log to so many last lines.
    """
    written, name = 0, _ours(name)
    with ProjectFiles(Path(root)).create(Path(path)) as file:
        for chunk in sky.tail_logs(name, job, follow=follow, tail=tail, preload_content=False):
            if written >= limit:
                break
            if chunk is None:  # a heartbeat
                continue
            data = chunk.encode("utf-8", "replace")[: limit - written]
            written += len(data)
            file.write(data)
            file.flush()
    return written


def clusters(prefix: str = PREFIX, names: Sequence[str] | None = None, refresh: bool = False) -> list[dict[str, Any]]:
    """Return the machines that SkyPilot knows; with `refresh` by their cloud's own state."""
    _ours(prefix)
    mode = sky.StatusRefreshMode.FORCE if refresh else sky.StatusRefreshMode.NONE
    records = sky.get(sky.status(list(names) if names is not None else None, refresh=mode, all_users=True))
    return [_cluster(one) for one in records if one["name"].startswith(prefix)]


def waiting(prefix: str = PREFIX) -> list[str]:
    """Return the names of machines whose launch is running or queued."""
    _ours(prefix)
    asked = sky.api_status(all_status=False)
    names = [str(one.cluster_name) for one in asked if one.name in LAUNCHES and one.cluster_name]
    return [name for name in dict.fromkeys(names) if name.startswith(prefix)]


def end(name: str) -> int | None:
    """Cancel its launch, take it down, and verify with its cloud that it is gone.

    Return how many machines of this name the cloud had, or None if it does not list those that have ended: SkyPilot starts
    another in the next zone if it does not see the first, which is paid too.

    If SkyPilot does not know it, check again after SETTLE_S: the launch request may still be in flight.
    """
    secrets_file.forget(_ours(name))
    known, machines = _end(name)
    if not known:
        time.sleep(SETTLE_S)
        found = _end(name)[1]
        machines = found if machines is None else max(machines, found or 0)
    return machines


def _end(name: str) -> tuple[bool, int | None]:
    """Return whether SkyPilot knew the machine, or a launch of it, and how many the cloud had; None if that is unknown."""
    asked = _launches(name, finished=True)
    if pending := [one.request_id for one in asked if _word(one.status) in UNFINISHED]:
        sky.get(sky.api_cancel(pending, silent=True))
    launched_until_s = time.time() if pending else _launched_until_s(asked)
    known = bool(asked)
    with contextlib.suppress(exceptions.ClusterDoesNotExist):
        sky.get(sky.down(_ours(name)))
        known = True
    if _launches(name, finished=False) or clusters(names=[name], refresh=True):
        raise CloudProblem("setup", f"{name} is still there", again=True)
    return known, await_gone(name, launched_until_s)


def _launched_until_s(asked: Sequence[Any]) -> float | None:
    """Return when a launch was last in progress, in seconds since the epoch; None if the newest has succeeded.

    An API server that was restarted since has forgotten when it ended: it may have been cut off just now.
    """
    if asked and _word(asked[0].status) == "SUCCEEDED":
        return None
    return float((getattr(asked[0], "finished_at", None) if asked else None) or time.time())


def autostop(name: str, idle_minutes: int, down: bool = True) -> None:
    """Let the machine terminate itself after it was idle for so long."""
    sky.get(sky.autostop(_ours(name), idle_minutes=idle_minutes, down=down))


def _cluster(record: Any) -> dict[str, Any]:
    handle = record["handle"]
    resources = getattr(handle, "launched_resources", None)
    infra = getattr(resources, "infra", None)
    return {
        "name": record["name"],
        "status": _word(record["status"]),
        "infra": infra.to_str() if infra is not None else None,
        "instance": getattr(resources, "instance_type", None),
        "price_usd_per_hour": _price(handle),
        "launched_at": record["launched_at"],
        "ip": _address(handle),
        "labels": dict(getattr(resources, "labels", None) or {}),
    }


def _address(handle: Any) -> str | None:
    """Return the machine's own address; on Slurm SkyPilot's `head_ip` is that of the login node."""
    if type(getattr(getattr(handle, "launched_resources", None), "cloud", None)).__name__ == "Slurm":
        addresses = getattr(handle, "stable_internal_external_ips", None)
        return addresses[0][0] if addresses else None
    return getattr(handle, "head_ip", None)


def _price(handle: Any) -> float | None:
    with contextlib.suppress(Exception):  # handles of machines that were never up have no price
        return float(handle.launched_resources.get_cost(3600))
    return None


def _ours(name: str) -> str:
    if not name.startswith(PREFIX):
        raise ValueError(f"{name} does not begin with {PREFIX}: it is not ours")
    return name


def _word(status: Any) -> str:
    return str(getattr(status, "value", status))


OPERATIONS: Mapping[str, Callable[..., Any]] = {
    one.__name__: one
    for one in (
        hello,
        serves,
        end_server,
        denied,
        infras,
        launch,
        launched,
        find,
        jobs,
        log,
        clusters,
        waiting,
        end,
        autostop,
    )
}
