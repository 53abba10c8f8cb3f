"""`benchmark.shapes: nested` as a user runs it: a machine, then its parts, in one task, and what is said of them."""

import pytest

from fogspec.base import digest
from fogspec.plan.schema import Plan
from fogspec.results.schema import (
    LatencySummary,
    Measured,
    NestedIn,
    Results,
    ResultsBody,
    checksum_ok,
    with_checksum,
)
from fogspec.spec import fingerprints
from fogspec.spec.loader import load, read_document
from tests.support.files import write_yaml
from tests.support.scenes import SPEC, Scene

NESTED = SPEC.replace(
    "    machines: [local/1cpu-1gib, local/2cpu-1gib]", "    machines: [local/2cpu-2gib]\n    shapes: nested"
)


def test_parts_are_measured_with_their_machine_and_are_not_what_they_stand_for(tmp_path):
    scene = Scene.made(tmp_path / "scene", spec=NESTED)
    assert "nested in 2cpu-2gib: 1cpu-1gib (a half)" in scene.run("compile").stdout
    ended = scene.bench()
    assert ended.returncode == 0, ended.stderr
    records = scene.records()
    assert list(records) == ["local-2cpu-2gib", "local-2cpu-2gib-half"]
    assert scene.started() == ["local-2cpu-2gib"]
    half = records["local-2cpu-2gib-half"]
    assert (half["state"], half["machine"]["instance"], half["spent"]) == ("ok", "1cpu-1gib", "$0")
    assert half["requests"] >= 10
    assert half["nested_in"]["sample"] == "local-2cpu-2gib"
    assert half["nested_in"]["confined"]["cpus_by"] in ("affinity", "cpuset")
    assert "confined to 1 vCPUs and 1 GiB" in half["measured_on"]
    assert half["timings"]["path"].endswith("local-2cpu-2gib-half.jsonl.gz")
    (end,) = [event for event in scene.events() if event["do"] == "end"]
    assert len(end["parts"]) == 1
    assert "0 of 1 samples to measure" in scene.bench().stderr
    said = scene.run("compile").stdout
    assert "1 of 1 samples count, beside 1 measured on parts of these machines" in said
    assert "on a half of 2cpu-2gib, not on 1cpu-1gib itself" in scene.run("explain").stdout
    replayed = tmp_path / "recorded.yaml"
    scene.results.rename(replayed)
    (scene.results.parent / "tiny").rename(tmp_path / "tiny")
    ended = scene.run("bench", "--runner", "replay", "--from", str(replayed))
    assert ended.returncode == 0, ended.stderr
    again = scene.records()
    assert again["local-2cpu-2gib-half"]["latency"] == half["latency"]
    assert again["local-2cpu-2gib-half"]["nested_in"] == half["nested_in"]
    assert checksum_ok(read_document(scene.results, Results))


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("spent: $0, nested_in", "spent: $1, nested_in", "is paid for by local-2cpu-2gib"),
        ("sample: local-2cpu-2gib,", "sample: local-other,", "there is no record of that sample"),
    ],
)
def test_a_nested_record_keeps_to_its_rules(tmp_path, old, new, said):
    scene = Scene.made(tmp_path / "scene", spec=NESTED)
    recorded(scene)
    text = scene.results.read_text()
    head, found, tail = text.rpartition(old)
    assert found
    scene.results.write_text(head + new + tail)
    ended = scene.run("compile")
    assert ended.returncode == 1
    assert said in ended.stderr


def recorded(scene: Scene) -> None:
    """Results of the plan as a bench writes them."""
    plan_path = scene.folder / "compiled/tiny/plan.yaml"
    plan = read_document(plan_path, Plan)
    (sample,) = plan.spec.samples
    own = Measured(id=sample.id, machine=sample.machine, measured_on="local", state="ok", requests=20, duration=9.0, spent=0.0,
                   latency=LatencySummary(mean=0.1))  # fmt: skip
    part = sample.parts[0]
    where = NestedIn(sample=sample.id, machine=sample.machine, part=part.part)
    half = own.model_copy(update={"id": f"{sample.id}-half", "machine": part.machine, "nested_in": where})
    body = ResultsBody(
        application=fingerprints.measured_digest(load([str(scene.spec)])[0].application),
        plan=digest.of_bytes(plan_path.read_bytes()), runner="local", spent=0.0, samples=[own, half],
        field_digests=plan.spec.application.field_digests,
    )  # fmt: skip
    write_yaml(scene.results, with_checksum(plan.metadata, body).model_dump(mode="json", exclude_none=True), "a test")
