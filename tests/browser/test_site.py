"""The documentation site in a real browser: it asks for nothing but its own files, and its pictures are there."""

import subprocess
import sys
from pathlib import Path

from tests.browser.conftest import ROOT, Browser

PAGES = ("index.html", "tutorial.html", "reference/verbs.html", "explanation/method.html", "adr/index.html")


def test_pages_ask_for_nothing_from_elsewhere(browser: Browser, tmp_path: Path) -> None:
    words = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path)]
    subprocess.run(words, cwd=ROOT, check=True, timeout=120, capture_output=True)
    for name in PAGES:
        page = browser.open(tmp_path / name)
        page.wait_for_load_state("networkidle")
        assert page.locator("h1").count() == 1, name
        broken = "() => [...document.images].filter(one => !one.complete || !one.naturalWidth).map(one => one.src)"
        assert page.evaluate(broken) == [], name
    assert [url for url in browser.requests if not url.startswith(("file:", "data:", "blob:"))] == []
