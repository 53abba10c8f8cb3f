"""Reads tasks as SkyPilot does, in a process of its own: one line of JSON a task. `python sky_reads_tasks.py TASK...`."""

import json
import sys

import jsonschema
import sky
import yaml
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
    task = sky.Task.from_yaml(path)
    task.update_secrets(secrets)
    task.validate()
    (one,) = task.resources
    one.validate()
    autostop = one.autostop_config
    print(json.dumps({
        "path": path, "wrong": wrong, "name": task.name, "infra": one.infra.to_str(), "instance": one.instance_type,
        "shape": [one.cpus, one.memory],
        "accelerators": one.accelerators, "spot": one.use_spot, "image": one.image_id, "labels": one.labels,
        "price": one.get_cost(3600) if one.instance_type else None, "same_run": task.run == data["run"],
        "autostop": [autostop.idle_minutes, autostop.down, autostop.wait_for.value if autostop.wait_for else None],
    }))  # fmt: skip
