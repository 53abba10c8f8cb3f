"""The site's own search, in a real browser: a reader who types the field's words finds the page first."""

import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from tests.browser.conftest import new_page
from tests.support.site import site  # noqa: F401

# What a reader types, and the pages that answer it, any of them.
QUERIES: dict[str, tuple[str, ...]] = {
    "teardown": ("howto/deploy", "glossary"),
    "rollback": ("howto/deploy",),
    "jitter": ("howto/link-robot-and-cloud",),
    "vpn": ("howto/link-robot-and-cloud",),
    "wi-fi": ("howto/link-robot-and-cloud",),
    "rviz": ("howto/your-own-nodes",),
    "jetson": ("howto/running-robot", "howto/your-own-nodes"),
    "nvidia driver": ("howto/your-own-nodes", "howto/container-image"),
    "throughput": ("explanation/cost", "glossary"),
    "out of memory": ("howto/troubleshooting",),
    "rosbag": ("howto/your-own-nodes", "howto/troubleshooting"),
    "uninstall": ("installation",),
    "pareto": ("explanation/the-paper", "explanation/charts", "glossary", "explanation/method"),
    "tail latency": ("howto/your-own-nodes", "explanation/method", "glossary", "explanation/uncertainty"),
    "network latency": ("howto/troubleshooting", "explanation/uncertainty", "howto/link-robot-and-cloud"),
    "quota": ("howto/troubleshooting", "howto/measure-on-a-cloud"),
    "spot": ("howto/prices",),
    "autostop": ("howto/measure-on-a-cloud", "howto/deploy"),
    "budget": ("howto/measure-on-a-cloud", "explanation/cost"),
    "cuda": ("howto/your-own-nodes", "installation", "reference/support"),
    "gpu": ("howto/your-own-nodes", "reference/support", "reference/fields"),
    "isaac": ("reference/support", "howto/your-own-nodes"),
    "dds": ("howto/link-robot-and-cloud", "reference/support"),
    "zenoh": ("howto/link-robot-and-cloud",),
    "wireguard": ("howto/link-robot-and-cloud",),
    "rate limit": ("howto/troubleshooting", "howto/measure-on-a-cloud"),
    "kubernetes": ("howto/slurm-and-kubernetes",),
    "slurm": ("howto/slurm-and-kubernetes",),
    "ros2 launch": ("howto/your-own-nodes", "tutorial-ros2"),
    "pip install": ("installation",),
    "docker image": ("howto/container-image", "howto/your-own-nodes"),
    "windows": ("installation", "reference/support"),
    "offline": ("installation", "howto/troubleshooting"),
    "proxy": ("installation", "howto/troubleshooting"),
    "github action": ("howto/editor-and-ci",),
    "pre-commit": ("howto/editor-and-ci",),
    "vscode": ("howto/editor-and-ci",),
    "secret": ("explanation/security", "howto/your-own-nodes", "howto/deploy"),
    "license": ("index", "installation"),
    "exit code": ("reference/verbs", "howto/troubleshooting"),
    "environment variables": ("reference/environment",),
    "confidence interval": ("explanation/uncertainty", "glossary"),
    "gaussian process": ("explanation/method",),
    "cherrypick": ("comparison", "explanation/how-good"),
    "foxglove mcap": ("howto/troubleshooting", "howto/your-own-nodes"),
    "moveit": ("howto/your-own-nodes", "explanation/case-studies"),
    "nav2": ("howto/your-own-nodes", "howto/running-robot", "reference/support"),
    "firewall port": ("howto/link-robot-and-cloud", "howto/troubleshooting"),
    "upgrade version": ("reference/versions",),
    "v1alpha1": ("reference/versions",),
    "resume interrupted benchmark": ("howto/measure-on-a-cloud", "howto/troubleshooting"),
    "orphaned machines": ("howto/troubleshooting", "glossary", "howto/deploy"),
    "cold start": ("explanation/cost", "howto/deploy"),
    "cost per month": ("explanation/cost", "explanation/numbers"),
    "arm64 graviton": ("reference/support", "reference/fields", "howto/prices"),
    "autoscaling": ("comparison",),
    "terraform": ("comparison",),
}
WATCH = """
    window.sent = []; window.answers = [];
    const Real = window.Worker;
    window.Worker = class extends Real {
        constructor(...words) {
            super(...words);
            this.addEventListener("message", event => { if (event.data.type === 3) window.answers.push(event.data.data); });
        }
        postMessage(message, ...more) {
            if (message.type === 2) window.sent.push(message.data);
            super.postMessage(message, ...more);
        }
    };
"""


class Quiet(SimpleHTTPRequestHandler):
    """Serve files without a log."""

    def log_message(self, *_: object) -> None:
        """Print nothing."""


@pytest.fixture(scope="module")
def search(chromium: Any, site: Path) -> Iterator[Any]:
    """A page of the site as a server shows it, with its search open."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(site)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    page = new_page(chromium, viewport={"width": 1280, "height": 900})
    page.add_init_script(WATCH)
    page.goto(f"http://127.0.0.1:{server.server_port}/index.html")
    page.locator(".md-search__input").click()
    yield page
    page.close()
    server.shutdown()


def found(page: Any, query: str) -> list[str]:
    """The pages of the results of `query`, best first."""
    page.locator(".md-search__input").fill(query)
    page.keyboard.press("End")  # the search listens to keys, not to values
    # Each question has one answer, in order: the last is that of the last question.
    page.wait_for_function(
        "query => sent.at(-1)?.includes(query) && answers.length === sent.length", arg=query.split()[-1]
    )
    results = page.evaluate("answers.at(-1).items.map(item => item[0].location)")
    return [Path(one.partition("#")[0]).with_suffix("").as_posix() or "index" for one in results]


@pytest.mark.parametrize("query", QUERIES)
def test_a_query_in_the_fields_words_finds_its_page(search: Any, query: str) -> None:
    pages = found(search, query)
    assert set(pages[:1]) & set(QUERIES[query]), pages[:8]


def test_decisions_come_after_the_pages_of_readers(search: Any) -> None:
    for query in QUERIES:
        pages = found(search, query)
        assert not pages[0].startswith("adr/"), query
