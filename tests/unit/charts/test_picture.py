"""The frame of every chart: deterministic, safe against names, legible without a style sheet, with names that touch nothing."""

import itertools
import math
import re
import shutil
import subprocess
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from fogspec.base.templates import shipped
from fogspec.base.units import money
from fogspec.charts.names import rows, through
from fogspec.charts.picture import HUES, LIGHT, Axis, Dot, Frame, Limit, picture
from fogspec.charts.text import LARGE, SIZE, seconds, shortened, width, wrapped

ROOT = Path(__file__).parents[3]
COMMITTED = sorted(
    [*ROOT.glob("compiled/*/*.svg"), *ROOT.glob("docs/figures/paper-*.svg"), ROOT / "docs/figures/menu.svg"]
)
SVG = "{http://www.w3.org/2000/svg}"
HOSTILE = [
    '"><script>alert(1)</script>&]]>', "c6i." + "very-long-name-" * 14, "אבגדה-מכונה.xlarge", "m\\x1b[31m.large",
    "計算機-大型.xlarge", "M" * 200,
]  # fmt: skip
FRONT = [
    Dot(title="g4dn.xlarge: 1.65 s", x=0.24, y=1.65, ends=((0.23, 1.58), (0.25, 1.73)), measured=True, diamond=True,
        hue="chosen", name="g4dn.xlarge"),
    Dot(title="c6i.large: 16.4 s", x=0.2, y=16.4, ends=((0.2, 15.0), (0.2, 18.0)), measured=True, hue="misses",
        name="c6i.large"),
    Dot(title="m6i.large: 3.1 s", x=0.4, y=3.1),
]  # fmt: skip
LATENCY, COST = (
    Limit("latency limit 2 s", 0, 1, math.log10(2)),
    Limit("cost limit $0.30", 1, 0, math.log10(0.3)),
)


def framed(dots: Sequence[Dot], **more) -> Frame:
    x, y = (
        Axis.over(*words, values)
        for *words, values in (("cost", money, [d.x for d in dots]), ("latency", seconds, [d.y for d in dots]))
    )
    return Frame(x=x, y=y, dots=dots, **more)


def draw(dots: Sequence[Dot] = FRONT, title: str = "g4dn.xlarge is best", notes: Sequence[str] = (), **more) -> str:
    lead = [("4 vCPU ", False), ("1.65 s", True)]
    return picture(
        title,
        [framed(dots, **more)],
        lead=lead,
        table=[("ruled out", "c6i.large")],
        source="Prices: AWS.",
        notes=notes,
    )


def every(svg: str, tag: str = "") -> list[ElementTree.Element]:
    """The elements of a tag, or all; those in a group have its font and anchor."""
    found: list[ElementTree.Element] = []

    def walk(node: ElementTree.Element, given: dict[str, str]) -> None:
        own = given | {one: node.get(one, "") for one in ("font-size", "font-weight", "text-anchor") if node.get(one)}
        node.attrib.update(own if node.tag == SVG + "text" else {})
        found.append(node)
        for child in node:
            walk(child, own)

    walk(ElementTree.fromstring(svg), {})
    return [node for node in found if node.tag == SVG + tag or not tag]


def texts(svg: str) -> list[str]:
    return ["".join(node.itertext()) for node in every(svg, "text")]


def ends(path: str) -> tuple[float, ...]:
    """The ends of a segment, of which an upright or a level one ends with one number."""
    x, y, *end = numbers(path)
    return (x, y, *(end if len(end) == 2 else (*end, y) if "H" in path else (x, *end)))


def numbers(text: str | None) -> list[float]:
    return [float(one) for one in re.findall(r"-?[\d.]+", text or "")]


def marks(svg: str) -> list[tuple[ElementTree.Element, tuple[float, float, float, float]]]:
    found = []
    for node in [node for group in every(svg, "g") if group.get("class") == "mark" for node in group]:
        if node.get("cx"):
            x, y, r = (float(node.get(one) or 0) for one in ("cx", "cy", "r"))
        else:
            x, top, r = numbers(node.get("d"))[:3]
            y = top + r
        found.append((node, (x - r, y - r, x + r, y + r)))
    return found


def lines_in(svg: str) -> tuple[list[tuple[float, ...]], list[tuple[float, ...]]]:
    """The limits and the intervals inside of the frame."""
    inside = [node for group in every(svg, "g") if group.get("clip-path") for node in group]
    limits = [ends(node.get("d") or "") for node in inside if node.get("class") == "limit"]
    of_bars = [node for node in inside if node.get("stroke-width") in ("1", "1.4", "2.2")]
    parts = [one for node in of_bars for one in (node.get("d") or "").split("M")[1:]]
    return limits, [ends(one) for one in parts]


def names(svg: str) -> list[tuple[str, tuple[float, float, float, float]]]:
    """The names inside of the frame, as wide as the table of widths says."""
    (left, top, wide, high) = (float(every(svg, "rect")[-1].get(one) or 0) for one in ("x", "y", "width", "height"))
    found = []
    for node in every(svg, "text"):
        if not node.get("x"):
            continue
        x, y, bold = float(node.get("x") or 0), float(node.get("y") or 0), node.get("font-weight") == "600"
        if left < x < left + wide and top < y < top + high and not node.get("text-anchor"):
            found.append(
                (node.text or "", (x, y - 10, x + width(node.text or "", LARGE if bold else SIZE, bold=bold), y + 2))
            )
    return found


def leaders(svg: str) -> list[tuple[float, ...]]:
    lines = [node.get("d") or "" for node in every(svg, "path") if node.get("class") == "leader"]
    return [ends(one) for line in lines for one in line.split("M")[1:]]


def overlap(one, other) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def assert_names_touch_nothing(svg: str) -> int:
    """No name touches a dot, an interval, a limit, another name or the edge of the frame; the number of names."""
    boxes = [box for _, box in names(svg)]
    limits, bars = lines_in(svg)
    for i, one in enumerate(boxes):
        assert 60 < one[0] < one[2] < 706
        assert not any(overlap(one, other) for other in [*boxes[:i], *(box for _, box in marks(svg))])
        assert not through(rows([one]), rows([*limits, *bars])).any()
    assert all(through(rows(boxes), rows([leader])).sum() <= 1 for leader in leaders(svg)), "it ends at its own name"
    return len(boxes)


def test_it_is_well_formed_names_the_choice_and_has_no_script() -> None:
    svg = draw(limits=[LATENCY, COST], notes=["extrapolated"])
    assert {
        "g4dn.xlarge is best",
        "4 vCPU 1.65 s",
        "g4dn.xlarge",
        "latency limit 2 s",
        "cost limit $0.30",
        "⚠ extrapolated",
    } <= set(texts(svg))
    assert "<script" not in svg
    assert len(lines_in(svg)[0]) == 2
    assert len([node for node in every(svg, "path") if node.get("fill") == LIGHT["feasible"]]) == 1


def test_every_warning_is_text_in_the_picture() -> None:
    notes = [f"warning number {n}" for n in range(7)]
    svg = draw(notes=notes)
    assert {f"⚠ {note}" for note in notes} <= set(texts(svg))
    top = every(svg)[0]
    assert top.get("role") == "group", "screen readers read no text of an image"
    assert (top[0].tag, top[0].text) == (SVG + "title", "g4dn.xlarge is best"), "its name"


def test_measured_is_filled_predicted_hollow_and_gpus_are_diamonds() -> None:
    svg = draw()
    how = {
        node[0].text.partition(":")[0]: (node.tag, group.get("fill"))
        for group in every(svg, "g")
        if group.get("class")
        for node in group
    }  # type: ignore[union-attr]
    assert how == {
        "g4dn.xlarge": (SVG + "path", LIGHT["chosen"]), "c6i.large": (SVG + "circle", LIGHT["misses"]),
        "m6i.large": (SVG + "circle", LIGHT["page"]),
    }  # fmt: skip


@pytest.mark.parametrize("path", COMMITTED, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_attributes_alone_color_the_committed_pictures(path: Path) -> None:
    """CairoSVG, librsvg and mail know no media query, and some no style sheet: without any, it is the light picture."""
    svg = path.read_text("utf-8")
    seen: set[str] = set()

    def walk(node: ElementTree.Element, paint: dict[str, str]) -> None:
        own = paint | {one: node.get(one, paint[one]) for one in paint}
        assert not node.get("style")
        if node.tag in {SVG + one for one in ("text", "tspan", "circle", "rect", "path")}:
            used = set(own.values()) - {"none"}
            assert used, ElementTree.tostring(node)
            assert node.tag != SVG + "text" or own["fill"] != "none"
            seen.update(used)
        for child in node:
            if node.tag != SVG + "clipPath":
                walk(child, own)

    walk(ElementTree.fromstring(svg), {"fill": "#000000", "stroke": "none"})
    assert len(seen) >= 4
    assert seen <= set(LIGHT.values())
    [style] = every(svg, "style")
    swapped = re.findall(r'\[(?:fill|stroke)="(#\w+)"\]\{(?:fill|stroke):(#\w+)\}', style.text or "")
    assert set(swapped) == {pair for pair in HUES.values() if pair[0] in seen}, "and each color has its dark one"


@pytest.mark.parametrize("scheme", [0, 1], ids=["light", "dark"])
def test_text_and_dots_have_the_contrast_that_wcag_asks_for(scheme: int) -> None:
    def luminance(color: str) -> float:
        channels = [int(one, 16) / 15 for one in color[1:]]
        linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
        return float(np.dot(linear, (0.2126, 0.7152, 0.0722)))

    def contrast(one: str, other: str) -> float:
        high, low = sorted((luminance(HUES[name][scheme]) for name in (one, other)), reverse=True)
        return (high + 0.05) / (low + 0.05)

    for behind in ("page", "feasible"):
        for text in ("ink", "soft", "chosen", "broken", "gpu-1", "gpu-2", "gpu-3"):
            assert contrast(text, behind) >= 4.5, (text, behind)
        assert contrast("misses", behind) >= 3


def test_the_page_has_the_colors_of_the_pictures() -> None:
    style = (shipped("templates") / "report.css").read_text("utf-8")
    for scheme, block in enumerate(re.findall(r":root \{([^}]*)", style)):
        found = dict(re.findall(r"--([\w-]+): (#\w{3})", block))
        shared = HUES.keys() & found.keys()
        assert {"ink", "soft", "page", "chosen", "feasible"} <= shared
        assert {name: found[name] for name in shared} == {name: HUES[name][scheme] for name in shared}


@pytest.mark.parametrize("path", COMMITTED, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_a_renderer_that_is_no_browser_draws_the_committed_pictures(path: Path) -> None:
    """As a mail, a slide or a package index shows them: in their light colors, and small."""
    if shutil.which("rsvg-convert") is None:
        pytest.skip("needs a renderer: sudo apt-get install librsvg2-bin")
    content = path.read_bytes()
    assert len(content) <= 12_000 or path.stem == "paper-frontiers"
    drawn = subprocess.run(["rsvg-convert", "-f", "ps", str(path)], capture_output=True, check=True)
    assert not drawn.stderr
    painted = re.findall(rb"(?<![\d.])((?:[\d.]+ )+)(?:rg|g|RG|G)\b", drawn.stdout)
    levels = [[round(255 * float(one)) for one in text.split()] for text in painted]
    seen = Counter("#" + "".join(f"{one:02x}" for one in (level * 3)[:3]) for level in levels)
    used = {re.sub(r"(\w)", r"\1\1", light) for light in LIGHT.values() if f'"{light}"' in content.decode()}
    assert len(used) >= 4
    assert seen.keys() == used, "each color that it names, and not the black of what has none"
    assert seen["#112233"] > 5


def test_intervals_end_at_the_frame_however_wide_they_are() -> None:
    wild = Dot(title="wild", x=1.0, y=1.0, ends=((1e-9, 1e-300), (1e9, 1e300)), measured=True)
    root = ElementTree.fromstring(draw([wild, FRONT[2]]))
    [clipped] = [node for node in root.iter(SVG + "g") if node.get("clip-path")]
    [shape] = [node for node in root.iter(SVG + "clipPath") if f"url(#{node.get('id')})" == clipped.get("clip-path")]
    assert [shape[0].get(one) for one in ("x", "width")] == ["66", "638"]
    assert any(node.get("stroke-width") == "1.4" for node in clipped)


def test_a_limit_outside_is_not_drawn_at_the_edge() -> None:
    far = Limit("latency limit 1,000,000 s", 0, 1, 6)
    frame = framed(FRONT, limits=[far])
    assert not frame.edge(far)
    assert not lines_in(draw(limits=[far]))[0]


def test_the_same_dots_give_the_same_picture_in_any_order() -> None:
    assert draw(FRONT, limits=[LATENCY]) == draw(FRONT[::-1], limits=[LATENCY])


def test_the_last_bits_of_a_number_do_not_show() -> None:
    other = [
        Dot(**{name: getattr(one, name) for name in Dot.__slots__} | {"y": math.nextafter(one.y, 0)}) for one in FRONT
    ]
    assert draw(FRONT) == draw(other), "processors differ in them"


@pytest.mark.parametrize("name", HOSTILE, ids=["markup", "long", "right-to-left", "escape", "wide", "widest"])
def test_hostile_names_stay_text_and_keep_their_place(name: str) -> None:
    first = Dot(title=name, x=0.24, y=1.65, ends=FRONT[0].ends, hue="chosen", name=name)
    dots = [first, Dot(title=name, x=0.2, y=1.8, name=name[::-1]), FRONT[2]]
    limit = Limit(f"{name[:20]} limit 2 s", 0, 1, math.log10(2))
    svg = draw(
        dots, title=f"{name} is the best", notes=[name], limits=[limit], heading=shortened(name, 200), remark=name
    )
    assert "<script" not in svg
    assert name[:4] in " ".join(texts(svg))
    assert assert_names_touch_nothing(svg) >= 2
    for node in every(svg, "text"):
        bold = node.get("font-weight") == "600"
        assert width("".join(node.itertext()), float(node.get("font-size", SIZE)), bold=bold) <= 704


@pytest.mark.parametrize("seed", range(60))
def test_names_touch_nothing(seed: int) -> None:
    """Machines anywhere, crowded or not, with short and long names, with limits through the middle of them."""
    random = np.random.default_rng(seed)
    count, spread = int(random.integers(3, 60)), float(random.choice([0.02, 0.2, 0.8]))
    y, x = (np.exp(random.normal(0, spread, count)).tolist() for _ in range(2))
    hues = ["chosen", "meets", "misses"]
    named = [f"{'a-rather-long-name-' if seed % 3 else 'c6i.'}{i}" if i < 3 else "" for i in range(count)]
    ends = [((0.9 * a, 0.9 * b), (1.1 * a, 1.1 * b)) for a, b in zip(x, y, strict=True)]
    dots = [
        Dot(title=str(i), x=x[i], y=y[i], ends=ends[i], measured=bool(i % 2), diamond=i % 5 == 0,
            hue=hues[i] if i < 3 else "meets", name=named[i])
        for i in range(count)
    ]  # fmt: skip
    limits = [LATENCY, COST] if seed % 4 else []
    limits += [Limit("price limit $1.05/h", 1, -1, 0.02)] if seed % 5 == 0 else []
    assert assert_names_touch_nothing(draw(dots, limits=limits)) >= (spread > 0.2), (
        "only where dots leave no room is there no name"
    )


@pytest.mark.parametrize("apart", [1.0, 1.05, 1.4, 3.0])
def test_the_choice_is_named_even_beside_its_likes(apart: float) -> None:
    near = [
        Dot(title=role, x=apart**i, y=apart**i, measured=True, hue=role, name=f"a-long-one-{role}")
        for i, role in enumerate(("chosen", "meets", "misses"))
    ]
    svg = draw(near)
    assert assert_names_touch_nothing(svg) == 3
    fills = {node.text: node.get("fill") for node in every(svg, "text")}
    assert fills["a-long-one-chosen"] == LIGHT["chosen"]
    assert fills["a-long-one-misses"] == LIGHT["soft"], "gray as its dot, and dark enough for text"


@pytest.mark.parametrize("path", COMMITTED, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_names_of_the_committed_pictures_cross_nothing(path: Path) -> None:
    if path.stem.startswith("paper"):
        return
    svg = path.read_text("utf-8")
    assert assert_names_touch_nothing(svg) >= 2
    assert len(lines_in(svg)[1]) > 1
    dots = rows([box for _, box in marks(svg)])
    assert all(through(dots, rows([leader])).sum() <= 1 for leader in leaders(svg)), "nor a leader line another dot"


def test_many_dots_without_marks_are_a_small_file() -> None:
    random = np.random.default_rng(0)
    x, y = np.exp(random.normal(0, 2, (2, 100_000)))
    svg = draw(specks=[("misses", x, y), ("meets", x / 2, y)])
    assert len(svg) < 12_000
    assert svg.count("zm") > 100


def test_a_long_remark_has_lines_of_its_own() -> None:
    [frame] = [framed(FRONT, remark="off scale: " + "12 slower (up to 242 ms), " * 4)]
    assert not framed(FRONT, remark="off scale: 6 slower").above(638)
    lines = frame.above(638)
    assert len(lines) > 1
    assert set(lines) <= set(texts(draw(remark=frame.remark)))


def test_the_rows_keep_clear_of_their_heads() -> None:
    starts = {node.text or "".join(node.itertext()): float(node.get("x") or 0) for node in every(draw(), "text")}
    assert starts["c6i.large"] > 16 + width("ruled out", bold=True)


@pytest.mark.parametrize("values", [[1.25], [7.3], [2.05, 2.1], [0.001, 1000], [1e-9, 1e9], [99, 101]])
def test_every_axis_has_ticks_that_do_not_touch(values: list[float]) -> None:
    axis = Axis.over("cost", money, values)
    found = axis.ticks(660, lambda words: width(words) + 14)
    assert found
    for (a, one), (b, other) in itertools.pairwise(found):
        assert (b - a) / (axis.high - axis.low) * 660 >= (width(one) + width(other)) / 2 + 14


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.00024, "$0.00024"), (0.5, "$0.50"), (2.4, "$2.40"), (0.526, "$0.526"), (12.0, "$12.00"), (384.71, "$385"),
     (3.1e-7, "$0.00000031"), (0.44499999999999995, "$0.445"), (1234567.0, "$1,234,567"), (0.0, "$0")],
)  # fmt: skip
def test_money_has_three_digits_and_no_exponent(value: float, text: str) -> None:
    assert money(value) == text


@pytest.mark.parametrize(
    ("value", "text"), [(0.0258, "25.8 ms"), (1.648, "1.65 s"), (0.9999, "1 s"), (3.4e-5, "34 µs"), (1234.0, "1,234 s")]
)
def test_seconds(value: float, text: str) -> None:
    assert seconds(value) == text


def test_text_is_shortened_in_its_middle_and_wrapped_at_words() -> None:
    assert shortened("c6i.large", 200) == "c6i.large"
    cut = shortened("c6i." + "x" * 100 + ".metal", 150)
    assert cut.startswith("c6i.")
    assert cut.endswith("metal")
    assert width(cut) <= 150
    lines = wrapped("one two three four five six seven", 80, most=2)
    assert len(lines) == 2
    assert lines[1].endswith("…")
    assert all(width(text) <= 80 for text in lines)
