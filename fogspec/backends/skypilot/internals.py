"""What fogspec needs of SkyPilot and its public Python API lacks; nothing else uses SkyPilot's own modules.

Two things. A contract test holds them for every supported version (`tests/contract/sky_has_calls.py`).

Whether a cloud has, or had, a machine that SkyPilot has forgotten, and to terminate it. `sky.down` removes its record once the
cloud has accepted the request, and does not verify the result: in 0.14.1 the check in
`CloudVmRayBackend.post_teardown_cleanup` needs the record's configuration, which is removed just before. The public API cannot
query a machine without a record, but its configuration stays in the API server's database. A launch that was cut off may leave
a machine that the cloud does not list yet.

A timer, set by a machine's first boot, that turns it off: an end without any supervisor. SkyPilot arms autostop once a machine
has booted and has its files. Until then, only what the cloud does with the machine's user data can end it. On AWS SkyPilot adds
the commands of `aws.post_provision_runcmd` to the user data. A task cannot set them; the client's configuration can, which goes
along with each request.
"""

import contextlib
import threading
import time
from collections.abc import Iterator, Mapping
from typing import Any

from sky import global_user_state, provision, skypilot_config

from fogspec.backends.skypilot.errors import CloudProblem
from fogspec.base.clouds import cloud_of
from fogspec.plan.commitment import power_off_s

TIMEOUT_S = 90.0
POLL_S = 1.0
KEYS = ("aws", "post_provision_runcmd")
_LOCK = threading.Lock()  # the configuration is the whole process's


def await_gone(name: str, launched_until_s: float | None = None) -> int | None:
    """Poll the cloud until it has no such machine; raise CloudProblem if it still has one after `TIMEOUT_S`.

    Return how many that have ended it lists; None if it never lists any. A launch that did not succeed was last in progress at
    `launched_until_s`, in seconds since the epoch: for a while after that a machine may appear which SkyPilot has not seen, and
    it is terminated here.
    If the API server is on another host, its database cannot be read, and the result of `sky.down` stands.
    """
    if (config := _config_of(name)) is None:
        return None
    provider = config["provider"]
    module = str(provider["module"]).rpartition(".")[2]
    cloud = cloud_of(module)
    visible_s = time.time() if launched_until_s is None else launched_until_s + cloud.visible_s
    end_s = time.monotonic() + TIMEOUT_S
    while True:
        states = provision.query_instances(
            module, name, config["cluster_name"], provider, non_terminated_only=not cloud.lists_ended
        )
        found = sorted(one for one, (status, _) in states.items() if status is not None)
        if not found and time.time() >= visible_s:
            return len(states) if cloud.lists_ended else None
        if found and time.monotonic() > end_s:
            raise CloudProblem("setup", f"{name} was ended, and its cloud still has {', '.join(found)}", again=True)
        if found and cloud.visible_s:
            provision.terminate_instances(module, config["cluster_name"], provider)
        time.sleep(POLL_S)


def _config_of(name: str) -> Mapping[str, Any] | None:
    """Return the configuration from which a machine was provisioned; None if there is none."""
    try:
        config: Mapping[str, Any] = global_user_state.get_cluster_yaml_dict(f"{name}.yml")
    except ValueError:  # it was never provisioned, or the database is elsewhere
        return None
    return config


@contextlib.contextmanager
def power_off_armed(task: Mapping[str, Any]) -> Iterator[None]:
    """Within this, requests to launch the task turn its machine off when its longest time is over, if it has one."""
    seconds = power_off_s(task)
    if seconds is None:
        yield
        return
    command = f"systemd-run --on-boot={seconds:.0f} systemctl poweroff"
    with _LOCK:
        theirs = skypilot_config.get_nested(KEYS, default_value=None) or []
        with skypilot_config.override_skypilot_config({KEYS[0]: {KEYS[1]: [command, *theirs]}}):
            yield
