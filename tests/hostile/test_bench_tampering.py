"""A bench launches what the spec compiles to: whatever a branch edits in plan or task is refused before anything starts."""

import re
from collections.abc import Iterator, Mapping
from typing import Any

import pytest
from ruamel.yaml import YAML

from fogspec.base import digest
from fogspec.base.layout import Layout
from fogspec.base.yaml.writer import yaml_text
from fogspec.catalog.machine import Gpu, Machine
from fogspec.compile.plan_files import plan_file, with_tasks
from fogspec.language.loader import load, read_document
from fogspec.plan.schema import Plan, sample_on
from tests.e2e.test_bench_money import SWEEP, bench, nothing_happened, paid  # noqa: F401
from tests.support.results import document
from tests.support.running import Shell, shell  # noqa: F401

PLAN = "compiled/demo/plan.yaml"
ADDED = {
    "num_nodes": 8, "envs": {"A": "b"}, "secrets": {"AWS_SECRET_ACCESS_KEY": None}, "resources.accelerators": "H100:8",
    "resources.any_of": [{"instance_type": "p5.48xlarge"}], "file_mounts.~/.aws": "~/.aws", "resources.image_id": "docker:evil",
}  # fmt: skip


def parsed(text: str) -> Any:
    return YAML(typ="safe", pure=True).load(text)


def edited(value: Any, path: str, new: Any) -> Any:
    """The document with one value in another's place, dropped for None. `.` in the target of a mount is no step."""
    key, _, rest = path.partition(".")
    inner = (
        new
        if not rest
        else edited(value[key], rest, new)
        if key != "file_mounts"
        else {**value.get(key, {}), rest: new}
    )
    found = {**value, key: inner}
    if isinstance(inner, Mapping):
        found[key] = {name: one for name, one in inner.items() if one is not None or name.startswith("AWS")}
    return {name: one for name, one in found.items() if one is not None}


def paths(task: Mapping[str, Any], above: str = "") -> Iterator[str]:
    for key, value in task.items():
        yield f"{above}{key}"
        if isinstance(value, Mapping):
            yield from paths(value, f"{above}{key}.")


def test_every_key_of_a_task_is_the_compiled_one(paid: Shell) -> None:
    """Also if the plan is given the digest of the edited task."""
    plan = parsed(paid.read(PLAN))
    sample = plan["spec"]["samples"][-1]
    name = f"compiled/demo/tasks/{sample['id']}.sky.yaml"
    text, whole = paid.read(name), paid.read(PLAN)
    task = parsed(text)
    found = [(path, None) for path in paths(task)] + list(ADDED.items())
    found += [(path, {"changed": 1}) for path in paths(task)] + [("resources.instance_type", "p5.48xlarge")]
    assert len(found) >= 40
    for path, new in found:
        content = yaml_text(edited(task, path, new), "a branch")
        paid.write(name, content)
        paid.write(PLAN, whole.replace(sample["task"], digest.of_bytes(content.encode())))
        said = bench(paid, "--yes", code=3)
        key = path if path.count(".") < 2 or path.startswith("file_mounts") else path.rpartition(".")[0]
        assert f"{name} is not what specs/demo.yaml compiles to: {key.partition('.~')[0]}" in said.err, (path, new)
    assert nothing_happened(paid)
    paid.write(name, text)
    paid.write(PLAN, whole)
    bench(paid, "--yes")


@pytest.mark.parametrize(
    ("field", "new", "named"),
    [
        ("^  duration", "20h", "spec.benchmark.stop.duration"),
        ("^  ready_timeout", "1d", "spec.benchmark.ready_timeout"),
        ("^  requests", "2", "spec.benchmark.stop.requests"),
        ("^  warmup", "7", "spec.benchmark.warmup"),
        ("^  sampler", "adaptive", "spec.benchmark.sampler"),
        ("instance", "a.huge", "samples: aws-r1-a-small"),
    ],
)
def test_a_plan_that_measures_otherwise_than_the_spec_is_refused(paid: Shell, field: str, new: str, named: str) -> None:
    changed, count = re.subn(rf"({field}:) [^,\n]*", rf"\1 {new}", paid.read(PLAN), count=1, flags=re.MULTILINE)
    assert count == 1
    paid.write(PLAN, changed)
    said = bench(paid, "--yes", code=3)
    assert f"{PLAN} is not what the spec compiles to: {named}" in said.err
    assert nothing_happened(paid)


def test_a_plan_without_some_of_its_samples_is_refused(paid: Shell) -> None:
    plan = read_document(paid.folder / PLAN, Plan)
    first, *others = plan.spec.samples
    body = plan.spec.model_copy(update={"samples": [first]})
    (paid.folder / PLAN).write_bytes(
        plan_file(plan.model_copy(update={"spec": body}), Layout.of("specs/demo.yaml", "demo"))
    )
    for words in (("--yes",), ("--dry-run",)):
        said = bench(paid, *words, code=3)
        assert f"{PLAN} is stale: spec.samples: without {', '.join(one.id for one in others)}" in said.err
        assert "fogspec compile specs/demo.yaml" in said.err
    assert nothing_happened(paid)


@pytest.mark.parametrize(
    ("machine", "field"),
    [
        (("aws/r1", "a.huge", 128, 64, None, False, 1.6), "hardware.cpus"),
        (("aws/r1", "g.small", 4, 16, "T4", False, 0.6), "hardware.gpus"),
        (("aws/r1", "a.small", 2, 4, None, True, 0.03), "hardware.spot"),
        (("gcp/r1", "a.small", 2, 4, None, False, 0.1), "infra"),
    ],
)
def test_a_machine_that_the_spec_does_not_admit_is_not_measured(paid: Shell, machine: tuple, field: str) -> None:
    """Also if the plan has it, with the very task that it compiles to: as sample."""
    infra, instance, cpus, memory, gpu, spot, price = machine
    of = Gpu(name=gpu, count=1) if gpu else None
    odd = Machine(infra=infra, instance=instance, cpus=cpus, memory=memory, gpu=of, spot=spot, price=price)
    layout, application = Layout.of(paid.folder / "specs/demo.yaml", "demo"), load([paid.folder / "specs/demo.yaml"])[0]
    plan = read_document(layout.plan, Plan)
    first = plan.spec.samples[0]
    samples = [*plan.spec.samples[:-1], sample_on(odd, "a branch wants it")]
    body = plan.spec.model_copy(update={"samples": samples})
    forged, files = with_tasks(application.application, plan.model_copy(update={"spec": body}), layout)
    for path, content in (files | {layout.plan: plan_file(forged, layout)}).items():
        path.write_bytes(content)
    # The first machine is not to be had.
    sweep = "".join(line for line in SWEEP.splitlines(True) if not line.startswith(first.machine.instance))
    paid.write("sweep.csv", sweep)
    said = bench(paid, "--yes", code=3)
    assert f"{PLAN} is stale: spec.samples: without " in said.err
    assert f"{samples[-1].id} should not be there" in said.err
    assert nothing_happened(paid)
    # By other prices than the plan's its samples are not judged.
    paid.write("offers.csv", paid.read("offers.csv") + "z.huge,,,256,512,9.99,3,r9,\n")
    said = bench(paid, "--yes")
    assert f"{samples[-1].id} is not measured: spec.{field} does not admit it" in said.err
    measured = {one["id"] for one in document(paid.folder / "results/demo")["samples"]}
    assert measured == {one.id for one in samples[:-1]}


def test_a_machine_under_the_name_of_one_that_was_measured_is_refused(paid: Shell) -> None:
    """`a_small` and `a.small`: its sample would be taken for measured."""
    bench(paid, "--yes")
    layout, application = Layout.of(paid.folder / "specs/demo.yaml", "demo"), load([paid.folder / "specs/demo.yaml"])[0]
    plan = read_document(layout.plan, Plan)
    first, *others = plan.spec.samples
    other = first.model_copy(update={"machine": first.machine.model_copy(update={"instance": "a_small"})})
    body = plan.spec.model_copy(update={"samples": [other, *others]})
    forged, files = with_tasks(application.application, plan.model_copy(update={"spec": body}), layout)
    for path, content in (files | {layout.plan: plan_file(forged, layout)}).items():
        path.write_bytes(content)
    paid.write("offers.csv", paid.read("offers.csv").replace("a.small", "a_small"))
    said = bench(paid, "--yes", code=3)
    assert f"{PLAN}: {first.id}: another machine was measured under that name" in said.err
    paid("compile", "demo", code=7)  # the other one is left to measure
    assert f"{first.id}-" in paid.read(PLAN)
