"""A real browser: the system's chromium, driven by playwright; skipped where there is none, with CI=true a failure."""

import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
LONGEST_MS = 600_000  # bounds a hang: playwright's own 30 s pass on a busy computer


def new_page(chromium: Any, **more: Any) -> Any:
    """A page in a context of its own, which waits for as long as it takes."""
    page = chromium.new_page(**more)
    page.set_default_timeout(LONGEST_MS)
    return page


@dataclass
class Browser:
    """A browser, and everything that its pages complained of or asked for beside themselves."""

    chromium: Any
    complaints: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)

    def open(self, path: Path, width: int = 1000, **more: Any) -> Any:
        """A page from a file."""
        page = new_page(self.chromium, viewport={"width": width, "height": 900}, **more)
        page.on("console", lambda message: self.complaints.append(message.text))
        page.on("pageerror", lambda error: self.complaints.append(str(error)))
        page.on("dialog", lambda dialog: self.complaints.append(dialog.message))
        page.on("request", lambda request: self.requests.append(request.url))
        page.goto(path.as_uri())
        return page


@pytest.fixture(scope="session")
def chromium() -> Iterator[Any]:
    """One browser for all tests."""
    found = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if found is None:
        pytest.skip("needs a browser: sudo apt-get install chromium")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        # Root, as in containers, has no sandbox; the pages are our own.
        browser = playwright.chromium.launch(executable_path=found, args=["--no-sandbox"], timeout=LONGEST_MS)
        yield browser
        browser.close()


@pytest.fixture
def browser(chromium: Any) -> Iterator[Browser]:
    """The browser with nothing complained of yet; its pages are closed."""
    watched = Browser(chromium)
    yield watched
    for context in chromium.contexts:
        context.close()


@pytest.fixture(scope="session")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The specs and the paper's measurements in an empty folder."""
    folder = tmp_path_factory.mktemp("checkout")
    shutil.copytree(ROOT / "specs", folder / "specs")
    shutil.copytree(ROOT / "results", folder / "results", ignore=shutil.ignore_patterns("planner*"))
    return folder
