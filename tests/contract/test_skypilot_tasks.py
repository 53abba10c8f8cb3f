"""Every committed task is one that the installed SkyPilot accepts."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
TASKS = sorted(ROOT.glob("compiled/*/tasks/*.sky.yaml")) + sorted(ROOT.glob("compiled/*/deploy.sky.yaml"))
CHECK = """
import sys
import jsonschema
from ruamel.yaml import YAML
from sky.utils import schemas
validator = jsonschema.Draft202012Validator(schemas.get_task_schema())
resources = jsonschema.Draft202012Validator(schemas.get_resources_schema())
for path in sys.argv[1:]:
    task = YAML(typ="safe", pure=True).load(open(path))
    for one in (validator.iter_errors(task), resources.iter_errors(task["resources"])):
        for error in one:
            print(path, error.json_path, error.message)
"""


def test_tasks_match_the_schema_of_skypilot(tmp_path):
    assert TASKS
    environment = os.environ | {"HOME": str(tmp_path), "SKYPILOT_DISABLE_LOCAL_API_SERVER": "1",
                                "SKYPILOT_DISABLE_USAGE_COLLECTION": "1"}  # fmt: skip
    try:
        subprocess.run([sys.executable, "-c", "import sky"], check=True, capture_output=True, env=environment)
    except subprocess.CalledProcessError:
        pytest.skip("needs SkyPilot: pip install 'fogspec[sky]'")
    ended = subprocess.run([sys.executable, "-c", CHECK, *map(str, TASKS)], capture_output=True, text=True,
                           env=environment, cwd=ROOT, timeout=120)  # fmt: skip
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout == ""
