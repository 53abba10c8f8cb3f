"""Whether a cloud still has a machine that SkyPilot has forgotten.

`sky.down` takes its record away when the cloud has accepted the order, and does not look whether it was carried out: in 0.14.1
the look in `CloudVmRayBackend.post_teardown_cleanup` needs the record's configuration, which is taken out just before. What has
no record cannot be asked about through the public API; what it was made from stays in the API server's database.
"""

import time
from collections.abc import Mapping
from typing import Any

from sky import global_user_state, provision

from fogspec.backends.skypilot.errors import CloudProblem

PATIENCE_S = 90.0
POLL_S = 1.0


def await_gone(name: str) -> None:
    """Ask the machine's cloud until it has no such machine; raises CloudProblem when it still has one after `PATIENCE_S`.

    Where the API server is on another host, its database cannot be read, and `sky.down` has the last word.
    """
    if (made_from := _made_from(name)) is None:
        return
    end_s = time.monotonic() + PATIENCE_S
    while found := _instances(name, made_from):
        if time.monotonic() > end_s:
            raise CloudProblem("setup", f"{name} was ended, and its cloud still has {', '.join(found)}", again=True)
        time.sleep(POLL_S)


def _made_from(name: str) -> Mapping[str, Any] | None:
    try:
        made_from: Mapping[str, Any] = global_user_state.get_cluster_yaml_dict(f"{name}.yml")
    except ValueError:  # it never got so far, or the database is elsewhere
        return None
    return made_from


def _instances(name: str, made_from: Mapping[str, Any]) -> list[str]:
    """Names of the machines that are not ended, as the cloud has them."""
    config = made_from["provider"]
    provider = str(config["module"]).rpartition(".")[2]
    states = provision.query_instances(provider, name, made_from["cluster_name"], config, non_terminated_only=True)
    return sorted(one for one, (status, _) in states.items() if status is not None)
