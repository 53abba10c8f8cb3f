"""An application gets another name by moving its files: what was measured counts, and the same machine is chosen."""

import json

from ruamel.yaml import YAML

from tests.support.running import Shell, measure, project, shell  # noqa: F401

AT = ("--catalog", "offers.csv")


def test_a_renamed_spec_keeps_its_measurements(shell: Shell) -> None:
    project(shell)
    measure(shell)
    shell("compile", *AT)
    before = YAML(typ="safe", pure=True).load(shell.read("compiled/demo/manifest.yaml"))
    for name in ("specs/demo.yaml", "results/demo", "compiled/demo"):
        path = shell.folder / name
        path.rename(path.with_name(path.name.replace("demo", "arm")))
    shell.write("specs/arm.yaml", shell.read("specs/arm.yaml").replace("name: demo", "name: arm"))
    (found,) = json.loads(shell("status", "-o", "json").out)
    assert {one["name"]: one["state"] for one in found["stages"]}["results"] == "fresh"
    assert "no benchmark needed" in shell("diff").out
    shell("compile", *AT)
    shell("check")
    after = YAML(typ="safe", pure=True).load(shell.read("compiled/arm/manifest.yaml"))
    assert after["metadata"] == {"name": "arm"}
    assert after["evidence"] == before["evidence"]
    assert after["expected"] == before["expected"]
    assert "demo" not in shell.read("compiled/arm/manifest.yaml")
