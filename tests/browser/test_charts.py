"""The charts in a real browser: with its fonts too, no text touches a mark, a limit, another text or the edge."""

from pathlib import Path

import pytest

from tests.browser.conftest import ROOT
from tests.browser.test_report import compiled, loaded, measured_here, rented, written_catalog

# Boxes of everything in the picture, in its own units; a text's is a little smaller than its line.
TOUCHING = """() => {
    const svg = document.querySelector('svg'), found = [], page = svg.viewBox.baseVal;
    const texts = [...svg.querySelectorAll('text')].map((node) => {
        const box = node.getBBox();
        return {words: node.textContent, left: box.x, right: box.x + box.width, top: box.y + box.height * .2,
                bottom: box.y + box.height * .82};
    });
    const marks = [...svg.querySelectorAll('.mark > *')].map((node) => {
        const box = node.getBBox();
        return {words: 'mark', left: box.x, right: box.x + box.width, top: box.y, bottom: box.y + box.height};
    });
    const limits = [...svg.querySelectorAll('.limit')].flatMap((node) => [...Array(401).keys()].map((i) => {
        const at = node.getPointAtLength(i / 400 * node.getTotalLength());
        return {words: 'limit', left: at.x - .5, right: at.x + .5, top: at.y - .5, bottom: at.y + .5};
    }));
    const touch = (a, b) => a.left < b.right && b.left < a.right && a.top < b.bottom && b.top < a.bottom;
    texts.forEach((one, i) => {
        for (const other of [...texts.slice(0, i), ...marks, ...limits])
            if (touch(one, other)) { found.push([one.words, other.words]); break; }
        if (one.left < 0 || one.right > page.width || one.bottom > page.height) found.push([one.words, 'edge']);
    });
    return found;
}"""
HOSTILE = "<img src=x onerror=alert(1)>&'\""
NAMES = [f"c6i.{HOSTILE}", "c6i." + "very-long-name-" * 13, "c6i.אבגדה-מכונה", "c6i.計算機-大型", "c6i." + "W" * 190]


def assert_nothing_touches(browser, path: Path) -> None:
    for scheme in ("light", "dark"):
        view = browser.open(path, width=720, color_scheme=scheme)
        assert view.evaluate(TOUCHING) == [], path
        view.close()
    assert browser.complaints == []


@pytest.mark.parametrize(
    "path", sorted((ROOT / "compiled").glob("*/*.svg")), ids=lambda path: f"{path.parent.name}-{path.stem}"
)
def test_nothing_touches_in_the_committed_charts(browser, path):
    assert_nothing_touches(browser, path)


@pytest.mark.parametrize("path", sorted((ROOT / "docs" / "figures").glob("paper-*.svg")), ids=lambda path: path.stem)
def test_nothing_touches_in_the_papers_charts(browser, path):
    assert_nothing_touches(browser, path)


def test_hostile_names_touch_nothing_either(browser, checkout, tmp_path):
    catalog = checkout / "aws.csv"
    written_catalog(catalog, [(name, 2 ** (i + 2), 2 ** (i + 3), 0.15 * (i + 1), "") for i, name in enumerate(NAMES)])
    made = compiled(loaded(checkout, "vslam-recorded"), str(catalog))
    for path in (made.layout.picture, made.layout.latencies):
        drawn = tmp_path / path.name
        drawn.write_bytes(made.files[path])
        assert_nothing_touches(browser, drawn)


def test_a_metric_measured_on_one_host_has_charts_too(browser, checkout, tmp_path):
    one = rented(loaded(checkout, "cubicles-planner"))
    measured_here(one)
    made = compiled(one)
    assert made.layout.metric_picture in made.files
    for path in (made.layout.picture, made.layout.latencies, made.layout.metric_picture):
        drawn = tmp_path / path.name
        drawn.write_bytes(made.files[path])
        assert_nothing_touches(browser, drawn)
