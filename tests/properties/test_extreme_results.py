"""Results with extreme but valid figures: every verb that computes with them ends with an answer, and without NaN."""

import contextlib
import io
import json
import os
import re
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from fogspec.catalog.machine import Machine
from fogspec.cli import main
from fogspec.language.loader import read_document
from fogspec.plan.schema import Plan
from fogspec.results.schema import LatencySummary, Measured, ResultsBody
from fogspec_lab import cli as lab
from tests.support.results import write
from tests.support.running import CATALOG, spec

NAN = re.compile(r"(?<![\w.$/-])[-+]?(nan|inf|infinity)\b(?! in )", re.IGNORECASE)
ANSWERS = (0, 3, 4, 7)  # also: not fresh, no machine meets the limits, and nothing is measured

edges_s = st.sampled_from([1e-9, 1e-6, 1e-3, 1.0, 1e3, 1e6])
latencies_s = st.one_of(edges_s, st.floats(-9, 6).map(lambda power: 10**power))
errors = st.sampled_from([None, 0.0, 5e-324, 1e-12, 0.1, 10.0])
busy_s = st.sampled_from([None, 0.0, 5e-324, 1e-9, 1.0, 1e6])
deviations = st.sampled_from([None, 0.0, 5e-324, 1e-12, 0.1, 1.0, 1e3])
metrics = st.one_of(
    st.sampled_from([0.0, -1.0, 5e-324, 1e-12, 1.0, 1e12, -1e12]), st.floats(-1e12, 1e12), st.floats(-1, 1)
)
counts = st.sampled_from([1, 2, 20, 10**9])
prices = st.sampled_from([1e-6, 1e-3, 0.1, 1.0, 1e3, 1e5])


@st.composite
def records(draw: st.DrawFn, machines: list[Machine], equal: bool) -> list[dict[str, Any]]:
    """Figures of each machine, as a machine may send them."""
    found = []
    same = draw(latencies_s)
    for machine in machines:
        mean = same if equal else draw(latencies_s)
        share = draw(deviations)
        state = draw(st.sampled_from(["ok", "ok", "ok", "ok", "timeout", "failed", "insufficient"]))
        requests = draw(counts)
        figures: dict[str, Any] = {"machine": machine, "state": state, "requests": requests}
        if state == "ok" or draw(st.booleans()):
            sd = None if share is None else min(mean * share, 1e6)
            figures["latency"] = LatencySummary(mean=mean, sd=sd, p50=mean, p95=draw(st.sampled_from([None, mean])))
            figures["busy"] = draw(busy_s)
            known = draw(st.fixed_dictionaries({"mean": errors, "p50": errors}))
            figures["errors"] = draw(st.sampled_from([None, {name: e for name, e in known.items() if e is not None}]))
        if state == "failed":
            figures["reason"] = draw(st.sampled_from(["crash", "out_of_memory", "quota", "out_of_range"]))
        if state in ("timeout", "insufficient"):
            figures["latency_lower_bound"] = draw(st.one_of(st.none(), edges_s))
        figures["metrics"] = draw(st.one_of(st.just({}), st.fixed_dictionaries({"size": metrics})))
        if figures["metrics"]:
            figures["metric_errors"] = draw(st.sampled_from([None, {}, {"size": 0.0}, {"size": 10.0}]))
        figures["setup"] = draw(st.sampled_from([None, 0.0, 1e-9, 1e9]))
        figures["duration"] = draw(st.sampled_from([0.0, 1e-9, 60.0, 1e9]))
        figures["spent"] = draw(st.sampled_from([0.0, 5e-324, 1e-9, 1.0, 1e6]))
        found.append(figures)
    return found


@st.composite
def worlds(draw: st.DrawFn) -> dict[str, Any]:
    """A catalog, a spec and what its samples measured."""
    price = draw(st.lists(prices, min_size=8, max_size=8))
    rows = CATALOG.splitlines()
    catalog = [rows[0]]
    for row, value in zip(rows[1:], price, strict=True):
        cells = row.split(",")
        cells[5], cells[6] = repr(value), ""
        catalog.append(",".join(cells))
    metric = draw(st.sampled_from([None, "objective", "limit"]))
    limits = draw(st.sampled_from([
        "{latency: 10s, cost: $1/request}", "{latency: 1ns}", "{latency: 59s, confidence: 0.999}",
        "{cost: $0.000000000001/request}", "{statistic: p50, latency: 1s}",
    ]))  # fmt: skip
    parts = {"hardware": "{cpus: 2..32}", "constraints": limits,
             "objective": f"{{alpha: {draw(st.sampled_from([0, 0.5, 1]))}}}",
             "benchmark": "{budget: $100000000, stop: {requests: 20, duration: 1min}, ready_timeout: 1min}"}  # fmt: skip
    if metric == "objective":
        parts |= {"metrics": "{size: {callback: size}}", "objective": "{alpha: 0.5, metric: size}"}
    if metric == "limit":
        parts |= {"metrics": "{size: {callback: size}}", "constraints": "{latency: 10s, metrics: {size: 1}}"}
    return {"catalog": "\n".join(catalog) + "\n", "spec": spec(**parts), "equal": draw(st.booleans())}


class Folder:
    """A project in which verbs run in this process."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __call__(
        self, *words: str, codes: tuple[int, ...] = ANSWERS, run: Callable[[Sequence[str]], None] = main
    ) -> str:
        out, err = io.StringIO(), io.StringIO()
        before = os.getcwd()
        os.chdir(self.path)
        try:
            with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
                try:
                    run(words)
                    code: Any = 0
                except SystemExit as ended:
                    code = ended.code
        finally:
            os.chdir(before)
        said = out.getvalue()
        assert int(code or 0) in codes, f"{words}: {code}: {said}{err.getvalue()}"
        assert "Traceback" not in said + err.getvalue()
        wrong = NAN.search(said)
        assert wrong is None, f"{words}: …{said[max(0, wrong.start() - 200) : wrong.end() + 50]}"
        return said

    def git(self, *words: str) -> None:
        subprocess.run(["git", *words], cwd=self.path, check=True, capture_output=True)


def measured(folder: Folder, figures: list[dict[str, Any]]) -> None:
    """Write the results as a bench would."""
    plan = read_document(folder.path / "compiled/demo/plan.yaml", Plan)
    samples = [
        Measured(id=sample.id, measured_on="test", **one)
        for sample, one in zip(plan.spec.samples, figures, strict=False)
    ]
    paid = {one.id: min(one.spent, 1e9 / len(samples)) for one in samples}
    body = ResultsBody(inputs=plan.spec.inputs, runner="skypilot", samples=samples, paid=paid)
    write(folder.path / "results/demo", body)


# An example is a dozen commands, so that searching for a smaller one would take minutes.
@settings(max_examples=4, suppress_health_check=list(HealthCheck), phases=[Phase.explicit, Phase.generate])
@pytest.mark.slow
@given(worlds(), st.data())
def test_every_verb_answers(world: dict[str, Any], data: st.DataObject) -> None:
    check(world, data)


def check(world: dict[str, Any], data: st.DataObject) -> None:
    """Run every verb on these results."""
    with tempfile.TemporaryDirectory() as name:
        folder, at = Folder(Path(name)), ("--catalog", "offers.csv")
        (folder.path / "specs").mkdir()
        (folder.path / "offers.csv").write_text(world["catalog"])
        (folder.path / "specs/demo.yaml").write_text(world["spec"])
        (folder.path / "specs/work.py").write_text("print('work')\n")
        folder.git("init", "-q")
        folder("compile", "specs/demo.yaml", *at, codes=(0,))
        plan = read_document(folder.path / "compiled/demo/plan.yaml", Plan)
        measured(folder, data.draw(records([one.machine for one in plan.spec.samples], world["equal"])))
        folder("compile", "specs/demo.yaml", *at)
        folder.git("add", "-A")
        folder.git("-c", "user.name=t", "-c", "user.email=t@example.org", "commit", "-qm", "one")
        folder("check", "specs/demo.yaml")
        json.loads(folder("compile", "specs/demo.yaml", *at, "-o", "json"))
        for verb in (
            ["menu", "demo"],
            ["explain", "demo"],
            ["report", "demo"],
            ["status"],
            ["diff", "--since", "HEAD"],
        ):
            folder(*verb)
        for verb in (["menu", "demo"], ["explain", "specs/demo.yaml"], ["status"]):
            json.loads(folder(*verb, "-o", "json"))
        if (folder.path / "compiled/demo/manifest.yaml").is_file():
            folder("check")
        for path in (folder.path / "compiled/demo").iterdir():
            if path.is_file() and path.suffix in (".yaml", ".svg"):
                wrong = NAN.search(text := path.read_text())
                assert wrong is None, f"{path}: …{text[max(0, wrong.start() - 200) : wrong.end() + 50]}"
        sweep = ["instance_type,infra,latency_s,size"]
        sweep += [
            f"{row.split(',')[0]},aws/r1,{data.draw(latencies_s)!r},{data.draw(latencies_s)!r}"
            for row in world["catalog"].splitlines()[1:]
        ]
        (folder.path / "sweep.csv").write_text("\n".join([*sweep, ""]))
        folder("evaluate", "specs/demo.yaml", "--sweep", "sweep.csv", *at, codes=(0, 2), run=lab.main)
