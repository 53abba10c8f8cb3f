"""A timer, set by a machine's first boot, that turns it off: an end without any supervisor.

SkyPilot arms autostop once a machine has booted and has its files. Until then, only what the cloud does with the machine's user
data can end it. On AWS SkyPilot adds the commands of `aws.post_provision_runcmd` to the user data. A task cannot set them;
the client's configuration can, which goes along with each request.
"""

import contextlib
import threading
from collections.abc import Iterator, Mapping
from typing import Any

from sky import skypilot_config

from fogspec.base.clouds import OwnEnd, cloud_of
from fogspec.plan.commitment import machine_s

KEYS = ("aws", "post_provision_runcmd")
_LOCK = threading.Lock()  # the configuration is the whole process's


@contextlib.contextmanager
def power_off_armed(task: Mapping[str, Any]) -> Iterator[None]:
    """Within this, requests to launch the task turn its machine off when its longest time is over, if it has one."""
    seconds = _seconds(task)
    if seconds is None:
        yield
        return
    command = f"systemd-run --on-boot={seconds:.0f} systemctl poweroff"
    with _LOCK:
        theirs = skypilot_config.get_nested(KEYS, default_value=None) or []
        with skypilot_config.override_skypilot_config({KEYS[0]: {KEYS[1]: [command, *theirs]}}):
            yield


def _seconds(task: Mapping[str, Any]) -> float | None:
    """Return how long after its first boot the machine is turned off: after autostop, which ends it for good."""
    resources = task.get("resources") or {}
    autostop = resources.get("autostop") or {}
    if cloud_of(str(resources.get("infra", ""))).own_end is not OwnEnd.POWER_OFF or autostop.get("wait_for") != "none":
        return None
    return machine_s(float(autostop["idle_minutes"]) * 60)
