"""The model's picture: the finding in its title, one frame for every accelerator, the limit and the choice."""

from dataclasses import replace

import pytest

from fogspec.charts.model import Series, finding, model_frame, model_picture
from fogspec.charts.picture import Dot, picture
from fogspec.charts.text import seconds
from tests.unit.charts.test_menu_picture import made
from tests.unit.charts.test_picture import HOSTILE, assert_names_touch_nothing, lines_in, marks, overlap, texts


def sized(levels, ends=None, **more):
    of = [((v, ends[0]), (v, ends[1])) if ends else None for v, _ in levels]
    return [
        Dot(title=f"m{v:g}-{i}", x=v, y=value, ends=of[i], name=f"m{v:g}-{i}", **more)
        for i, (v, value) in enumerate(levels)
    ]


def drawn(*series, what="latency", label="mean latency", limit=None, notes=()):
    return picture(finding(series, what), [model_frame(series, what, label, seconds, limit)], notes=notes)


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
        ([(2, 1.0), (16, 1.02), (64, 0.98)], [], "More vCPUs do not help this application"),
        ([(2, 1.0), (16, 1.5), (64, 2.0)], [], "More vCPUs make this application slower"),
        ([(4, 1.0)], [], "Latency of machines with 4 vCPUs"),
    ],
)
def test_the_title_is_the_finding(plain, gpu, title):
    series = [Series("no GPU", False, sized(plain))]
    series += [Series("1 T4", True, sized(gpu))] if gpu else []
    assert finding(series, "latency") == title


@pytest.mark.parametrize(
    ("levels", "factor", "title"),
    [
        ([(1, 0.9), (2, 0.628)], 1.1, "Latency falls 1.4 × with each doubling of vCPUs"),
        ([(1, 0.9), (2, 0.628)], 1.7, "Too little is known to say how the latency changes with more vCPUs"),
        ([(1, 0.628), (2, 0.9)], 1.7, "Too little is known to say how the latency changes with more vCPUs"),
        ([(1, 0.9), (2, 0.88)], 1.2, "More vCPUs do not help this application"),
        ([(1, 0.9), (2, 0.88)], 1.5, "Too little is known to say how the latency changes with more vCPUs"),
    ],
)
def test_what_ranges_do_not_bear_out_is_no_finding(levels, factor, title):
    """Of a computer half of whose time others took, the model said that latency falls 1.4 times with each doubling."""
    dots = [dot for level in levels for dot in sized([level], ends=(level[1] / factor, level[1] * factor))]
    assert finding([Series("no GPU", False, dots)], "latency") == title


def test_it_is_one_frame_with_all_accelerators_the_limit_and_the_choice():
    plain = [*sized([(2, 16.0), (2, 15.0), (16, 2.3)], measured=True), *sized([(8, 4.0)], ends=(3.0, 5.0))]
    chosen = Dot(title="", name="g4dn.xlarge", x=4, y=1.65, measured=True, hue="chosen")
    gpus = [chosen, *sized([(8, 1.7)])]
    svg = drawn(Series("no GPU", False, plain), Series("1 T4", True, gpus), limit=2.0)
    assert {"no GPU", "1 T4", "g4dn.xlarge", "latency limit 2 s"} <= set(texts(svg))
    assert assert_names_touch_nothing(svg) == 4
    assert len(lines_in(svg)[0]) == 1
    assert len(marks(svg)) == 6
    at_two = sorted(box for _, box in marks(svg) if box[2] < 200)
    assert not overlap(*at_two), "equal numbers of vCPUs are side by side"


def test_without_a_machine_there_is_no_picture():
    found = made()
    models = found.decision.models
    nothing = replace(models, observations=[])
    assert model_picture(found.application, found.decision.choice, models, [])
    assert model_picture(found.application, found.decision.choice, nothing, []) is None


def test_a_limit_far_away_is_said_and_not_drawn():
    svg = drawn(Series("no GPU", False, sized([(2, 1.0), (4, 0.5)])), limit=100.0)
    assert "off scale: latency limit 100 s" in texts(svg)
    assert not lines_in(svg)[0]


@pytest.mark.parametrize("count", [9, 40, 300])
def test_many_machines_of_one_size_stay_inside_the_frame(count):
    levels = [(8, 1.0 + i / count) for i in range(count)] + [(2, 4.0)]
    svg = drawn(Series("no GPU", False, sized(levels)))
    assert all(66 <= box[0] < box[2] <= 704 for _, box in marks(svg))
    assert len(svg) < 12_000


@pytest.mark.parametrize("name", HOSTILE, ids=["markup", "long", "right-to-left", "escape", "wide", "widest"])
def test_hostile_names_stay_text(name):
    series = Series(name, True, [Dot(title=name, name=name, x=2, y=1.0, hue="chosen")])
    svg = drawn(series, what=name, label=name, limit=1.1, notes=[name])
    assert "<script" not in svg
    assert_names_touch_nothing(svg)
