"""The documentation site in a real browser: it asks for nothing but its own files, and its pictures are there."""

from pathlib import Path

from tests.browser.conftest import Browser
from tests.support.site import site  # noqa: F401

PAGES = ("index.html", "tutorial.html", "reference/verbs.html", "explanation/method.html", "adr/index.html")


def test_pages_ask_for_nothing_from_elsewhere(browser: Browser, site: Path) -> None:
    for name in PAGES:
        page = browser.open(site / name)
        page.wait_for_load_state("networkidle")
        assert page.locator("h1").count() == 1, name
        broken = "() => [...document.images].filter(one => !one.complete || !one.naturalWidth).map(one => one.src)"
        assert page.evaluate(broken) == [], name
    assert [url for url in browser.requests if not url.startswith(("file:", "data:", "blob:"))] == []
