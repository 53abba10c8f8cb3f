"""What fogspec needs of SkyPilot and its public Python API lacks; nothing else uses SkyPilot's own modules.

Three things. A contract test holds them for every supported version (`tests/contract/sky_has_calls.py`).

Whether a cloud has, or had, a machine that SkyPilot has forgotten, and to terminate it. `sky.down` removes its record once the
cloud has accepted the request, and does not verify the result: in 0.14.1 the check in
`CloudVmRayBackend.post_teardown_cleanup` needs the record's configuration, which is removed just before. The public API cannot
query a machine without a record, but its configuration stays in the API server's database. A launch that was cut off may leave
a machine that the cloud does not list yet.

Timers, set by a machine's first boot, or else its set-up, that turn it off: an end without any supervisor, which a reboot does
not undo. SkyPilot arms autostop once a machine has booted and has its files. Until then, only what the cloud does with the
machine's user data can end it. On AWS SkyPilot adds the commands of `aws.post_provision_runcmd` to the user data. A task cannot
set them; the client's configuration can, which goes along with each request.

Credentials that stay here. SkyPilot copies to each machine those of all clouds that this computer has, not only of the
machine's own, with which it ends itself (0.14.1: `check.get_cloud_credential_file_mounts`). The same configuration keeps
back those of each cloud for which its schema knows `remote_identity`.
"""

import base64
import contextlib
import threading
import time
from collections.abc import Iterator, Mapping
from typing import Any

from sky import global_user_state, provision, skypilot_config
from sky.utils import schemas

from fogspec.backends.skypilot.errors import CloudProblem
from fogspec.base.clouds import OwnEnd, cloud_of
from fogspec.plan.commitment import power_off_s

TIMEOUT_S = 90.0
POLL_S = 1.0
KEYS = ("aws", "post_provision_runcmd")
REMOTE_IDENTITY = "remote_identity"
ONE_FILE = ("kubernetes", "ssh")  # both have their credentials in one file
REBOOTED_S = 900.0  # time to log in to a machine that one has rebooted
# Of a machine's first boot, or the begin of its set-up. Its units stay on its disk: nothing starts job, skylet and autostop
# again after a reboot, so that a machine which no one uses would be paid until somebody looks. The date holds after a reboot,
# and the time since the boot where the clock was wrong.
FIRST_BOOT = """\
units=/etc/systemd/system
unit() { printf '%s\\n' '[Unit]' 'Description=fogspec ends this machine' "$@" >"$units/$unit"; }
unit=fogspec-end.service
unit '[Service]' Type=oneshot 'ExecStart=/usr/bin/systemctl poweroff'
timer() { unit '[Timer]' "$@" Unit=fogspec-end.service '[Install]' WantedBy=timers.target && systemctl daemon-reload; }
unit=fogspec-rebooted.timer
timer OnBootSec=@REBOOTED_S@ && systemctl enable "$unit"
seconds=@SECONDS@
[ -n "$seconds" ] || exit 0
unit=fogspec-end.timer
date=$(date -u -d "+$seconds seconds" '+%Y-%m-%d %H:%M:%S UTC')
if timer "OnBootSec=$seconds" "OnCalendar=$date" Persistent=true && systemctl enable --now "$unit"; then exit 0; fi
systemd-run "--on-boot=$seconds" systemctl poweroff
"""
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
def launch_settings(task: Mapping[str, Any]) -> Iterator[None]:
    """Within this, requests to launch the task give its machine no credentials of other clouds, and an end of its own.

    Where it can be turned off by itself, that is when its longest time is over, or after a reboot.
    """
    cloud = cloud_of(str((task.get("resources") or {}).get("infra", "")))
    settings: dict[str, dict[str, Any]] = {name: {REMOTE_IDENTITY: "NO_UPLOAD"} for name in _others(cloud.name)}
    with _LOCK:
        if cloud.own_end is OwnEnd.POWER_OFF:
            theirs = skypilot_config.get_nested(KEYS, default_value=None) or []
            settings[KEYS[0]] = {KEYS[1]: [_first_boot(power_off_s(task)), *theirs]}
        with skypilot_config.override_skypilot_config(settings):
            yield


def with_own_end(task: dict[str, Any]) -> dict[str, Any]:
    """Return the task with a set-up that begins with those timers, where user data cannot; in a container nothing can."""
    resources = task.get("resources") or {}
    cloud = cloud_of(str(resources.get("infra", "")))
    if not cloud.halts or cloud.own_end is OwnEnd.POWER_OFF or resources.get("image_id"):
        return task
    armed = f"{_first_boot(power_off_s(task), 'sudo -n sh')} || echo 'this machine does not turn itself off' >&2"
    return {**task, "setup": f"{armed}\n{task.get('setup') or ''}"}


def _others(cloud: str) -> Iterator[str]:
    """Yield the other clouds whose credentials SkyPilot keeps back where a setting says so."""
    own = ONE_FILE if cloud in ONE_FILE else (cloud,)
    for name, schema in schemas.get_config_schema()["properties"].items():
        if name not in own and REMOTE_IDENTITY in schema.get("properties", {}):
            yield name


def _first_boot(seconds: float | None, shell: str = "sh") -> str:
    """Return the command that turns a machine off so long after it ran (None: never), and after each later boot.

    SkyPilot writes it into YAML as it stands: it has no character that means something there.
    """
    script = FIRST_BOOT.replace("@REBOOTED_S@", f"{REBOOTED_S:.0f}")
    script = script.replace("@SECONDS@", "" if seconds is None else f"{seconds:.0f}")
    return f"echo {base64.b64encode(script.encode()).decode()} | base64 -d | {shell}"
