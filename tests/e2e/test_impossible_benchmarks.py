"""Volumes, servers and shapes that cannot be: each is a located error that says what can be, and nothing is written."""

import pytest

from tests.support.running import CATALOG, Shell, shell  # noqa: F401

SPEC = """apiVersion: fogspec.dev/v1alpha1
kind: Application
metadata: {{name: demo}}
spec:
  cloud: [{{cmd: [./node]}}]
  probe: {{callback: plan}}
  hardware: {{cpus: 2..64{gpus}}}
  infra: [aws]
  benchmark:
    budget: $5
    stop: {{duration: 1min}}
    {field}
"""


@pytest.mark.parametrize(
    ("field", "gpus", "said"),
    [
        ("volume: {requests_per_month: 0}", "", "spec.benchmark.volume.requests_per_month must be more than 0"),
        ("volume: {requests_per_month: -5}", "", "spec.benchmark.volume.requests_per_month must be more than 0"),
        ("volume: {requests_per_month: 1e16}", "", "spec.benchmark.volume.requests_per_month must be at most 1e+15"),
        ("volume: {requests_per_month: .inf}", "", "a number must be finite"),
        ("volume: {requests_per_month: .nan}", "", "a number must be finite"),
        ("volume: {requests_per_month: many}", "", "spec.benchmark.volume.requests_per_month must be a number"),
        ("volume: {months: 6}", "", "spec.benchmark.volume.requests_per_month is missing"),
        ("volume: {requests_per_month: 100, months: 0}", "", "spec.benchmark.volume.months must be more than 0"),
        ("volume: {requests_per_month: 100, months: 1e300}", "", "spec.benchmark.volume.months must be at most 1200"),
        ("servers: 0", "", "spec.benchmark.servers must be at least 1"),
        ("servers: -1", "", "spec.benchmark.servers must be at least 1"),
        ("servers: 7", "", "spec.benchmark.servers must be at most 6"),
        ("servers: 1.5", "", "spec.benchmark.servers must be an integer"),
        ("shapes: quarter", "", "spec.benchmark.shapes must be"),
        ("shapes: nested", ", gpus: [T4]", "a T4 cannot be halved"),
    ],
)
def test_what_cannot_be_is_an_error_at_its_place(shell: Shell, field: str, gpus: str, said: str) -> None:
    shell.write("offers.csv", CATALOG)
    shell.write("specs/demo.yaml", SPEC.format(field=field, gpus=gpus))
    for command in ("validate", "compile"):
        ended = shell(command, "specs/demo.yaml", code=1)
        assert said in ended.err + ended.out
        assert "--> specs/demo.yaml:12:" in ended.err + ended.out
    assert not (shell.folder / "compiled").exists()
