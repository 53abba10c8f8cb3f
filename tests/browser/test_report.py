"""The report in a real browser: its sliders answer as `fogspec menu` does, it asks for nothing, and it can be used."""

import csv
import itertools
import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fogspec.base.layout import Layout
from fogspec.choice.menu import entry_of, floored
from fogspec.compile.artifacts import Artifacts
from fogspec.compile.compiler import compile_application
from fogspec.compile.decision import select_from
from fogspec.compile.inputs import Inputs
from fogspec.language.fingerprints import measured_record
from fogspec.language.loader import LoadedSpec, load
from fogspec.language.lock_io import files_sent
from fogspec.language.schema import Application
from fogspec.model import predict
from fogspec.numerics.waiting import BUSY, Waiting
from fogspec.report import page_data
from fogspec.report.facts import machines
from fogspec.report.html import page
from fogspec.report.menu import Changes, changed
from fogspec.results.schema import LatencySummary, Measured, ResultsBody
from tests.support.results import write

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
SPEC_OF = {"cubicles-planner": "cubicles-planner/cubicles-planner"} | {
    f"motion-planning-{scene}-recorded": "motion-planning-recorded" for scene in ("cubicles", "apartment")
}


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
    return compile_application(replace(inputs, spec=replace(inputs.spec, application=one.application)))


def written(one: LoadedSpec, to: Path, catalog: str | None = None, made: Artifacts | None = None) -> Path:
    menu = f"fogspec menu {shlex.quote(one.path)} --name {one.application.metadata.name}"
    to.write_bytes(page(made or compiled(one, catalog), "fogspec report", menu))
    return to


MOVE = """([alpha, limits]) => {
    for (const [id, value] of [['alpha', alpha], ...Object.entries(limits)]) {
        const node = document.getElementById(id);
        node.value = value ?? '';
        node.dispatchEvent(new Event('input'));
    }
    const cells = (row) => [...row.cells].map((cell) => [cell.dataset.head, cell.textContent]);
    const rows = [...document.querySelectorAll('#machines tbody tr')].map((row) => Object.fromEntries(cells(row)));
    return [rows, document.getElementById('verdict').textContent];
}"""


def move(view, alpha: str, latency: str | None, cost: str | None) -> tuple[list[dict[str, str]], str]:
    """Set the controls, with the events of a person who does, and read the table; the cost is per request."""
    per_1000 = None if cost is None else f"{1000 * float(cost):.12g}"
    return tuple(view.evaluate(MOVE, [alpha, {"latency": latency, "cost": per_1000}]))


def same_as_menu(browser, one: LoadedSpec, made: Artifacts, to: Path, limits, alphas) -> set[str]:
    """Compare the page with the choice behind `fogspec menu` over a grid; the machines that were chosen on it."""
    view, decision, chosen = browser.open(written(one, to, made=made)), made.decision, set()
    types = page_data.cheapest_of_types(decision.choice).tolist()
    entries = [entry_of(decision.choice, row) for row in types]
    names = [cells[1] for cells in machines(decision.menu, entries).rows]
    for latency, cost, alpha in itertools.product(*limits, alphas):
        texts = "none" if latency is None else f"{latency}s", "none" if cost is None else f"${cost}/request"
        rows, verdict = move(view, alpha, latency, cost)
        application = changed(one.application, Changes(alpha=float(alpha), latency=texts[0], cost=texts[1]))
        choice = select_from(application, made.decision.models, made.decision.predicted).choice
        expected = {}
        for row, name in zip(types, names, strict=True):
            met = choice.probability(row)
            meets = choice.feasible[row] and (met is None or not choice.bounds or met >= choice.confidence)
            mark = "-" if not meets else ">" if row == choice.chosen else ""
            expected[name] = (mark, None if met is None else floored(met))
        found = {row["machine"]: (row[""], float(row["P"]) if row["P"] else None) for row in rows}
        assert found == {name: expected[name] for name in found}, (alpha, latency, cost)
        assert {name for name, (mark, _) in expected.items() if mark == ">"} <= found.keys()
        if not any(mark == ">" for mark, _ in expected.values()):
            assert verdict.startswith("No machine qualifies"), (alpha, latency, cost)
            continue
        assert rows[0][""] == ">"
        chosen.add(rows[0]["machine"])
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


DATA = {"transfer": "$0.93/1000000 requests"}
PROVISIONED = {"load": {"rate": "20/s"}, **DATA}
OTHERS = {
    "whole hours": ({"objective": PROVISIONED, "constraints": {"price": "$2/h", "confidence": 0.7}}, None),
    "network, data and certainty": (
        {"objective": DATA, "constraints": {"network_allowance": "5ms", "confidence": 0.99}},
        None,
    ),
    "scales": ({"objective": {"scale": {"latency": "1s", "cost": "$1/request"}}}, None),
    "only what was measured": ({"benchmark": {"sampler": "adaptive", "budget": "$20"}}, None),
    "spot": ({"hardware": {"spot": "18000/h", "startup": "0s"}}, SPOT),
    "waiting": ({"objective": PROVISIONED, "constraints": {"confidence": 0.8}}, None),
}


def waiting(_known, types, busy_ratio) -> Waiting:
    """Machines on which requests wait for one another: not at all, some time, and long."""
    tables = np.array([BUSY, BUSY * (1 + BUSY**2), BUSY * (1 + 9 * BUSY**4)])
    return Waiting(tables, np.arange(len(types)) % 3, 1 / (20 * busy_ratio))


@pytest.mark.parametrize("other", OTHERS)
def test_every_rule_of_the_choice_is_in_the_page(browser, checkout, tmp_path, monkeypatch, other):
    monkeypatch.setattr(page_data, "MOST", 1)
    # How long a machine is paid for a request differs from type to type, as if each had been measured.
    monkeypatch.setattr(predict, "busy_ratios", lambda _known, types: 0.4 + 0.3 * (np.arange(len(types)) % 5))
    if other == "waiting":
        monkeypatch.setattr(predict, "_waiting", waiting)
    patch, offers = OTHERS[other]
    one = loaded(checkout, "vslam-recorded")
    document = one.application.model_dump(mode="json", exclude_unset=True)
    for part, values in patch.items():
        document["spec"][part] = document["spec"].get(part, {}) | values
    one = replace(one, application=Application.model_validate(document))
    catalog = None
    if offers is not None:
        catalog = str(checkout / "aws.csv")
        written_catalog(Path(catalog), offers)
    made = compiled(one, catalog)
    assert same_as_menu(browser, one, made, tmp_path / "report.html", narrow_limits(one, made), ("0.4", "1"))


def narrow_limits(one: LoadedSpec, made: Artifacts) -> tuple[list[str | None], list[str | None]]:
    """Limits on latency and cost that some machine just meets and just misses with the required probability."""
    choice, spec = made.decision.choice, one.application.spec
    found: tuple[list[str | None], list[str | None]] = [None], [None]
    needed = choice.required_latency_s(choice.confidence)
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
            latency=LatencySummary(mean=1.6 / sample.machine.cpus, sd=0.1), errors={"mean": 0.02}, duration=30.0, spent=0.0,
            metrics={"path_length": 26 + 4 / sample.machine.cpus},
        )
        for sample in compiled(one).plan.spec.samples
    ]  # fmt: skip
    inputs = measured_record(one.application, None, files_sent(one.application, one.layout))
    body = ResultsBody(inputs=inputs, runner="local", samples=records)
    write(Layout.of(one.path, one.application.metadata.name).results, body)


def rented(one: LoadedSpec) -> LoadedSpec:
    """The application with the length of the path as its metric, measured on this host for machines to rent."""
    document = one.application.model_dump(mode="json", exclude_unset=True)
    body = document["spec"]
    body["objective"]["metric"] = "path_length"
    body["constraints"]["confidence"] = "none"
    body |= {
        "infra": ["aws/us-east-1"],
        "hardware": {"cpus": "1..8", "memory": "2GiB..64GiB", "allow": ["c6i.*", "m6i.*"]},
    }
    return replace(one, application=Application.model_validate(document))


def test_a_metric_in_place_of_latency_and_no_probabilities(browser, checkout, tmp_path):
    one = rented(loaded(checkout, "cubicles-planner"))
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
    line = next(line for line in ended.stdout.splitlines() if line.startswith(">"))
    assert line.split()[1] == view.get_attribute("#verdict", "data-chosen")


def test_nothing_is_asked_for_and_nothing_complained_of_light_and_dark(browser, checkout, tmp_path):
    path = written(loaded(checkout, "grasp-planning-recorded"), tmp_path / "report.html")
    colours = set()
    for scheme in ("light", "dark"):
        view = browser.open(path, color_scheme=scheme)
        view.click("#reset")
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
    assert f"{before + 0.01:.2f} latency" in view.inner_text("#alpha-words")
    view.keyboard.press("Tab")
    assert view.evaluate("document.activeElement.id") == "reset"
    view.fill("#latency", "")
    assert "--latency none" in view.inner_text("#command")


def test_the_table_stands_without_javascript(browser, checkout, tmp_path):
    path = written(loaded(checkout, "grasp-planning-recorded"), tmp_path / "report.html")
    view = browser.open(path, java_script_enabled=False)
    rows = view.locator("#machines tbody tr")
    assert rows.count() == 24
    assert "g4dn.xlarge 1xT4" in rows.first.inner_text()
    assert not view.is_visible("#controls")
    shown = "[...document.querySelectorAll('#machines tbody tr')].filter((row) => row.getClientRects().length).length"
    with_it = browser.open(path)
    assert with_it.evaluate(shown) == 20
    with_it.check("#every input")
    assert with_it.evaluate(shown) == 24


def test_shapes_of_a_host_have_a_table_too(browser, checkout, tmp_path):
    """They cost nothing, so that no picture of costs can be drawn."""
    one = loaded(checkout, "cubicles-planner")
    limits = ((None, "2", "0.01"), (None,))
    made = compile_application(Inputs.load([one.path])[0])
    assert made.decision.choice.offers.price_usd_per_hour.max() == 0
    assert same_as_menu(browser, one, made, tmp_path / "report.html", limits, ALPHAS[::2])


UNNAMED = """[...document.querySelectorAll('input, button, svg[role=img], img')].filter((node) =>
    !(node.labels?.length || node.getAttribute('aria-label') || node.getAttribute('aria-labelledby') ||
    node.alt || node.textContent.trim())).map((node) => node.id)"""
HOSTILE = "</script><img src=x onerror=alert(1)><!--'\"&"


def test_hostile_names_do_nothing(browser, checkout, tmp_path):
    catalog = tmp_path / "aws.csv"
    written_catalog(catalog, [(f"c6i.{HOSTILE}", 32, 64, 0.3, ""), ("c6i.xlarge", 4, 8, 0.17, "")])
    spec = tmp_path / "specs" / "vslam-recorded.yaml"
    spec.parent.mkdir()
    spec.write_text((checkout / "specs" / "vslam-recorded.yaml").read_text() + f"# {HOSTILE}\n")
    shutil.copytree(checkout / "results" / "vslam-recorded", tmp_path / "results" / "vslam-recorded")
    (one,) = load([str(spec)])
    view = browser.open(written(one, tmp_path / "report.html", str(catalog)))
    move(view, "0.5", None, None)
    assert view.get_attribute("#verdict", "data-chosen") == f"c6i.{HOSTILE}"
    view.click("summary:has-text('Spec')")
    assert f"# {HOSTILE}" in view.inner_text("#evidence")
    assert browser.complaints == []


SCHEMES, WIDTHS = ("light", "dark"), (360, 600, 1280, 1600)
# Every text against what is painted behind it, as WCAG 2 measures contrast: 4.5, and 3 for large text.
FAINT_TEXT = """() => {
    const rgb = (color) => (color.match(/[0-9.]+/g) || []).map(Number);
    const luminance = (c) => c.slice(0, 3).map((v) => v / 255).map((v) => v <= .04045 ? v / 12.92 : ((v + .055) / 1.055) ** 2.4)
        .reduce((sum, v, i) => sum + v * [.2126, .7152, .0722][i], 0);
    const behind = (node) => {
        for (let one = node; one; one = one.parentElement) {
            const color = rgb(getComputedStyle(one).backgroundColor);
            if (color.length && (color.length < 4 || color[3] > 0)) return color;
        }
        return [255, 255, 255];
    };
    const found = [];
    for (const node of document.querySelectorAll('body *:not(script):not(style)')) {
        if (node.closest('svg') || ![...node.childNodes].some((one) => one.nodeType === 3 && one.textContent.trim())) continue;
        const style = getComputedStyle(node), size = parseFloat(style.fontSize);
        if (!node.getClientRects().length) continue;
        const [a, b] = [luminance(rgb(style.color)), luminance(behind(node))].sort((x, y) => y - x);
        const large = size >= 24 || (size >= 18.66 && Number(style.fontWeight) >= 700);
        if ((a + .05) / (b + .05) < (large ? 3 : 4.5)) found.push([node.textContent.slice(0, 40), (a + .05) / (b + .05)]);
    }
    return found;
}"""
# What a pointer must hit: 24 px at least (WCAG 2.5.8), unless it is in a line of text.
SMALL = """() => [...document.querySelectorAll('input, button, summary, nav a')].filter((node) => node.getClientRects().length)
    .filter((node) => { const box = node.getBoundingClientRect(); return box.width < 24 || box.height < 24; })
    .map((node) => [node.id || node.textContent, node.getBoundingClientRect().width, node.getBoundingClientRect().height])"""
CUT = """() => [...document.querySelectorAll('body *')].filter((node) => !node.closest('svg') && node.getClientRects().length)
    .filter((node) => getComputedStyle(node).position !== 'absolute' && !node.closest('thead'))
    .filter((node) => {
        const box = node.getBoundingClientRect(), flow = getComputedStyle(node).overflow;
        return box.right > innerWidth + 1 || box.left < -1 ||
            (node.scrollWidth > node.clientWidth + 1 && flow !== 'visible' && !node.closest('figure'));
    })
    .map((node) => `${node.tagName} ${node.id} ${node.className}: ${node.textContent.slice(0, 40)}`)"""


@pytest.mark.parametrize("name", ["grasp-planning-recorded", "vslam-recorded", "motion-planning-cubicles-recorded"])
def test_nothing_is_cut_faint_or_too_small_at_any_width(browser, checkout, tmp_path, name):
    path = written(loaded(checkout, name), tmp_path / "report.html")
    for scheme, width in itertools.product(SCHEMES, WIDTHS):
        view = browser.open(path, width=width, color_scheme=scheme)
        view.evaluate("for (const one of document.querySelectorAll('details')) one.open = true")
        assert view.evaluate("document.documentElement.scrollWidth") <= width, (scheme, width)
        assert view.evaluate(CUT) == [], (scheme, width)
        assert view.evaluate(FAINT_TEXT) == [], (scheme, width)
        assert view.evaluate(SMALL) == [], (scheme, width)
        assert view.evaluate(UNNAMED) == []
        view.close()
    assert browser.complaints == []


def test_the_answer_stays_in_view_while_a_slider_moves(browser, checkout, tmp_path):
    path = written(loaded(checkout, "motion-planning-cubicles-recorded"), tmp_path / "report.html")
    for width in (360, 1280):
        view = browser.open(path, width=width)
        view.focus("#alpha")
        view.evaluate("document.getElementById('alpha').scrollIntoView({block: 'center'})")
        assert view.inner_text("#verdict").startswith("Same choice: c6i.8xlarge")
        view.keyboard.press("Home")
        box = view.locator("#verdict").bounding_box()
        assert 0 <= box["y"] < 900 - 20
        assert view.inner_text("#verdict").startswith("Changes to ")


def test_it_prints_on_few_pages_without_controls(browser, checkout, tmp_path):
    for name in ("vslam-recorded", "grasp-planning-recorded", "motion-planning-cubicles-recorded"):
        view = browser.open(written(loaded(checkout, name), tmp_path / "report.html"))
        printed = view.pdf(format="A4")
        assert 2 <= len(re.findall(rb"/Type\s*/Page\b", printed)) <= 4, name
        view.emulate_media(media="print")
        assert not view.is_visible("#controls")
        assert view.is_visible("#answer")
        assert view.is_visible("#machines")


# What a text of a picture is high, in px of the screen.
SMALLEST = """() => Math.min(...[...document.querySelectorAll('main svg text')]
    .filter((node) => node.getClientRects().length && node.textContent.trim())
    .map((node) => parseFloat(getComputedStyle(node).fontSize) * node.ownerSVGElement.getScreenCTM().a))"""


def test_on_a_phone_it_is_short_and_its_pictures_can_be_read(browser, checkout, tmp_path):
    path = written(loaded(checkout, "grasp-planning-recorded"), tmp_path / "report.html")
    view = browser.open(path, width=360)
    assert view.evaluate("document.documentElement.scrollHeight") < 5000
    assert view.evaluate(SMALLEST) >= 10
    shown = "[...document.querySelectorAll('#machines tbody tr')].filter((row) => row.getClientRects().length).length"
    assert view.evaluate(shown) == 5
    view.check("#every input")
    assert view.evaluate(shown) == 24
    assert browser.complaints == []


def test_the_limit_on_cost_has_the_unit_of_the_page(browser, checkout, tmp_path):
    view = browser.open(written(loaded(checkout, "grasp-planning-recorded"), tmp_path / "report.html"))
    assert view.input_value("#cost") == "1"
    assert "USD per 1,000 requests" in view.inner_text("#controls")
    assert "--cost '$0.001/request'" in view.inner_text("#command"), "the command has the unit of the spec"
    view.fill("#cost", "0.3")
    assert "--cost '$0.0003/request'" in view.inner_text("#command")
