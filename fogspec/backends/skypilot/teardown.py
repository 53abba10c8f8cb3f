"""Wait until a cloud has terminated a machine that SkyPilot has forgotten.

`sky.down` removes its record once the cloud has accepted the request, and does not verify the result: in 0.14.1 the check in
`CloudVmRayBackend.post_teardown_cleanup` needs the record's configuration, which is removed just before. The public API cannot
query a machine without a record, but its configuration stays in the API server's database.
"""

import time
from collections.abc import Mapping
from typing import Any

from sky import global_user_state, provision

from fogspec.backends.skypilot.errors import CloudProblem

TIMEOUT_S = 90.0
POLL_S = 1.0


def await_gone(name: str) -> None:
    """Poll the cloud until it has no such machine; raise CloudProblem if it still has one after `TIMEOUT_S`.

    If the API server is on another host, its database cannot be read, and the result of `sky.down` stands.
    """
    if (config := _config_of(name)) is None:
        return
    end_s = time.monotonic() + TIMEOUT_S
    while found := _instances(name, config):
        if time.monotonic() > end_s:
            raise CloudProblem("setup", f"{name} was ended, and its cloud still has {', '.join(found)}", again=True)
        time.sleep(POLL_S)


def _config_of(name: str) -> Mapping[str, Any] | None:
    """Return the configuration from which a machine was provisioned; None if there is none."""
    try:
        config: Mapping[str, Any] = global_user_state.get_cluster_yaml_dict(f"{name}.yml")
    except ValueError:  # it was never provisioned, or the database is elsewhere
        return None
    return config


def _instances(name: str, config: Mapping[str, Any]) -> list[str]:
    """Return the names of the machines that the cloud has not terminated."""
    provider = config["provider"]
    module = str(provider["module"]).rpartition(".")[2]
    states = provision.query_instances(module, name, config["cluster_name"], provider, non_terminated_only=True)
    return sorted(one for one, (status, _) in states.items() if status is not None)
