"""Hostile strings wherever text comes from, through every verb: the output has their text, and nothing of their meaning."""

import collections
import html.parser
import json
import re
import subprocess
import xml.dom.minidom
from pathlib import Path
from typing import Any

import pytest
from markdown_it import MarkdownIt

from fogspec.base.text import INVISIBLE
from fogspec.base.yaml.writer import flow
from fogspec.deploy.schema import LiveState
from fogspec.language.loader import load, read_plain
from fogspec.results.io import read_results_folder
from fogspec_lab import cli as lab
from tests.e2e.test_diff import commit, git
from tests.support.files import write_yaml
from tests.support.hostile_text import HOSTILE
from tests.support.results import write
from tests.support.running import CATALOG, Shell, copied, measure, shell, spec  # noqa: F401

AT = ("--catalog", "offers.csv")
MANIFEST = "compiled/demo/manifest.yaml"
# What a spec may hold: no NUL, and no half of a character, which no UTF-8 file has.
TEXTS = [one for one in HOSTILE if "\0" not in one and one.encode("utf-8", "replace").decode() == one]
VERBS: tuple[tuple[str, ...], ...] = (
    ("validate",),
    ("validate", "-o", "json"),
    ("validate", "-o", "github"),
    ("validate", "demo", "-o", "yaml"),
    ("explain", "demo"),
    ("explain", "demo", "-o", "json"),
    ("menu", "demo"),
    ("menu", "demo", "-o", "json"),
    ("status",),
    ("status", "-o", "json"),
    ("watch", "demo", "--once", "--max-restarts", "0"),
    ("watch", "demo", "--once", "--max-restarts", "0", "-o", "json"),
    ("check", "-v"),
    ("check", "-o", "json"),
    ("check", "-o", "github"),
    ("check", "-o", "statement"),
    ("check", "--since", "HEAD"),
    ("diff",),
    ("diff", "-o", "json"),
    ("diff", "--markdown"),
    ("diff", "--since", "HEAD"),
    ("diff", "--since", "HEAD", "-o", "json"),
    ("diff", "--since", "HEAD", "--markdown"),
    ("bench", "demo", "--dry-run", "-o", "json"),
    ("bench", "demo", "--runner", "local", "--dry-run"),
    ("apply", MANIFEST, "--dry-run"),
    ("report", "demo", "--out", "-"),
    ("evaluate", "--suite", "results"),
    ("conformance", "--infra", "aws/us-east-1", *AT, "--dry-run"),
    ("down", "demo"),
)
READERS = ("compile", "status", "check", "diff", "bench", "apply")
FORGED = re.compile(r"(?m)^[\s>*#|-]*(INJECTED|::\w+)")
MARKDOWN = MarkdownIt("commonmark", {"html": True}).enable(["table", "strikethrough"])
HTML = re.compile(r"<details><summary>[\w, ]+</summary>|<!-- fogspec review -->|</?(details|summary)>")
TRIED: collections.Counter[str] = collections.Counter()


def ran(shell: Shell, verb: tuple[str, ...], strings: int) -> str:
    """Run a verb on texts; check what it printed, and return its output."""
    ended = shell(*verb, code=None, run=lab.main) if verb[0] in lab.COMMANDS else shell(*verb, code=None)
    TRIED[verb[0]] += strings
    said = ended.out + ended.err
    assert "has a bug" not in said, said
    assert ended.code != 70
    assert not (found := INVISIBLE.search(said)), (verb, said[max(0, found.start() - 80) : found.end() + 80])
    if "github" not in verb and verb[0] != "report":
        assert not (forged := FORGED.search(said)), (verb, said[max(0, forged.start() - 200) : forged.end() + 80])
    if "json" in verb and ended.out.strip():
        json.loads(ended.out)
    return ended.out


def check_markdown(text: str) -> None:
    tokens = [one for token in MARKDOWN.parse(text) for one in (token, *(token.children or ()))]
    kinds = {one.type for one in tokens}
    assert not kinds & {
        "link_open",
        "image",
        "fence",
        "code_block",
        "em_open",
        "strong_open_x",
        "s_open",
        "blockquote_open",
    }
    for one in tokens:
        if one.type in ("html_block", "html_inline"):
            assert HTML.sub("", one.content).strip() == "", one.content
    headings = [tokens[i + 1].content for i, one in enumerate(tokens) if one.type == "heading_open"]
    assert all(one.startswith(("fogspec: what this change", "demo: ")) for one in headings), headings


class Elements(html.parser.HTMLParser):
    """Counts the elements and attributes of a page."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.found: collections.Counter[str] = collections.Counter()
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.update([tag, *(f"{tag} {name}" for name, _ in attrs)])

    def handle_comment(self, data: str) -> None:
        self.found["<!--"] += 1


def check_files(folder: Path) -> None:
    """What fogspec wrote parses, and holds nothing that cannot be seen."""
    written = [
        path for name in ("compiled", "results", ".fogspec") for path in (folder / name).rglob("*") if path.is_file()
    ]
    for path in written:
        if path.suffix not in (".yaml", ".svg", ".xml", ".py", ".sh", ".html"):
            continue
        text = path.read_text("utf-8")
        assert not INVISIBLE.search(text), path
        if path.suffix == ".yaml":
            read_plain(path)
        elif path.suffix in (".svg", ".xml"):
            xml.dom.minidom.parseString(text.encode())
        elif path.suffix == ".py":
            compile(text, str(path), "exec")
        elif path.suffix == ".sh":
            subprocess.run(["bash", "-n", path], check=True)


def hostile_spec(texts: list[str]) -> str:
    pairs = {text: text for text in texts}
    robot = {"package": "arm", "executable": "client", "parameters": pairs, "arguments": texts}
    environment = {f"E{number}": text for number, text in enumerate(texts)}
    node = {"cmd": ["python3", "work.py", *texts], "env": environment}
    return spec(cloud=f"[{flow(node)}]", robot=f"[{flow(robot)}]")


def made(shell: Shell, texts: list[str]) -> None:
    """An application that is compiled, measured and committed, with the texts in all its files."""
    shell.write("offers.csv", CATALOG)
    shell.write("specs/work.py", "print('work')\n")
    shell.write("specs/demo.yaml", hostile_spec(texts))
    shell("compile", "specs/demo.yaml", *AT)
    shell("lock", *AT)
    shell("compile", "specs/demo.yaml")
    measure(shell)
    rewrite(shell, texts)
    shell("compile", "specs/demo.yaml", *AT)
    shell.write(".gitignore", ".fogspec/\n")
    git(shell.folder, "init", "-q")
    commit(shell, "first")


def rewrite(shell: Shell, texts: list[str]) -> None:
    """Put texts into every free field of the results, sealed as a lying machine's would be."""
    path = shell.folder / "results/demo"
    results = read_results_folder(path)
    samples = [
        one.model_copy(update={"detail": texts[i % len(texts)], "measured_on": texts[-1 - i % len(texts)]})
        for i, one in enumerate(results.spec.samples)
    ]
    body = results.spec.model_copy(update={"samples": samples, "source": "; ".join(texts)})
    write(path, body)


def spoil(value: Any, texts: list[str], at: list[int]) -> Any:
    """Replace every text in a document, and add a field named by one."""
    at[0] += 1
    text = texts[at[0] % len(texts)]
    if isinstance(value, dict):
        return {**{key: spoil(one, texts, at) for key, one in value.items()}, text: text}
    if isinstance(value, list):
        return [spoil(one, texts, at) for one in value]
    return text if isinstance(value, str) and at[0] % 2 else value


@pytest.fixture
def written(shell: Shell) -> Shell:
    copied(shell, "a repository with hostile texts in all its files", lambda folder: made(folder, TEXTS))
    return shell


def test_texts_in_specs_results_and_locks_through_every_verb(written: Shell) -> None:
    for verb in VERBS[:-2]:
        output = ran(written, verb, len(TEXTS))
        if "--markdown" in verb:
            check_markdown(output)
    check_files(written.folder)
    # The spec means the same after a detour through `validate -o yaml`.
    again = written.neighbour("again", written("validate", "demo", "-o", "yaml").out)
    first, second = (load([str(written.folder / one)])[0].application for one in ("specs/demo.yaml", again))
    assert first == second
    assert list(first.spec.robot[0].parameters) == TEXTS


@pytest.mark.slow
def test_a_report_has_the_elements_of_a_harmless_one(written: Shell, tmp_path: Path) -> None:
    page = written("report", "demo", "--out", "-").out
    folder = Shell(tmp_path / "plain", written.monkeypatch, written.capsys)
    folder.folder.mkdir()
    made(folder, [f"text{number}" for number in range(len(TEXTS))])
    assert Elements(page).found == Elements(folder("report", "demo", "--out", "-").out).found


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [MANIFEST, "compiled/demo/plan.yaml", "specs/demo.lock", "a result", "compiled/demo/menu.yaml"]
)
def test_documents_that_somebody_wrote(name: str, written: Shell) -> None:
    """Fields and values of committed files are texts to `diff`, `verify` and `status`."""
    path = written.folder / name
    path = path if name != "a result" else next((written.folder / "results" / "demo").glob("*.yaml"))
    write_yaml(path, spoil(read_plain(path), TEXTS, [0]), TEXTS[0])
    for verb in (one for one in VERBS if one[0] in READERS):
        output = ran(written, verb, len(TEXTS))
        if "--markdown" in verb:
            check_markdown(output)


@pytest.mark.slow
def test_a_live_state_that_somebody_wrote(written: Shell) -> None:
    path = written.folder / ".fogspec/demo/deployment.yaml"
    state = {
        "apiVersion": LiveState.model_fields["apiVersion"].default, "kind": LiveState.model_fields["kind"].default,
        "metadata": {"name": "demo"}, "spec": {"machines": [], "spent": 0.0},
    }  # fmt: skip
    for shift in range(2):
        write_yaml(path, spoil(state, TEXTS[shift * 30 :], [shift]), "a test")
        for verb in (("status",), ("diff",), ("apply", MANIFEST, "--yes"), ("down", "demo")):
            ran(written, verb, len(TEXTS))


def file_names() -> list[str]:
    return [one for one in TEXTS if "/" not in one and 0 < len(one.encode()) < 200 and one not in (".", "..", "~")]


@pytest.mark.slow
def test_names_of_files_catalogs_and_branches(written: Shell) -> None:
    written("compile", *AT)
    for text in file_names()[::3]:
        path = written.folder / f"{text}.yaml"
        path.write_text(spec(name="other").replace("latency: 10s", "latency: ten"), "utf-8")
        written.write(f"{text}.csv", CATALOG.replace("a.large", flow(text).replace('"', "'")))
        ran(written, ("validate", "--", f"{text}.yaml"), 1)
        ran(written, ("validate", "-o", "github", "--", f"{text}.yaml"), 1)
        ran(written, ("compile", "demo", "--catalog", f"{text}.csv"), 1)
        ran(written, ("diff", f"--since={text}"), 1)
        ran(written, ("explain", "--", text), 1)
        ran(written, ("init", "new", "--from-launch", f"{text}.launch.py"), 1)
        ran(written, ("bench", "--", text), 1)
        ran(written, ("menu", "demo", f"--latency={text}"), 1)
        ran(written, (text,), 1)


@pytest.mark.slow
def test_a_next_command_can_be_pasted(shell: Shell) -> None:
    """The words of a hint are the words that were meant, whatever is in the name of a file."""
    shell.write("offers.csv", CATALOG)
    for text in file_names()[1::3]:
        name = f"specs/{text}.yaml"
        shell.write("specs/work.py", "print('work')\n")
        (shell.folder / name).write_text(spec(), "utf-8")
        said = shell("compile", *AT, "--", name)
        (line,) = [one for one in said.out.splitlines() if one.startswith("next: ")]
        command = line.removeprefix("next: ").partition("; fogspec explain")[0].strip()
        found = subprocess.run(
            ["bash", "-c", f"fogspec() {{ printf '%s\\0' \"$@\"; }}; {command}"],
            capture_output=True,
            check=True,
            cwd=shell.folder,
        ).stdout
        assert found.decode().split("\0")[:2] == ["bench", name], line
        TRIED["hint"] += 1
        (shell.folder / name).unlink()


@pytest.fixture(scope="module", autouse=True)
def counted() -> Any:
    yield
    print(f"\nhostile strings: {len(HOSTILE)}; strings x verbs in this process: {sum(TRIED.values())}")
