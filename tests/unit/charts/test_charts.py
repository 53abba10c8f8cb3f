"""The pictures: well-formed, deterministic, safe against names, legible, and saying what they should."""

import itertools
import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import click
import numpy as np
import pytest

from fogspec.base.console import STYLE
from fogspec.base.units import short_dollars
from fogspec.charts import model_svg
from fogspec.charts.axes import axis, requests_unit, seconds, wide
from fogspec.charts.chart import Chart, Crowd, PlottedMachine
from fogspec.charts.menu_svg import draw
from fogspec.charts.model_svg import LatencyChart, Level, Panel, Sample
from fogspec.charts.terminal import plot

FRONT = [
    PlottedMachine(
        name="g4dn.xlarge",
        y=1.65,
        cost_usd_per_request=0.00024,
        price_usd_per_hour=0.526,
        low=1.58,
        high=1.73,
        measured=True,
        on_front=True,
        on_hourly_front=True,
        role="chosen",
        words="g4dn.xlarge, 4 vCPU",
    ),
    PlottedMachine(
        name="c6i.large",
        y=16.4,
        cost_usd_per_request=0.0002,
        price_usd_per_hour=0.085,
        low=15.0,
        high=18.0,
        measured=True,
        on_front=True,
        on_hourly_front=True,
        role="cheapest",
        words="c6i.large, 2 vCPU",
    ),
    PlottedMachine(name="m6i.large", y=16.1, cost_usd_per_request=0.0004, price_usd_per_hour=0.096),
]


def chart(machines=FRONT, **more):
    columns = [np.array([getattr(m, name) for m in machines]) for name in
               ("y", "cost_usd_per_request", "price_usd_per_hour")]  # fmt: skip
    crowd = Crowd(*columns, meets=np.arange(len(machines)) % 2 == 0)
    return Chart(
        title="grasp-planning",
        subtitle="0.70 latency + 0.30 cost",
        y_label="mean latency",
        machines=machines,
        crowd=crowd,
        **more,
    )


def nodes(svg: str, kind: str) -> list[ElementTree.Element]:
    return [node for node in ElementTree.fromstring(svg).iter() if kind in (node.get("class") or "").split()]


def texts(svg: str) -> list[str]:
    return [node.text or "" for node in ElementTree.fromstring(svg).iter() if node.text]


def boxes(svg: str) -> list[tuple[float, float, float, float]]:
    """The labels' boxes, from their anchors and a width that is wide enough for any font of the style."""
    found = []
    for node in nodes(svg, "label"):
        x, y, width = float(node.get("x")), float(node.get("y")), 6.6 * len(node.text)
        left = {"start": x, "end": x - width, "middle": x - width / 2}[node.get("text-anchor")]
        found.append((left, y - 10, left + width, y + 2))
    return found


def overlap(one, other) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def test_it_is_well_formed_names_the_choice_twice_and_has_no_script():
    svg = draw(chart(y_limit=2.0, cost_limit_usd_per_request=0.001, notes=["extrapolated"]))
    words = texts(svg)
    assert words.count("chosen: g4dn.xlarge") == 2, "per request and per hour"
    assert "g4dn.xlarge, 4 vCPU" in words
    assert "extrapolated" in words
    assert "<script" not in svg
    assert len(nodes(svg, "limit")) == 4, "both limits in both parts"


def test_it_follows_light_and_dark():
    assert "prefers-color-scheme: dark" in draw(chart())


def test_the_same_machines_give_the_same_picture_in_any_order():
    forwards = chart()
    backwards = replace(forwards, machines=[*reversed(FRONT)])
    drawn = [re.sub(r"<text [^>]*(role-|sub)[^\n]*", "", draw(one)) for one in (forwards, backwards)]
    assert drawn[0] == drawn[1], "but for the list above it, which has the order given"


def test_hostile_names_stay_text():
    name = '"><script>alert(1)</script>&]]>'
    svg = draw(
        chart(
            [
                PlottedMachine(
                    name=name, y=1.0, cost_usd_per_request=0.001, price_usd_per_hour=1.0, role="chosen", words=name
                )
            ],
            notes=[name],
        )
    )
    assert "<script" not in svg
    assert f"chosen: {name}" in texts(svg)
    panel = Panel(heading=name, levels=[Level(2, 1.0)], samples=[Sample(name, 2, 1.0)])
    assert "<script" not in model_svg.draw(
        LatencyChart(title=name, subtitle=name, y_label=name, panels=[panel], notes=[name])
    )


@pytest.mark.parametrize("apart", [1.0, 1.05, 1.4, 3.0])
def test_labels_never_overlap_and_stay_inside(apart):
    near = [
        PlottedMachine(
            name=f"a-rather-long-machine-{role}",
            y=apart**i,
            cost_usd_per_request=0.001 * apart**i,
            price_usd_per_hour=apart**i,
            measured=True,
            role=role,
        )
        for i, role in enumerate(("chosen", "cheapest", "fastest"))
    ]
    found = boxes(draw(chart(near)))
    assert len(found) == 6
    for i, one in enumerate(found):
        assert 60 < one[0] < one[2] < 760
        assert not any(overlap(one, other) for other in found[:i])


def test_one_machine_is_drawn_with_ticks_and_none_is_refused():
    svg = draw(chart(FRONT[:1]))
    assert "1 machine;" in svg
    assert len([t for t in texts(svg) if re.fullmatch(r"\$[\d.]+", t)]) >= 4
    with pytest.raises(ValueError, match="without machines"):
        draw(chart([]))


def test_all_machines_equal_is_drawn():
    same = [
        PlottedMachine(name=f"m{i}", y=1.25, cost_usd_per_request=0.00125, price_usd_per_hour=3.6) for i in range(50)
    ]
    assert draw(chart(same)).count("h0") == 6, "one speck for each kind and part, and the legend's"


def test_interval_bars_stay_inside_the_frame():
    wild = [
        PlottedMachine(
            name="wild",
            y=1.0,
            cost_usd_per_request=0.001,
            price_usd_per_hour=1.0,
            low=1e-6,
            high=1e6,
            measured=True,
            on_front=True,
            on_hourly_front=True,
            role="chosen",
        ),
        PlottedMachine(name="other", y=2.0, cost_usd_per_request=0.002, price_usd_per_hour=1.0),
    ]
    *bars, _legend = (n.get("d") for n in nodes(draw(chart(wild)), "bar"))
    assert len(bars) == 2
    for bar in bars:
        low, high = (float(one) for one in re.fullmatch(r"M\S+ (\S+)h6m-3 0V(\S+)m-3 0h6", bar).groups())
        assert 0 < high < low < 800


def test_without_limits_nothing_is_said_to_meet_or_break_them():
    assert not {"meets the limits", "does not", "over a limit"} & set(texts(draw(chart(FRONT[:1]))))
    assert not any("limit" in line for line in plot(chart(FRONT[:1]), 80))


def test_the_list_keeps_clear_of_the_longest_role():
    near = PlottedMachine(
        name="c6i.large",
        y=16.4,
        cost_usd_per_request=0.0002,
        price_usd_per_hour=0.085,
        role="nearest in metrics.path_length",
        words="c6i.large, 2 vCPU",
    )
    found = ElementTree.fromstring(draw(chart([near]))).iter()
    starts = {node.text: float(node.get("x")) for node in found if node.tag.endswith("text")}
    assert starts[near.words] > starts[near.role] + 6.6 * len(near.role)


def test_a_hundred_thousand_machines_stay_a_small_file():
    random = np.random.default_rng(0)
    n = 100_000
    latency, price = np.exp(random.normal(0, 1.5, n)), np.exp(random.normal(0, 2, n))
    crowd = Crowd(latency, latency * price / 3600, price, latency < 1)
    svg = draw(
        Chart(title="many", subtitle="0.50 latency + 0.50 cost", y_label="mean latency", machines=[], crowd=crowd)
    )
    assert len(svg) < 250_000
    assert "100,000 machines" in svg


def test_the_cost_limit_is_a_slope_against_the_price_of_an_hour():
    svg = draw(chart(cost_limit_usd_per_request=0.0004))
    upright, sloped = (re.findall(r"[-\d.]+", node.get("d")) for node in nodes(svg, "limit"))
    assert upright[0] == upright[2]
    assert sloped[0] != sloped[2]
    assert sloped[1] != sloped[3]


def test_latency_by_vcpus_shows_curve_interval_and_samples():
    levels = [Level(2, 16.0, 15.0, 17.0), Level(4, 8.0, 7.0, 9.0), Level(16, 2.3, 2.2, 2.4)]
    panels = [
        Panel(
            heading="machines without GPU",
            levels=levels,
            samples=[Sample("c6i.large", 2, 16.4, 16.0, 17.0)],
            others=[(8, 4.0)],
            curve=[(2, 16.0), (16, 2.0)],
            curve_words="a + b/c",
        ),
        Panel(heading="machines with 1 T4", levels=[Level(4, 1.65)], samples=[Sample("g4dn.xlarge", 4, 1.65)]),
    ]
    svg = model_svg.draw(
        LatencyChart(title="grasp-planning", subtitle="mean latency", y_label="mean latency", panels=panels)
    )
    assert {"machines without GPU", "machines with 1 T4", "a + b/c"} <= set(texts(svg))
    assert [len([n for n in nodes(svg, kind) if n.get("d")]) for kind in ("curve", "paper")] == [2, 2], (
        "and the legend's"
    )
    assert len(nodes(svg, "measured")) == 3
    with pytest.raises(ValueError, match="no model"):
        model_svg.draw(LatencyChart(title="none", subtitle="", y_label="", panels=[]))


@pytest.mark.parametrize("values", [[1.25], [7.3], [2.05, 2.1], [0.001, 1000], [1e-9, 1e9], [99, 101]])
def test_every_axis_has_ticks_that_do_not_touch(values):
    found = axis(values, 80, 740)
    ticks = found.ticks(short_dollars, wide)
    assert ticks
    for (a, one), (b, other) in itertools.pairwise(ticks):
        assert b - a >= (wide(one) + wide(other)) / 2


@pytest.mark.parametrize(
    ("value", "text"), [(0.00024, "$0.00024"), (0.5, "$0.5"), (12.0, "$12"), (3.1e-7, "$0.00000031")]
)
def test_money_has_no_exponent(value, text):
    assert short_dollars(value) == text


@pytest.mark.parametrize(
    ("value", "text"), [(0.0258, "25.8 ms"), (1.65, "1.65 s"), (0.9999, "0.9999 s"), (3.4e-5, "34 µs")]
)
def test_seconds(value, text):
    assert seconds(value) == text


def test_costs_are_of_as_many_requests_as_makes_them_short():
    assert requests_unit([0.5])[0] == 1
    assert requests_unit([0.00024])[0] == 1000
    assert requests_unit([7e-7])[0] == 1_000_000


@pytest.mark.parametrize("width", [20, 44, 60, 80, 102, 120, 200])
def test_in_plain_characters_every_line_fits_and_the_choice_is_there(width):
    lines = plot(chart(y_limit=2.0, cost_limit_usd_per_request=0.001), width)
    assert max(map(len, lines)) <= max(width, 74), "the key is as wide as the narrowest sensible terminal needs"
    assert sum(line.count("@") for line in lines) == 3, "both views, and the key"
    assert any("%" in line for line in lines[:15])
    assert all(line.isascii() for line in lines)


def test_colour_only_adds_colour():
    plain = plot(chart(y_limit=2.0), 80)
    colored = plot(chart(y_limit=2.0), 80, color=True)
    assert STYLE.search("".join(colored))
    assert [click.unstyle("".join(STYLE.split(line)[::2])).rstrip() for line in colored] == plain


def test_one_machine_in_plain_characters():
    assert any("@" in line for line in plot(chart(FRONT[:1]), 60))
