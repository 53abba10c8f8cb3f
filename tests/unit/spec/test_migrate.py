"""Migration: edits in place, step by step, and a clear no where no step leads on."""

from pathlib import Path

import pytest

from fogspec.base.diagnostics import DiagnosticError
from fogspec.cli import main
from fogspec.spec.migrate import Step, migrate, write

OLD = """\
# my robot
apiVersion: example.dev/v1   # the first one
kind: Application
spec:
  clouds:      # what moves
    - {package: "a", executable: b}   # keep: 'this'
  limits: {latency: 2s}
---
kind: Application
apiVersion: example.dev/v2
spec: {cloud: []}
"""
STEPS = (
    Step("example.dev/v1", "example.dev/v2", {"spec.clouds": "cloud"}),
    Step("example.dev/v2", "example.dev/v3", {"spec.limits": "constraints"}),
)
ROOT = Path(__file__).resolve().parents[3]


def test_every_document_goes_step_by_step_and_everything_else_stays(tmp_path):
    path = tmp_path / "spec.yaml"
    path.write_text(OLD)
    found = migrate(str(path), STEPS, "example.dev/v3")
    expected = (
        OLD.replace("v1 ", "v3 ").replace("v2", "v3").replace("clouds:", "cloud:").replace("limits:", "constraints:")
    )
    assert found.text == expected
    assert path.read_text() == OLD
    write(found)
    assert path.read_text() == expected
    assert not migrate(str(path), STEPS, "example.dev/v3").changed


def test_a_version_without_a_step_is_a_located_mistake(tmp_path):
    path = tmp_path / "spec.yaml"
    path.write_text(OLD.replace("example.dev/v2", "example.dev/v9"))
    with pytest.raises(DiagnosticError) as no:
        migrate(str(path), STEPS, "example.dev/v3")
    [one] = no.value.diagnostics
    assert (one.code, one.place.line) == ("FS307", 10)


def test_the_shipped_specs_are_at_the_newest_version(capsys):
    before = {path: path.read_bytes() for path in (ROOT / "specs").glob("*.yaml")}
    with pytest.raises(SystemExit) as end:
        main(["migrate", str(ROOT / "specs"), "--check"])
    assert end.value.code == 0
    assert "nothing to do" in capsys.readouterr().out
    assert before == {path: path.read_bytes() for path in before}
