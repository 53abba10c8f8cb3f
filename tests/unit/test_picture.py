"""The menu picture: well-formed, deterministic, safe against names, and saying what it should."""

import itertools
import xml.etree.ElementTree as ElementTree

import pytest

from fogspec.effects.picture import Chart, Point, draw, money, seconds

FRONT = [
    Point("g4dn.xlarge", 1.65, 0.00024, 1.58, 1.73, True, True, "chosen"),
    Point("c6i.large", 16.4, 0.0002, 15.0, 18.0, True, True, "cheapest"),
    Point("m6i.large", 16.1, 0.0004),
]


def chart(points=FRONT, **more):
    return Chart("grasp-planning", "0.70 latency + 0.30 cost", "mean latency", points, **more)


def texts(svg: str) -> list[str]:
    return [node.text or "" for node in ElementTree.fromstring(svg).iter() if node.text]


def test_it_is_well_formed_names_the_choice_and_has_no_script():
    svg = draw(chart(latency_limit_s=2.0, cost_limit_usd_per_request=0.001, warning="extrapolated"))
    words = texts(svg)
    assert "chosen: g4dn.xlarge" in words
    assert "extrapolated" in words
    assert "<script" not in svg
    assert svg.count('class="limit"') == 2


def test_the_same_chart_gives_the_same_bytes_in_any_order():
    assert draw(chart()) == draw(chart(list(reversed(FRONT))))


def test_hostile_names_stay_text():
    name = '"><script>alert(1)</script>&'
    svg = draw(chart([Point(name, 1.0, 0.001, role="chosen")]))
    assert "<script" not in svg
    assert f"chosen: {name}" in texts(svg)


def test_labels_of_neighbours_do_not_overlap():
    near = [Point(f"machine-{role}", 1.0, 0.001, role=role) for role in ("chosen", "cheapest", "fastest")]
    root = ElementTree.fromstring(draw(chart(near)))
    heights = sorted(float(n.get("y")) for n in root.iter() if (n.get("class") or "").startswith("label"))
    assert len(heights) == 3
    assert min(b - a for a, b in itertools.pairwise(heights)) >= 12


def test_one_machine_is_drawn_and_none_is_refused():
    assert "1 machine;" in draw(chart(FRONT[:1]))
    with pytest.raises(ValueError, match="without machines"):
        draw(chart([]))


def test_interval_bars_stay_inside_the_frame():
    wide = [Point("wild", 1.0, 0.001, 1e-6, 1e6, True, True, "chosen"), Point("other", 2.0, 0.002)]
    root = ElementTree.fromstring(draw(chart(wide)))
    (bar,) = [n for n in root.iter() if n.get("class") == "bar"]
    assert 0 < float(bar.get("y2")) < float(bar.get("y1")) < 480


@pytest.mark.parametrize(
    ("value", "text"), [(0.00024, "$0.00024"), (0.5, "$0.5"), (12.0, "$12"), (3.1e-7, "$0.00000031")]
)
def test_money_has_no_exponent(value, text):
    assert money(value) == text


@pytest.mark.parametrize(("value", "text"), [(0.0258, "25.8 ms"), (1.65, "1.65 s"), (0.9999, "0.9999 s")])
def test_seconds(value, text):
    assert seconds(value) == text
