"""Reads tasks as SkyPilot does, in a process of its own: one line of JSON a task. `python sky_reads_tasks.py TASK...`."""

import copy
import json
import sys

import jsonschema
import sky
import yaml
from sky.provision.kubernetes import utils as kubernetes_utils
from sky.provision.slurm import instance as slurm_instance
from sky.skylet import constants
from sky.utils import schemas

validator = jsonschema.Draft202012Validator(schemas.get_task_schema())
resources_validator = jsonschema.Draft202012Validator(schemas.get_resources_schema())
for path in sys.argv[1:]:
    with open(path, encoding="utf-8") as file:
        data = yaml.safe_load(file)
    wrong = [f"{error.json_path} {error.message}" for error in validator.iter_errors(data)]
    wrong += [
        f"resources{error.json_path[1:]} {error.message}"
        for error in resources_validator.iter_errors(data["resources"])
    ]
    secrets = dict.fromkeys(data.get("secrets", {}), "x")
    given = [(name, "x") for name in data.get("envs", {})]  # set at launch
    task = sky.Task.from_yaml_config(copy.deepcopy(data), given)
    task.update_secrets(secrets)
    task.validate()
    (one,) = task.resources
    one.validate()
    autostop = one.autostop_config
    limits = one.cluster_config_overrides
    # Each limit passes the checks that SkyPilot makes of it while it provisions, and all keys may be set by a task.
    if options := limits.get("slurm", {}).get("sbatch_options"):
        directives = slurm_instance._build_custom_sbatch_directives(options).split()
    else:
        directives = []
    pod = limits.get("kubernetes", {}).get("pod_config")
    # It is checked as part of the whole pod.
    containers = {"containers": [{"name": "ray-node", "image": "x"}]}
    pod_problem = None if pod is None else kubernetes_utils.check_pod_config({"spec": {**pod["spec"], **containers}})[1]
    allowed = all(
        any(key[:2] == (cloud, name) for key in constants.OVERRIDEABLE_CONFIG_KEYS_IN_TASK)
        for cloud, settings in limits.items() for name in settings
    )  # fmt: skip
    print(json.dumps({
        "path": path, "wrong": wrong, "server_access": task.api_server_access,
        "name": task.name, "infra": one.infra.to_str(), "instance": one.instance_type,
        "shape": [one.cpus, one.memory], "disk": one.disk_size,
        "accelerators": one.accelerators, "spot": one.use_spot, "image": one.image_id, "labels": one.labels,
        "price": one.get_cost(3600) if one.instance_type else None, "same_run": task.run == data["run"],
        "limits": limits, "directives": directives, "pod_problem": pod_problem, "allowed": allowed,
        "autostop": [autostop.idle_minutes, autostop.down, autostop.wait_for.value if autostop.wait_for else None],
    }))  # fmt: skip
