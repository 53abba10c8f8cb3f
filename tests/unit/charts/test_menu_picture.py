"""The menu's picture of real choices: what it names, counts and leaves out."""

import math
import re
import shutil
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from fogspec.charts.menu import menu_frame, menu_picture, named_of
from fogspec.charts.picture import HUES, LIGHT, Frame
from fogspec.compile.artifacts import Artifacts
from fogspec.language.schema import Application
from tests.browser.test_report import compiled, loaded, written_catalog
from tests.unit.charts.test_picture import assert_names_touch_nothing, lines_in, marks, names, texts

ROOT = Path(__file__).parents[3]


@cache
def made(name: str = "vslam-recorded", catalog: Path | None = None, **limits: str | None) -> Artifacts:
    one = loaded(catalog.parent if catalog else ROOT, name)
    document = one.application.model_dump(mode="json", exclude_unset=True)
    document["spec"]["constraints"] |= limits
    return compiled(replace(one, application=Application.model_validate(document)), str(catalog) if catalog else None)


def drawn(found: Artifacts, doubts: tuple[str, ...] = ()) -> str:
    assert found.decision is not None
    svg = menu_picture(found.application, found.decision.choice, doubts)
    assert svg is not None
    return svg


def frame(found: Artifacts) -> Frame:
    assert found.decision is not None
    made = menu_frame(found.application, found.decision.choice)
    assert made is not None
    return made


def test_it_says_what_was_found_and_names_the_choice_and_its_alternatives() -> None:
    svg = drawn(made("grasp-planning-recorded"), ("a doubt",))
    assert {
        "g4dn.xlarge is the best machine that meets both limits",
        "latency limit 2 s",
        "cost limit $1.00",
        "runner-up",
        "baseline",
        "6.2 times cheaper and 17% faster than c6i.16xlarge",
        "⚠ a doubt",
    } <= set(texts(svg))
    choice = made("grasp-planning-recorded").decision.choice  # type: ignore[union-attr]
    others = {str(choice.offers.instance[row]) for row in named_of(choice).values()}
    assert {text for text, _ in names(svg) if "limit" not in text} == others
    assert len(others) == 3
    assert len(svg) < 12_000


def test_what_is_off_scale_is_counted() -> None:
    svg = drawn(made("grasp-planning-recorded"))
    [said] = [text for text in texts(svg) if text.startswith("off scale")]
    slower, _, dearer = re.fullmatch(
        r"off scale: (\d+) slower \(up to [\d.]+ s\)(, (\d+) more expensive)?", said
    ).groups("0")  # type: ignore[union-attr]
    assert int(slower) > 0
    assert len(marks(svg)) == 24 - int(slower) - int(dearer)


def test_a_limit_off_scale_is_named_and_not_drawn_at_the_edge() -> None:
    found = made(latency="1000s")
    assert any("off scale: " in text and "latency limit 1,000 s" in text for text in texts(drawn(found)))
    assert len(lines_in(drawn(found))[0]) == 1


def test_no_machine_is_an_answer_too() -> None:
    svg = drawn(made(latency="1ms"))
    assert "No machine meets the latency limit of 1 ms" in texts(svg)
    assert "c6i.4xlarge" in [text for text, _ in names(svg)]
    assert "as good as the choice" not in texts(svg)


def test_without_limits_nothing_is_said_to_meet_or_miss_them() -> None:
    svg = drawn(made(latency=None, cost=None))
    assert "misses a limit" not in texts(svg)
    assert LIGHT["feasible"] not in svg
    assert any(text.endswith("is the best of 21 machines") for text in texts(svg))


@pytest.mark.parametrize("name", ["grasp-planning-recorded", "vslam-recorded", "motion-planning-cubicles-recorded"])
def test_the_feasible_area_fills_the_picture(name: str) -> None:
    """Whatever the machines off scale are."""
    root = ElementTree.fromstring(drawn(made(name)))
    [area] = [node for node in root.iter() if node.get("fill") == HUES["feasible"][0]]
    points = [tuple(map(float, one.split())) for one in (area.get("d") or "").strip("MZ").split("L")]
    wide, high = (max(one) - min(one) for one in zip(*points, strict=True))
    assert wide * high > 0.15 * 638 * 300


def test_an_interval_is_slanted_where_cost_follows_latency() -> None:
    found = made()
    for dot in (dot for dot in frame(found).dots if dot.ends):
        (x1, y1), (x2, y2) = dot.ends or ((0, 0), (0, 0))
        assert x1 < dot.x < x2
        assert y1 < dot.y < y2


def test_the_choice_is_on_the_line_of_what_is_as_good() -> None:
    found = frame(made())
    [chosen] = [dot for dot in found.dots if dot.hue == "chosen"]
    [(kind, points)] = found.lines
    assert kind == "iso"
    assert min(math.hypot(math.log(x / chosen.x), math.log(y / chosen.y)) for x, y in points) < 0.1


def test_a_price_limit_is_a_slope_against_the_cost_of_requests() -> None:
    """And machines of that price lie on it."""
    found = made(price="$0.70/h")
    [price] = [one for one in frame(found).limits if one.words.startswith("price")]
    assert (price.a, price.b) == (1, -1)
    choice = found.decision.choice  # type: ignore[union-attr]
    cost, latency = np.log10(choice.cost_usd_per_request), np.log10(choice.metric_value)
    below = price.a * cost + price.b * latency <= price.most
    assert below.tolist() == (choice.offers.price_usd_per_hour <= 0.70).tolist()
    assert 0 < below.sum() < len(below)


def test_one_machine_has_ticks_and_a_crowd_stays_small(tmp_path: Path) -> None:
    for folder in ("specs", "results"):
        shutil.copytree(ROOT / folder, tmp_path / folder)
    catalog = tmp_path / "aws.csv"
    written_catalog(catalog, [("c6i.4xlarge", 16, 32, 0.68, "")])
    svg = drawn(made(catalog=catalog))
    assert "1 machine, 1 measured" in svg
    assert len([text for text in texts(svg) if text.startswith("$0.00") and len(text) < 8]) >= 2
    crowd = tmp_path / "crowd.csv"
    shapes = [(2 ** (i % 6 + 1), 2 ** (i % 6 + 2), 0.04 * 2 ** (i % 6 + 1) * (1 + i / 2000)) for i in range(3000)]
    written_catalog(crowd, [(f"c6i.t{i}", cpus, memory, price, "") for i, (cpus, memory, price) in enumerate(shapes)])
    found = made(catalog=crowd)
    svg = drawn(found)
    assert len(svg) < 12_000
    assert "3,000 machines, " in svg
    assert "zm" in svg
    assert assert_names_touch_nothing(svg) >= 1
    assert found.layout.latencies in found.files
    assert len(found.files[found.layout.latencies]) < 12_000
