"""The charts: well-formed, deterministic, safe against names, legible, and stating what they should."""

import itertools
import math
import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import click
import numpy as np
import pytest

from fogspec.base.console import STYLE
from fogspec.base.templates import shipped
from fogspec.base.units import money
from fogspec.charts import model_svg
from fogspec.charts.axes import axis, number, seconds, wide
from fogspec.charts.chart import Chart, Crowd, PlottedMachine, per_hour
from fogspec.charts.frame import clipped
from fogspec.charts.menu_svg import draw, panel
from fogspec.charts.model_svg import Series, SizeChart, Sized, title_of
from fogspec.charts.terminal import plot
from fogspec.charts.text import LABEL, shortened, width, wrapped

ROOT = Path(__file__).parents[3]
CHARTS = sorted([*ROOT.glob("compiled/*-recorded/*.svg"), ROOT / "docs/figures/menu.svg"])

HOSTILE = [
    '"><script>alert(1)</script>&]]>',
    "c6i." + "very-long-name-" * 14,
    "אבגדה-מכונה.xlarge",
    "m\\x1b[31m.large",
    "計算機-大型.xlarge",
    "M" * 200,
]


def machine(name: str, y: float, cost: float, price: float = 1.0, **more) -> PlottedMachine:
    return PlottedMachine(name=name, y=y, cost_usd_per_request=cost, price_usd_per_hour=price, **more)


FRONT = [
    machine("g4dn.xlarge", 1.65, 0.00024, 0.526, low=1.58, high=1.73, low_cost=0.00023, high_cost=0.00025, measured=True,
            gpu=True, on_front=True, on_hourly_front=True, role="chosen", row=0),
    machine("c6i.large", 16.4, 0.0002, 0.085, low=15.0, high=18.0, measured=True, meets=False, on_front=True,
            on_hourly_front=True, role="ruled out", row=1),
    machine("m6i.large", 3.1, 0.0004, 0.096, row=2),
]  # fmt: skip


def chart(machines=FRONT, **more):
    columns = [np.array([getattr(m, name) for m in machines]) for name in
               ("y", "cost_usd_per_request", "price_usd_per_hour")]  # fmt: skip
    crowd = Crowd(*columns, meets=np.array([m.meets for m in machines], dtype=bool))
    fixed = {
        "title": "g4dn.xlarge is best",
        "facts": "3 machines",
        "source": "Prices: AWS, 2025-03-02.",
        "y_label": "mean latency",
    }
    return Chart(machines=machines, crowd=crowd, **{**fixed, **more})


def nodes(svg: str, kind: str) -> list[ElementTree.Element]:
    return [node for node in ElementTree.fromstring(svg).iter() if kind in (node.get("class") or "").split()]


def texts(svg: str) -> list[str]:
    return ["".join(node.itertext()) for node in ElementTree.fromstring(svg).iter() if node.tag.endswith("text")]


def numbers(text: str) -> list[float]:
    return [float(one) for one in re.findall(r"-?[\d.]+", text)]


def label_boxes(svg: str) -> list[tuple[float, float, float, float]]:
    """The labels' boxes: all begin at x, and are as wide as the table of widths says."""
    found = []
    for node in nodes(svg, "label"):
        assert node.get("text-anchor") == "start"
        of_limit = "label-of-limit" in node.get("class")
        x, y, long = (
            float(node.get("x")),
            float(node.get("y")),
            width(node.text, 12.5 if of_limit else LABEL, bold=not of_limit),
        )
        found.append((x, y - 10, x + long, y + 2))
    return found


def mark_boxes(svg: str) -> list[tuple[float, float, float, float]]:
    found = []
    for node in nodes(svg, "mark"):
        if node.find("{http://www.w3.org/2000/svg}title") is None:
            continue  # the legend's
        if node.get("cx"):
            x, y, r = (float(node.get(one)) for one in ("cx", "cy", "r"))
        else:
            x, top, r = numbers(node.get("d"))[:3]
            y = top + r
        found.append((x - r, y - r, x + r, y + r))
    return found


def overlap(one, other) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def assert_labels_touch_nothing(svg: str) -> int:
    """No label touches a mark, a limit, another label or the edge of the drawing; the number of labels."""
    labels, marks = label_boxes(svg), mark_boxes(svg)
    limits = [tuple(numbers(node.get("d"))) for node in nodes(svg, "limit")]
    leaders = [tuple(numbers(node.get("d"))) for node in nodes(svg, "leader")]
    for i, one in enumerate(labels):
        assert 60 < one[0] < one[2] < 706
        assert not any(overlap(one, other) for other in labels[:i])
        assert not any(overlap(one, mark) for mark in marks)
        assert not any(clipped(line, one) for line in limits)
    for line in leaders:
        assert sum(clipped(line, one) is not None for one in labels) <= 1, "a leader ends at its own label"
    return len(labels)


def test_it_is_well_formed_names_the_choice_and_has_no_script():
    svg = draw(chart(y_limits=[("latency", 2.0)], cost_limit_usd_per_request=0.0005, notes=["extrapolated"]))
    assert {"g4dn.xlarge is best", "g4dn.xlarge", "latency limit 2 s", "cost limit $0.50", "⚠ extrapolated"} <= set(
        texts(svg)
    )
    assert "Prices: AWS, 2025-03-02." in texts(svg)
    assert "<script" not in svg
    assert len(nodes(svg, "limit")) == 2
    assert len(nodes(svg, "feasible")) == 1


def test_every_warning_is_in_the_picture_and_in_its_text_alternative():
    notes = [f"warning number {n}" for n in range(7)]
    svg = draw(chart(notes=notes))
    summary = ElementTree.fromstring(svg).find("{http://www.w3.org/2000/svg}desc").text
    for note in notes:
        assert f"⚠ {note}" in texts(svg)
        assert note in summary


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_and_marks_have_the_contrast_that_wcag_asks_for(scheme):
    style = (shipped("templates") / "picture_style.j2").read_text()
    blocks = re.findall(r"svg \{ (--ink[^}]*)", style)
    colors = dict(re.findall(r"--([\w-]+): (#\w{6})", blocks[scheme == "dark"]))

    def luminance(color: str) -> float:
        channels = [int(color[i : i + 2], 16) / 255 for i in (1, 3, 5)]
        linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
        return float(np.dot(linear, (0.2126, 0.7152, 0.0722)))

    def contrast(one: str, other: str) -> float:
        high, low = sorted((luminance(colors[one]), luminance(colors[other])), reverse=True)
        return (high + 0.05) / (low + 0.05)

    for behind in ("page", "feasible"):
        for text in ("ink", "soft", "choice", "broken", "gpu-1", "gpu-2", "gpu-3"):
            assert contrast(text, behind) >= 4.5, (text, behind)
        assert contrast("misses", behind) >= 3


def test_measured_is_filled_predicted_hollow_and_gpus_are_diamonds():
    marks = [node for node in nodes(draw(chart()), "mark") if node.get("data-row")]
    by_row = {node.get("data-row"): node for node in marks}
    assert by_row["0"].tag.endswith("path")
    assert "measured" in by_row["0"].get("class").split()
    assert by_row["2"].tag.endswith("circle")
    assert "predicted" in by_row["2"].get("class").split()


def test_an_interval_is_drawn_where_cost_follows_latency():
    svg = draw(chart(cost_limit_usd_per_request=0.001))
    (bar,) = (numbers(node.get("d")) for node in nodes(svg, "bar") if node.get("data-bar") == "0")
    assert bar[0] < bar[2], "a longer request costs more"
    assert bar[1] > bar[3]
    upright = [replace(FRONT[0], low_cost=0.00024, high_cost=0.00024), FRONT[2]]
    (bar,) = (numbers(node.get("d")) for node in nodes(draw(chart(upright)), "bar") if node.get("data-bar") == "0")
    assert bar[0] == bar[2], "a provisioned machine costs the same"


def test_a_machine_on_the_iso_line_is_as_good_as_the_choice():
    """0.5 y / 2 + 0.5 cost / 0.001, of the choice 0.5325."""
    value = 0.5 * 1.65 / 2 + 0.5 * 0.00024 / 0.001
    svg = draw(
        chart(iso=(value * 2 / 0.5, value * 0.001 / 0.5), y_limits=[("latency", 2.0)], cost_limit_usd_per_request=0.001)
    )
    (iso,) = (numbers(node.get("d")) for node in nodes(svg, "iso") if len(numbers(node.get("d"))) > 8)
    points = list(zip(iso[::2], iso[1::2], strict=True))
    left, top, right, bottom = next(box for node, box in zip(nodes(svg, "mark"), mark_boxes(svg), strict=False)
                                    if node.get("data-row") == "0")  # fmt: skip
    x, y = (left + right) / 2, (top + bottom) / 2
    near = min(math.hypot(px - x, py - y) for px, py in points)
    assert near < 10, "it goes through the choice"


def test_what_is_off_scale_is_counted():
    far = [*FRONT, machine("slow", 900.0, 0.0003, meets=False, row=3), machine("dear", 1.0, 0.9, meets=False, row=4)]
    svg = draw(chart(far, y_limits=[("latency", 2.0)], cost_limit_usd_per_request=0.001))
    assert "off scale: 2 slower (up to 900 s), 1 more expensive" in texts(svg)
    assert not [node for node in nodes(svg, "mark") if node.get("data-row") in ("3", "4")]


def test_a_limit_off_scale_is_named_and_not_drawn_at_the_edge():
    svg = draw(chart(y_limits=[("latency", 1e6)]))
    assert "off scale: latency limit 1,000,000 s" in texts(svg)
    assert not nodes(svg, "limit")


def test_the_feasible_area_fills_the_picture():
    """At least a quarter of the panel, whatever the machines off scale are."""
    far = [*FRONT, machine("slow", 1e5, 0.03, meets=False, row=3), machine("dear", 1.5, 9.0, meets=False, row=4)]
    svg = draw(chart(far, y_limits=[("latency", 2.0)], cost_limit_usd_per_request=0.001))
    (area,) = (numbers(node.get("d")) for node in nodes(svg, "feasible"))
    wide_, high = max(area[::2]) - min(area[::2]), max(area[1::2]) - min(area[1::2])
    assert wide_ * high > 0.15 * 638 * 302


def test_it_follows_light_and_dark():
    assert "prefers-color-scheme: dark" in draw(chart())


def test_the_same_machines_give_the_same_picture_in_any_order():
    forwards = chart()
    assert draw(forwards) == draw(replace(forwards, machines=[*reversed(FRONT)]))


@pytest.mark.parametrize("name", HOSTILE, ids=["markup", "long", "right-to-left", "escape", "wide", "widest"])
def test_hostile_names_stay_text_and_keep_their_place(name):
    machines = [replace(FRONT[0], name=name), replace(FRONT[1], y=1.8, name=name[::-1]), FRONT[2]]
    rows = [("ruled out", f"{name}: 1.8 s")]
    svg = draw(chart(machines, title=f"{name} is the best", rows=rows, notes=[name], y_limits=[(name[:20], 2.0)]))
    assert "<script" not in svg
    shown = " ".join(texts(svg))
    assert name[:4] in shown
    assert assert_labels_touch_nothing(svg) >= 2
    for node in ElementTree.fromstring(svg).iter():
        if node.tag.endswith("text") and "label" not in (node.get("class") or ""):
            size, bold = (18.0, True) if node.get("class") == "head" else (12.5, node.get("class") == "bold")
            assert width("".join(node.itertext()), size, bold=bold) <= 700
    series = Series(name=name, has_gpu=True, machines=[Sized(name=name, vcpus=2, value=1.0, chosen=True)])
    of_size = model_svg.draw(
        SizeChart(what="latency", y_label=name, series=[series], words=seconds, notes=[name], facts=name)
    )
    assert "<script" not in of_size
    assert_labels_touch_nothing(of_size)


@pytest.mark.parametrize("seed", range(60))
def test_labels_touch_nothing(seed):
    """Machines anywhere, crowded or not, with short and long names, with limits through the middle of them."""
    random = np.random.default_rng(seed)
    count, spread = int(random.integers(3, 60)), float(random.choice([0.02, 0.2, 0.8]))
    y, price = np.exp(random.normal(0, spread, count)), np.exp(random.normal(0, spread, count))
    roles = ["chosen", "runner-up", "ruled out"]
    machines = [
        machine(
            f"{'a-rather-long-name-' if seed % 3 else 'c6i.'}{i}", float(y[i]), float(y[i] * price[i] / 3600), float(price[i]),
            low=float(y[i] * 0.9), high=float(y[i] * 1.1), low_cost=float(0.9 * y[i] * price[i] / 3600),
            high_cost=float(1.1 * y[i] * price[i] / 3600), measured=bool(i % 2), gpu=i % 5 == 0, meets=y[i] < 1.1,
            role=roles[i] if i < 3 else "", row=i,
        )
        for i in range(count)
    ]  # fmt: skip
    limits = {"y_limits": [("latency", 1.1)], "cost_limit_usd_per_request": 1 / 3600} if seed % 4 else {}
    price_limit = {"price_limit_usd_per_hour": 1.05} if seed % 5 == 0 else {}
    found = assert_labels_touch_nothing(draw(chart(machines, **limits, **price_limit)))
    assert found >= 1 or spread == 0.02, "only where machines leave no room is there no label"


@pytest.mark.parametrize("path", CHARTS, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_labels_of_the_charts_in_the_repository_cross_no_interval(path):
    svg = path.read_text()
    assert assert_labels_touch_nothing(svg) >= 2
    intervals = [tuple(numbers(node.get("d"))) for node in nodes(svg, "bar") if node.get("data-bar")]
    assert len(intervals) > 5
    assert not [(label, line) for label in label_boxes(svg) for line in intervals if clipped(line, label)]
    leaders = [tuple(numbers(node.get("d"))) for node in nodes(svg, "leader")]
    assert not [line for line in leaders if sum(clipped(line, mark) is not None for mark in mark_boxes(svg)) > 1]


@pytest.mark.parametrize("apart", [1.0, 1.05, 1.4, 3.0])
def test_the_choice_is_labelled_even_beside_its_likes(apart):
    near = [
        machine(f"a-rather-long-machine-{role}", apart**i, 0.001 * apart**i, apart**i, measured=True, role=role, row=i)
        for i, role in enumerate(("chosen", "cheapest", "fastest"))
    ]
    svg = draw(chart(near))
    assert assert_labels_touch_nothing(svg) == (3 if apart < 3 else 2), "the third is off scale"
    assert len(nodes(svg, "label-chosen")) == 1


def test_the_label_of_a_machine_that_misses_a_limit_is_gray_as_its_mark():
    misses = machine("two", 1.5, 0.002, 2.0, meets=False, role="ruled out", row=1)
    svg = draw(chart([machine("one", 1.0, 0.001, 1.0, role="chosen", row=0), misses]))
    assert ["".join(node.itertext()) for node in nodes(svg, "label-misses")] == ["two"]


def test_one_machine_is_drawn_with_ticks_and_none_is_refused():
    svg = draw(chart(FRONT[:1]))
    assert "1 machine drawn" in svg
    assert len([t for t in texts(svg) if re.fullmatch(r"\$[\d.]+", t)]) >= 2
    with pytest.raises(ValueError, match="without machines"):
        draw(chart([]))


def test_all_machines_equal_is_drawn():
    same = [machine(f"m{i}", 1.25, 0.00125, 3.6) for i in range(50)]
    svg = draw(chart(same))
    assert not nodes(svg, "speck"), "the marks cover them"
    ElementTree.fromstring(svg)


def test_interval_bars_stay_inside_the_frame():
    wild = [
        machine(
            "wild", 1.0, 0.001, low=1e-6, high=1e6, low_cost=1e-9, high_cost=1e3, measured=True, role="chosen", row=0
        ),
        machine("other", 2.0, 0.002, row=1),
    ]
    (bar,) = (numbers(node.get("d")) for node in nodes(draw(chart(wild)), "bar") if node.get("data-bar"))
    assert all(66 <= x <= 704 for x in bar[::2])
    assert all(0 < y < 500 for y in bar[1::2])


def test_without_limits_nothing_is_said_to_meet_or_miss_them():
    svg = draw(chart(FRONT[:1]))
    assert not {"misses a limit"} & set(texts(svg))
    assert not nodes(svg, "feasible")
    assert not any("limit" in line for line in plot(chart(FRONT[:1]), 80))


def test_the_rows_keep_clear_of_the_longest_role():
    rows = [("nearest in metrics.path_length", "c6i.large, 2 vCPU")]
    found = ElementTree.fromstring(draw(chart(FRONT[:1], rows=rows))).iter()
    starts = {node.text: float(node.get("x")) for node in found if node.tag.endswith("text")}
    assert starts["c6i.large, 2 vCPU"] >= starts[rows[0][0]] + width(rows[0][0], bold=True) + 6


def test_a_hundred_thousand_machines_stay_a_small_file():
    random = np.random.default_rng(0)
    n = 100_000
    latency, price = np.exp(random.normal(0, 1.5, n)), np.exp(random.normal(0, 2, n))
    crowd = Crowd(latency, latency * price / 3600, price, latency < 1)
    svg = draw(Chart(title="many", y_label="mean latency", machines=[], crowd=crowd))
    assert len(svg) < 100_000
    assert "100,000 machines" in svg


def test_the_cost_limit_is_a_slope_against_the_price_per_hour():
    one = chart(cost_limit_usd_per_request=0.0004)
    svg = panel(one, per_hour(one), near=False, id="hourly")
    (sloped,) = (numbers(node.get("d")) for node in nodes(svg, "limit") if node.get("data-limit") == "cost")
    assert sloped[0] != sloped[2]
    assert sloped[1] != sloped[3]


def sized(levels, **more):
    return [Sized(name=f"m{v:g}-{i}", vcpus=v, value=value, **more) for i, (v, value) in enumerate(levels)]


def by_size(*series, **more):
    fixed = {"what": "latency", "y_label": "mean latency", "words": seconds, "facts": "12 machines"}
    return SizeChart(series=series, **{**fixed, **more})


@pytest.mark.parametrize(
    ("plain", "gpu", "title"),
    [
        (
            [(2, 16.0), (4, 8.0), (32, 1.8)],
            [(4, 1.65), (8, 1.7)],
            "With a T4, 4 vCPUs are as fast as any CPU-only machine",
        ),
        ([(2, 16.0), (4, 8.0), (32, 1.8)], [(4, 5.0)], "Latency falls 1.7 × with each doubling of vCPUs"),
        ([(2, 16.0), (4, 8.0), (8, 7.9), (16, 7.8)], [], "Latency falls 2.0 × with each doubling of vCPUs, up to 4"),
        ([(2, 0.2), (16, 0.026), (64, 0.04)], [], "More than 16 vCPUs make this application slower"),
        ([(2, 1.0), (16, 1.02), (64, 0.98)], [], "More vCPUs do not change the latency"),
        ([(4, 1.0)], [], "Latency of machines with 4 vCPUs"),
    ],
)
def test_the_title_of_latency_by_vcpus_is_the_finding(plain, gpu, title):
    series = [Series(name="no GPU", has_gpu=False, machines=sized(plain))]
    series += [Series(name="1 T4", has_gpu=True, machines=sized(gpu))] if gpu else []
    assert title_of(by_size(*series)) == title


def test_latency_by_vcpus_is_one_panel_with_all_accelerators_the_limit_and_the_choice():
    plain = [*sized([(2, 16.0), (2, 15.0), (16, 2.3)], measured=True), *sized([(8, 4.0)], low=3.0, high=5.0)]
    gpus = [Sized(name="g4dn.xlarge", vcpus=4, value=1.65, measured=True, chosen=True), *sized([(8, 1.7)])]
    series = (Series(name="no GPU", has_gpu=False, machines=plain), Series(name="1 T4", has_gpu=True, machines=gpus))
    svg = model_svg.draw(by_size(*series, limit=2.0))
    assert {"no GPU", "1 T4", "g4dn.xlarge", "latency limit 2 s"} <= set(texts(svg))
    assert assert_labels_touch_nothing(svg) == 4
    assert len(nodes(svg, "limit")) == 1
    assert len(mark_boxes(svg)) == 6
    at_two = sorted(box for box in mark_boxes(svg) if box[2] < 200)
    assert not overlap(*at_two), "equal numbers of vCPUs are side by side"
    with pytest.raises(ValueError, match="no model"):
        model_svg.draw(by_size())


@pytest.mark.parametrize("count", [9, 40, 300])
def test_many_machines_of_one_size_stay_inside_the_frame(count):
    many = Series(
        name="no GPU", has_gpu=False, machines=sized([(8, 1.0 + i / count) for i in range(count)] + [(2, 4.0)])
    )
    svg = model_svg.draw(by_size(many))
    assert all(66 <= box[0] < box[2] <= 704 for box in mark_boxes(svg))
    assert len(svg) < 60_000


@pytest.mark.parametrize("values", [[1.25], [7.3], [2.05, 2.1], [0.001, 1000], [1e-9, 1e9], [99, 101]])
def test_every_axis_has_ticks_that_do_not_touch(values):
    found = axis(values, 80, 740)
    ticks = found.ticks(money, wide)
    assert ticks
    for (a, one), (b, other) in itertools.pairwise(ticks):
        assert b - a >= (wide(one) + wide(other)) / 2


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.00024, "$0.00024"), (0.5, "$0.50"), (2.4, "$2.40"), (0.526, "$0.526"), (12.0, "$12.00"), (384.71, "$385"),
     (3.1e-7, "$0.00000031"), (0.44499999999999995, "$0.445"), (1234567.0, "$1,234,567"), (0.0, "$0")],
)  # fmt: skip
def test_money_has_three_digits_and_no_exponent(value, text):
    assert money(value) == text


@pytest.mark.parametrize(
    ("value", "text"), [(0.0258, "25.8 ms"), (1.648, "1.65 s"), (0.9999, "1 s"), (3.4e-5, "34 µs"), (1234.0, "1,234 s")]
)
def test_seconds(value, text):
    assert seconds(value) == text


def test_numbers_have_no_exponent_where_that_is_short():
    assert number(33.333) == "33.3"
    assert number(123456.0) == "123,456"


def test_text_is_shortened_in_its_middle_and_wrapped_at_words():
    assert shortened("c6i.large", 200) == "c6i.large"
    cut = shortened("c6i." + "x" * 100 + ".metal", 150)
    assert cut.startswith("c6i.")
    assert cut.endswith("metal")
    assert width(cut) <= 150
    lines = wrapped("one two three four five six seven", 80, most=2)
    assert len(lines) == 2
    assert lines[1].endswith("…")
    assert all(width(text) <= 80 for text in lines)


@pytest.mark.parametrize("columns", [20, 44, 60, 80, 102, 120, 200])
def test_in_plain_characters_every_line_fits_and_the_choice_is_there(columns):
    lines = plot(chart(y_limits=[("latency", 2.0)], cost_limit_usd_per_request=0.001), columns)
    assert max(map(len, lines)) <= max(columns, 74), "the key is as wide as the narrowest sensible terminal needs"
    assert sum(line.count("@") for line in lines) == 3, "both views, and the key"
    assert any("%" in line for line in lines[:15])
    assert all(line.isascii() for line in lines)


def test_colour_only_adds_colour():
    plain = plot(chart(y_limits=[("latency", 2.0)]), 80)
    colored = plot(chart(y_limits=[("latency", 2.0)]), 80, color=True)
    assert STYLE.search("".join(colored))
    assert [click.unstyle("".join(STYLE.split(line)[::2])).rstrip() for line in colored] == plain


def test_one_machine_in_plain_characters():
    assert any("@" in line for line in plot(chart(FRONT[:1]), 60))
