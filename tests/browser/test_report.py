"""The report in a real browser: its sliders answer as `fogspec menu` does, it asks for nothing, and it can be used."""

import csv
import itertools
import re
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fogspec.base.layout import Layout
from fogspec.compile.artifacts import Artifacts
from fogspec.compile.compiler import compile_application
from fogspec.compile.decision import select_from
from fogspec.compile.inputs import Inputs
from fogspec.plan.schema import PlanMetadata
from fogspec.report import page_data
from fogspec.report.html import page
from fogspec.report.menu import Changes, changed
from fogspec.results.schema import LatencySummary, Measured, ResultsBody, with_checksum
from fogspec.spec import fingerprints
from fogspec.spec.loader import LoadedSpec, load
from fogspec.spec.schema import Application
from tests.support.files import write_yaml

ALPHAS = ("0", "0.25", "0.5", "0.8", "1")
# In seconds and USD per request: wide, about where machines differ, and hopeless.
LIMITS = {
    "grasp-planning-recorded": (
        (None, "20", "4.1", "2", "1.7", "0.01"),
        (None, "0.001", "0.0004", "0.00024", "0.00001"),
    ),
    "vslam-recorded": ((None, "0.25", "0.04", "0.03", "0.001"), (None, "0.00001", "0.0000055", "0.0000001")),
    "motion-planning-cubicles-recorded": ((None, "90", "15", "5.5", "0.1"), (None, "0.003", "0.0021", "0.00001")),
    "motion-planning-apartment-recorded": ((None, "40", "10", "8", "0.1"), (None, "0.002", "0.0017", "0.0005")),
}
SPOT = [(f"{family}.{size}", 2**n, 2**n * ratio, 0.0425 * 2**n * (1 + ratio / 20), 0.018 * 2**n * (1 + ratio / 10))
        for family, ratio in (("c6i", 2), ("m6i", 4), ("r6i", 8))
        for size, n in (("large", 1), ("xlarge", 2), ("2xlarge", 3), ("4xlarge", 4), ("8xlarge", 5))]  # fmt: skip
SPEC_OF = {f"motion-planning-{scene}-recorded": "motion-planning-recorded" for scene in ("cubicles", "apartment")}


def loaded(checkout: Path, name: str) -> LoadedSpec:
    path = checkout / "specs" / f"{SPEC_OF.get(name, name)}.yaml"
    return next(one for one in load([str(path)]) if one.application.metadata.name == name)


def written_catalog(path: Path, offers) -> None:
    """A catalog in SkyPilot's columns; offers are (name, vCPUs, GiB, USD per hour, spot price)."""
    columns = "InstanceType,AcceleratorName,AcceleratorCount,vCPUs,MemoryGiB,GpuInfo,Price,SpotPrice,Region"
    with path.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(columns.split(","))
        rows.writerows(
            [name, "", "", vcpus, gib, "", price, spot, "us-east-1"] for name, vcpus, gib, price, spot in offers
        )


def compiled(one: LoadedSpec, catalog: str | None = None) -> Artifacts:
    inputs = Inputs.load([one.path], catalog=catalog or "snapshot", name=one.application.metadata.name)[0]
    return compile_application(inputs.with_application(one.application))


def written(one: LoadedSpec, to: Path, catalog: str | None = None, made: Artifacts | None = None) -> Path:
    menu = f"fogspec menu {shlex.quote(one.path)} --name {one.application.metadata.name}"
    to.write_bytes(page(made or compiled(one, catalog), "fogspec report", menu))
    return to


MOVE = """([alpha, limits]) => {
    const set = (id, value) => {
        const node = document.getElementById(id);
        if (typeof value === 'boolean') { node.checked = value; node.dispatchEvent(new Event('change')); return; }
        node.value = value;
        node.dispatchEvent(new Event('input'));
    };
    set('alpha', alpha);
    for (const [name, limit] of Object.entries(limits)) {
        if (limit !== null) set(name + '-number', limit);
        set(name + '-use', limit !== null);
    }
    const rows = [...document.querySelectorAll('#answers tr')];
    const answer = Object.fromEntries(rows.map((row) => [row.dataset.role, Number(row.dataset.row)]));
    return [answer, document.getElementById('verdict').textContent];
}"""


def move(view, alpha: str, latency: str | None, cost: str | None) -> tuple[dict[str, int], str]:
    """Set the controls, with the events of a person who does, and read the answer."""
    return tuple(view.evaluate(MOVE, [alpha, {"latency": latency, "cost": cost}]))


def same_as_menu(browser, one: LoadedSpec, made: Artifacts, to: Path, limits, alphas) -> set[str]:
    """Compare the page with the choice behind `fogspec menu` over a grid; the machines that were chosen on it."""
    view = browser.open(written(one, to, made=made))
    names, chosen = made.decision.choice.offers.instance, set()
    for latency, cost, alpha in itertools.product(*limits, alphas):
        texts = "none" if latency is None else f"{latency}s", "none" if cost is None else f"${cost}/request"
        answer, verdict = move(view, alpha, latency, cost)
        application = changed(one.application, Changes(alpha=float(alpha), latency=texts[0], cost=texts[1]))
        choice = select_from(application, made.decision.models, made.decision.predicted).choice
        if choice.chosen is None:
            assert answer == {}, (alpha, latency, cost)
            if not choice.violations:
                assert verdict == "No machine is likely enough to meet the limits."
                continue
            worst = choice.violations[0]
            said = re.search(r"limits: (\S+): the best machine needs (\S+) times", verdict)
            assert said[1] == worst.limit
            assert float(said[2]) == pytest.approx(worst.factor, rel=0.01)
            continue
        rows = {"chosen": choice.chosen, "cheapest": choice.cheapest, "fastest": choice.fastest}
        assert answer == rows, (alpha, latency, cost)
        chosen.add(str(names[choice.chosen]))
    assert browser.complaints == []
    return chosen


@pytest.mark.parametrize(
    ("name", "most"),
    [
        ("grasp-planning-recorded", 1),
        ("vslam-recorded", 1500),
        ("motion-planning-cubicles-recorded", 1),
        ("motion-planning-apartment-recorded", 1500),
    ],
    ids=lambda value: {1: "only those that can win", 1500: "every type"}.get(value, value),
)
def test_the_sliders_choose_as_menu_does(browser, checkout, tmp_path, monkeypatch, name, most):
    monkeypatch.setattr(page_data, "MOST", most)
    one = loaded(checkout, name)
    chosen = same_as_menu(browser, one, compiled(one), tmp_path / "report.html", LIMITS[name], ALPHAS)
    assert len(chosen) > (name != "grasp-planning-recorded"), "a grid on which the choice never moves proves nothing"


def test_a_limit_is_drawn_where_it_is_or_not_at_all(browser, checkout, tmp_path):
    """One beyond the picture is not drawn at its edge, where the scale would say something else of it."""
    view = browser.open(written(loaded(checkout, "grasp-planning-recorded"), tmp_path / "report.html"))
    for latency, drawn in (("2", 1), ("100000", 0), ("0.000001", 0)):
        move(view, "0.7", latency, None)
        assert view.evaluate("document.querySelectorAll('#picture .limit').length") == drawn, latency


DATA = {"transfer": {"per_request": "0.1MB", "price": "$0.01/GiB"}}
PROVISIONED = {"billing": "provisioned", "rate": "20/s", **DATA}
OTHERS = {
    "whole hours": ({"objective": PROVISIONED, "constraints": {"price": "$2/h", "confidence": 0.7}}, None),
    "network, data and certainty": (
        {"objective": DATA, "constraints": {"network_allowance": "5ms", "confidence": 0.99}},
        None,
    ),
    "scales": ({"objective": {"scale": {"latency": "1s", "cost": "$1/request"}}}, None),
    "only what was measured": ({"benchmark": {"sampler": "adaptive", "budget": "$20"}}, None),
    "spot": (
        {"hardware": {"spot": True}, "objective": {"interruption": {"rate": "18000/h", "recovery_time": "0s"}}},
        SPOT,
    ),
}


@pytest.mark.parametrize("other", OTHERS)
def test_every_rule_of_the_choice_is_in_the_page(browser, checkout, tmp_path, monkeypatch, other):
    monkeypatch.setattr(page_data, "MOST", 1)
    patch, offers = OTHERS[other]
    one = loaded(checkout, "vslam-recorded")
    document = one.application.model_dump(mode="json", exclude_unset=True)
    for part, values in patch.items():
        document["spec"][part] = document["spec"].get(part, {}) | values
    one = replace(one, application=Application.model_validate(document))
    catalog = None
    if offers is not None:
        catalog = str(tmp_path / "aws.csv")
        written_catalog(Path(catalog), offers)
    made = compiled(one, catalog)
    assert same_as_menu(browser, one, made, tmp_path / "report.html", narrow_limits(one, made), ("0.4", "1"))


def narrow_limits(one: LoadedSpec, made: Artifacts) -> tuple[list[str | None], list[str | None]]:
    """Limits on latency and cost that some machine just meets and just misses with each of the asked probabilities."""
    choice, spec = made.decision.choice, one.application.spec
    found: tuple[list[str | None], list[str | None]] = [None], [None]
    for level in choice.rule.levels:
        needed = choice.required_latency_s(level)
        for column, texts, more in (
            (needed, found[0], spec.constraints.network_allowance),
            (choice.rule.costs.per_request(needed), found[1], 0.0),
        ):
            for value in np.quantile(column, (0, 0.4), method="nearest").tolist():
                texts += [f"{value * share + more:.9f}" for share in (0.999, 1.001)]
    return found


def measured_here(one: LoadedSpec) -> None:
    """Results of the plan's samples, as the local runner would write them."""
    records = [
        Measured(
            id=sample.id, machine=sample.machine, measured_on="local", state="ok", requests=20,
            latency=LatencySummary(mean=1.6 / sample.machine.cpus, sd=0.1), duration=30.0, spent=0.0,
            metrics={"path_length": 26 + 4 / sample.machine.cpus},
        )
        for sample in compiled(one).plan.spec.samples
    ]  # fmt: skip
    body = ResultsBody(
        application=fingerprints.measured_digest(one.application), runner="local", spent=0.0, samples=records
    )
    metadata = PlanMetadata(name=one.application.metadata.name)
    path = Layout.of(one.path, metadata.name).results
    write_yaml(path, with_checksum(metadata, body).model_dump(mode="json"), "a test")


def test_a_metric_in_place_of_latency_and_no_probabilities(browser, checkout, tmp_path):
    one = loaded(checkout, "planner-local")
    document = one.application.model_dump(mode="json", exclude_unset=True)
    document["spec"]["objective"]["metric"] = "path_length"
    one = replace(one, application=Application.model_validate(document))
    measured_here(one)
    limits = ((None, "2", "0.5"), (None, "0.00005", "0.00001"))
    assert same_as_menu(browser, one, compiled(one), tmp_path / "report.html", limits, ALPHAS[::2])


@pytest.mark.parametrize("name", ["vslam-recorded", "motion-planning-cubicles-recorded"])
def test_the_command_in_the_page_says_the_same(browser, checkout, tmp_path, name):
    one = loaded(checkout, name)
    view = browser.open(written(one, tmp_path / "report.html"))
    move(view, "0.35", None, LIMITS[name][1][1])
    words = shlex.split(view.inner_text("#command"))
    assert words[:2] == ["fogspec", "menu"]
    ended = subprocess.run([sys.executable, "-m", *words], cwd=checkout, capture_output=True, text=True, check=True)
    line = next(line for line in ended.stdout.splitlines() if line.startswith("balanced"))
    assert line.split()[1] == view.get_attribute("#verdict", "data-chosen")


def test_nothing_is_asked_for_and_nothing_complained_of_light_and_dark(browser, checkout, tmp_path):
    path = written(loaded(checkout, "grasp-planning-recorded"), tmp_path / "report.html")
    colours = set()
    for scheme in ("light", "dark"):
        view = browser.open(path, color_scheme=scheme)
        view.check("#per-hour")
        view.click("#back")
        colours.add(view.evaluate("getComputedStyle(document.body).backgroundColor"))
    assert len(colours) == 2
    assert [url for url in browser.requests if not url.startswith("data:")] == [path.as_uri()] * 2
    assert browser.complaints == []


def test_it_fits_600_px_and_needs_no_mouse(browser, checkout, tmp_path):
    view = browser.open(written(loaded(checkout, "vslam-recorded"), tmp_path / "report.html"), width=600)
    assert view.evaluate("document.documentElement.scrollWidth") <= 600
    assert view.evaluate(UNNAMED) == []
    view.focus("#alpha")
    before = float(view.input_value("#alpha"))
    view.keyboard.press("ArrowRight")
    assert float(view.input_value("#alpha")) == pytest.approx(before + 0.01)
    assert f"{before + 0.01:.2f} latency" in view.get_attribute("#alpha", "aria-valuetext")
    view.keyboard.press("Tab")
    assert view.evaluate("document.activeElement.id") == "latency-use"
    view.keyboard.press("Space")
    assert "none" in view.inner_text("#command")


UNNAMED = """[...document.querySelectorAll('input, button, svg[role=img], img')].filter((node) =>
    !(node.labels?.length || node.getAttribute('aria-label') || node.alt || node.textContent.trim())).map((node) => node.id)"""
HOSTILE = "</script><img src=x onerror=alert(1)><!--'\"&"


def test_hostile_names_do_nothing(browser, checkout, tmp_path):
    catalog = tmp_path / "aws.csv"
    written_catalog(catalog, [(f"c6i.{HOSTILE}", 32, 64, 0.3, ""), ("c6i.xlarge", 4, 8, 0.17, "")])
    spec = tmp_path / "specs" / "vslam-recorded.yaml"
    spec.parent.mkdir()
    spec.write_text((checkout / "specs" / "vslam-recorded.yaml").read_text() + f"# {HOSTILE}\n")
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "vslam-recorded.yaml").write_text(
        (checkout / "results" / "vslam-recorded.yaml").read_text()
    )
    (one,) = load([str(spec)])
    view = browser.open(written(one, tmp_path / "report.html", str(catalog)))
    move(view, "0.5", None, None)
    assert view.get_attribute("#verdict", "data-chosen") == f"c6i.{HOSTILE}"
    assert f"# {HOSTILE}" in view.inner_text("#spec")
    assert browser.complaints == []
