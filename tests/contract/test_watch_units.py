"""The systemd unit and the CronJob of docs/howto/watch.md, read by systemd and by Kubernetes' own types."""

import json
import re
import shutil
import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest
from ruamel.yaml import YAML

PAGE = (Path(__file__).resolve().parents[2] / "docs/howto/watch.md").read_text()


def block(kind: str) -> str:
    found = re.findall(rf"```{kind}\b[^\n]*\n(.*?)```", PAGE, re.DOTALL)
    return str(found[-1])


def verified(unit: Path) -> subprocess.CompletedProcess[str]:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("needs systemd-analyze: apt-get install systemd")
    return subprocess.run(
        ["systemd-analyze", "verify", "--recursive-errors=no", str(unit)], capture_output=True, text=True, check=False
    )


def test_systemd_finds_nothing_wrong_with_the_unit(tmp_path: Path) -> None:
    text = block("ini")
    command = re.search(r"^ExecStart=(\S+)", text, re.MULTILINE)
    assert command is not None
    unit = tmp_path / "fogspec-watch.service"
    unit.write_text(text.replace(command[1], "/usr/bin/true").replace("User=robot", "User=root"))
    done = verified(unit)
    assert (done.returncode, done.stderr) == (0, "")
    unit.write_text(unit.read_text().replace("Restart=always", "Restart=allways"))
    assert "allways" in verified(unit).stderr


def test_kubernetes_knows_every_field_of_the_cron_job() -> None:
    from kubernetes import client

    written = YAML(typ="safe", pure=True).load(block("yaml"))
    api = client.ApiClient()
    found = api.deserialize(SimpleNamespace(data=json.dumps(written)), "V1CronJob")
    # What its types do not have is left out, what they require and is absent raises.
    assert api.sanitize_for_serialization(found) == written
    assert found.spec.concurrency_policy == "Forbid"
