"""Servers that cannot be: each is a located error that says what can be, and nothing is written."""

import pytest

from tests.support.running import CATALOG, Shell, shell  # noqa: F401

SPEC = """apiVersion: fogspec.dev/v1alpha1
kind: Application
metadata: {{name: demo}}
spec:
  cloud: [{{cmd: [./node]}}]
  probe: {{callback: plan}}
  hardware: {{cpus: 2..64}}
  infra: [aws]
  benchmark:
    budget: $5
    stop: {{duration: 1min}}
    {field}
"""


@pytest.mark.parametrize(
    ("field", "said"),
    [
        ("servers: 0", "spec.benchmark.servers must be at least 1"),
        ("servers: -1", "spec.benchmark.servers must be at least 1"),
        ("servers: 7", "spec.benchmark.servers must be at most 6"),
        ("servers: 1.5", "spec.benchmark.servers must be an integer"),
    ],
)
def test_what_cannot_be_is_an_error_at_its_place(shell: Shell, field: str, said: str) -> None:
    shell.write("offers.csv", CATALOG)
    shell.write("specs/demo.yaml", SPEC.format(field=field))
    for command in ("validate", "compile"):
        ended = shell(command, "specs/demo.yaml", code=1)
        assert said in ended.err + ended.out
        assert "--> specs/demo.yaml:12:" in ended.err + ended.out
    assert not (shell.folder / "compiled").exists()
