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
    const rows = [...document.querySelectorAll('#candidates tr[data-roles]')];
    const roles = rows.flatMap((row) => row.dataset.roles.split(' ').map((role) => [role, Number(row.dataset.row)]));
    const answer = Object.fromEntries(roles);
    return [answer, document.getElementById('verdict').textContent];
}"""


def move(view, alpha: str, latency: str | None, cost: str | None) -> tuple[dict[str, int], str]:
    """Set the controls, with the events of a person who does, and read the answer; the cost is per request."""
    per_1000 = None if cost is None else f"{1000 * float(cost):.12g}"
    return tuple(view.evaluate(MOVE, [alpha, {"latency": latency, "cost": per_1000}]))


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


LIMITS_DRAWN = (
    "[...document.querySelectorAll('#stage svg.wide:not([hidden]) .limit')]"
    ".filter((one) => one.getAttribute('d')).length"
)


def test_a_limit_is_drawn_where_it_is_or_not_at_all(browser, checkout, tmp_path):
    """One beyond the picture is not drawn at its edge, where the scale would say something else of it."""
    view = browser.open(written(loaded(checkout, "grasp-planning-recorded"), tmp_path / "report.html"))
    for latency, drawn in (("2", 1), ("100000", 0), ("0.000001", 0)):
        move(view, "0.7", latency, None)
        assert view.evaluate(LIMITS_DRAWN) == drawn, latency


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
    assert view.evaluate("document.activeElement.closest('#strip, #back') !== null"), "then the weights' winners"
    view.focus("#latency-use")
    view.keyboard.press("Space")
    assert "--latency none" in view.inner_text("#command")


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
    view.click("#spec summary")
    assert f"# {HOSTILE}" in view.inner_text("#spec")
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
    .filter((node) => !node.closest('.skip') && getComputedStyle(node).position !== 'absolute' && !node.closest('thead'))
    .filter((node) => {
        const box = node.getBoundingClientRect(), flow = getComputedStyle(node).overflow;
        return box.right > innerWidth + 1 || box.left < -1 ||
            (node.scrollWidth > node.clientWidth + 1 && flow !== 'visible' && !node.closest('#strip'));
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
        view.keyboard.press("End")
        box = view.locator("#verdict").bounding_box()
        assert 0 <= box["y"] < 900 - 20
        said = view.inner_text("#verdict")
        assert said.startswith("Changes to ")
        assert "measured" in said


def test_the_state_is_in_the_address(browser, checkout, tmp_path):
    path = written(loaded(checkout, "vslam-recorded"), tmp_path / "report.html")
    view = browser.open(path)
    move(view, "0.2", "0.05", None)
    view.check("#all")
    address, said = view.url, view.inner_text("#verdict")
    assert "#a=0.2&l=0.05&c=none&v=all" in address
    again = browser.open(path)
    again.goto(address)
    again.reload()
    assert again.inner_text("#verdict") == said
    assert again.is_checked("#all")
    for damaged in ("#a=2&l=-1&c=x&v=y", "#a=&l=&c=&v=", "#menu", "#a=%3Cscript%3E"):
        other = browser.open(path)
        other.goto(path.as_uri() + damaged)
        other.reload()
        assert other.inner_text("#verdict").startswith("Same choice")
    assert browser.complaints == []


def test_marks_have_cards_for_pointer_and_keyboard_and_two_are_compared(browser, checkout, tmp_path):
    view = browser.open(written(loaded(checkout, "grasp-planning-recorded"), tmp_path / "report.html"), width=1280)
    view.focus("#chart-near .mark[tabindex='0']")
    assert "g4dn.xlarge" in view.inner_text("#card")
    view.keyboard.press("ArrowRight")
    second = view.inner_text("#card")
    assert "g4dn.xlarge (" not in second
    assert view.evaluate("document.querySelectorAll('#candidates tr.lit').length") == 1
    view.keyboard.press("Enter")
    assert "against g4dn.xlarge" in view.inner_text("#compare")
    view.locator("#candidates tbody tr").nth(4).click()
    assert view.evaluate("document.querySelectorAll('#candidates tr.pinned').length") == 2
    assert view.evaluate("document.querySelectorAll('#chart-near .mark.pinned').length") >= 1
    view.hover("#chart-near .mark.chosen")
    assert view.is_visible("#card")
    assert browser.complaints == []


def test_candidates_are_sorted_and_filtered(browser, checkout, tmp_path):
    view = browser.open(written(loaded(checkout, "grasp-planning-recorded"), tmp_path / "report.html"), width=1280)
    rows = "[...document.querySelectorAll('#candidates tbody tr')].map((row) => row.cells[0].textContent.split(' ')[0])"
    assert len(view.evaluate(rows)) == 24
    view.click("#candidates thead button:has-text('per hour')")
    assert view.evaluate(rows)[0] == "c6i.large"
    view.click("#candidates thead button:has-text('per hour')")
    assert view.evaluate(rows)[-1] == "c6i.large"
    assert view.get_attribute("#candidates th[aria-sort]", "aria-sort") == "descending"
    view.fill("#filter", "T4")
    assert {name.partition(".")[0] for name in view.evaluate(rows)} == {"g4dn"}
    view.fill("#filter", "")
    view.check("#only-meets")
    assert len(view.evaluate(rows)) == 3


def test_a_limit_is_dragged(browser, checkout, tmp_path):
    view = browser.open(written(loaded(checkout, "grasp-planning-recorded"), tmp_path / "report.html"), width=1280)
    before = float(view.input_value("#latency-number"))
    view.locator("#stage").scroll_into_view_if_needed()
    box = view.locator("#chart-near .drag[data-limit=latency]").bounding_box()
    x, y = box["x"] + 0.55 * box["width"], box["y"] + box["height"] / 2
    view.mouse.move(x, y)
    view.mouse.down()
    view.mouse.move(x, y - 60, steps=4)
    view.mouse.up()
    assert float(view.input_value("#latency-number")) > before
    assert "Same choice" in view.inner_text("#verdict")


def test_it_prints_without_controls(browser, checkout, tmp_path):
    view = browser.open(written(loaded(checkout, "vslam-recorded"), tmp_path / "report.html"))
    view.emulate_media(media="print")
    assert not view.is_visible("#controls")
    assert view.is_visible("#answer")
    assert view.is_visible("#candidates")


# What a text of a chart is high, in px of the screen.
SMALLEST = """() => Math.min(...[...document.querySelectorAll('main svg text')]
    .filter((node) => node.getClientRects().length && node.textContent.trim())
    .map((node) => parseFloat(getComputedStyle(node).fontSize) * node.ownerSVGElement.getScreenCTM().a))"""
CROSSED = """() => [...document.querySelectorAll('main svg')].filter((svg) => svg.getClientRects().length).flatMap((svg) =>
    [...svg.querySelectorAll('.label-of-limit')].filter((node) => node.textContent).flatMap((node) => {
        const box = node.getBBox();
        return [...svg.querySelectorAll('.bar, .limit[d*=" "]')].filter((bar) => [...Array(201).keys()].some((i) => {
            const at = bar.getPointAtLength(i / 200 * bar.getTotalLength());
            return at.x > box.x && at.x < box.x + box.width && at.y > box.y && at.y < box.y + box.height;
        })).map(() => node.textContent);
    }))"""


LABELS = """() => [...document.querySelectorAll('main svg .label-of-limit')]
    .filter((node) => node.getClientRects().length && node.textContent).length"""


def test_on_a_phone_it_is_short_and_its_charts_can_be_read(browser, checkout, tmp_path):
    path = written(loaded(checkout, "grasp-planning-recorded"), tmp_path / "report.html")
    view = browser.open(path, width=360)
    assert view.evaluate("document.documentElement.scrollHeight") < 6500, "it had 12,800 px with everything unfolded"
    assert view.evaluate("getComputedStyle(document.getElementById('answer')).gridTemplateColumns").count("px") == 2
    assert view.evaluate(SMALLEST) >= 10
    rows = "[...document.querySelectorAll('#candidates tbody tr')].filter((row) => row.getClientRects().length).length"
    assert view.evaluate(rows) == 5
    view.click("#more")
    assert view.evaluate(rows) == 24
    view.click("#more")
    assert view.evaluate(rows) == 5
    view.fill("#filter", "T4")
    assert not view.is_visible("#more"), "there is nothing more to show"
    view.check("#all")
    assert view.evaluate("document.querySelector('#stage svg.narrow:not([hidden])').dataset.view") == "chart-all"
    view.close()
    view = browser.open(path, width=1280)
    assert not view.is_visible("#more")
    assert view.evaluate(rows) == 24
    assert view.evaluate("document.querySelectorAll('svg.narrow').length") > 3
    assert not view.is_visible("svg.narrow >> nth=0")
    assert browser.complaints == []


@pytest.mark.parametrize("name", LIMITS)
def test_the_label_of_a_limit_crosses_no_interval_and_no_limit(browser, checkout, tmp_path, name):
    path = written(loaded(checkout, name), tmp_path / "report.html")
    for width in WIDTHS:
        view = browser.open(path, width=width)
        for chart in ("near", "all", "per-hour"):
            view.check(f"#{chart}")
            assert view.evaluate(CROSSED) == [], (width, chart)
            assert view.evaluate(LABELS) >= 3 if chart == "near" else 1, (width, chart)
        view.close()


def test_what_is_folded_is_printed(browser, checkout, tmp_path):
    view = browser.open(written(loaded(checkout, "vslam-recorded"), tmp_path / "report.html"))
    assert not view.is_visible("#samples table")
    view.evaluate("dispatchEvent(new Event('beforeprint'))")
    assert view.is_visible("#samples table")
    view.evaluate("dispatchEvent(new Event('afterprint'))")
    assert not view.is_visible("#samples table")


def test_the_limit_on_cost_has_the_unit_of_the_page(browser, checkout, tmp_path):
    view = browser.open(written(loaded(checkout, "grasp-planning-recorded"), tmp_path / "report.html"))
    assert view.input_value("#cost-number") == "1"
    assert "USD per 1,000 requests" in view.inner_text("#controls")
    assert "--cost '$0.001/request'" in view.inner_text("#command"), "the command has the unit of the spec"
    view.fill("#cost-number", "0.3")
    assert "--cost '$0.0003/request'" in view.inner_text("#command")
    assert "&c=0.0003&" in view.url
