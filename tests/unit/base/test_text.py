"""Gates: what cannot be seen becomes an escape, and nothing of a text is code of the language around it."""

import json
import subprocess
import xml.dom.minidom

import pytest
from hypothesis import given
from hypothesis import strategies as some
from markdown_it import MarkdownIt

from fogspec.base import text
from fogspec.base.text import blocks, table
from fogspec.base.yaml.reader import decode, documents
from fogspec.base.yaml.writer import flow, yaml_text
from tests.support.hostile_text import HOSTILE

ANY = some.one_of(some.sampled_from(HOSTILE), some.text(max_size=60))
WORDS = some.text(some.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=40)
PLAIN = "specs/grasp-planning-recorded.yaml: $0.526/h, 1.648s [1.58s, 1.719s] (α × 2) — 日本"
GITHUB = MarkdownIt("commonmark", {"html": True, "linkify": False}).enable(["table", "strikethrough"])


def test_plain_text_stays() -> None:
    assert text.visible(PLAIN) == text.line(PLAIN) == PLAIN
    assert text.json_text(json.dumps(PLAIN, ensure_ascii=False)) == json.dumps(PLAIN, ensure_ascii=False)
    assert text.shell_command("fogspec", "compile", "specs/a.yaml") == "fogspec compile specs/a.yaml"


@given(ANY)
def test_a_terminal_gets_nothing_that_it_obeys_and_no_second_line(hostile: str) -> None:
    assert not text.INVISIBLE.search(text.visible(hostile))
    assert text.line(hostile).splitlines() in ([], [text.line(hostile)])
    assert text.visible(text.visible(hostile)) == text.visible(hostile)


def structure(markdown: str) -> list[tuple[str, int]]:
    """Return the kinds of a document's tokens with their depth, without texts."""
    return [
        (one.type, one.level)
        for token in GITHUB.parse(markdown)
        for one in (token, *(token.children or ()))
        if one.type not in ("text", "text_special")
    ]


@given(ANY)
@pytest.mark.parametrize(
    "around",
    ["### {}: x", "- {}", "- why: {}", "| a | {} |\n|--|--|\n| {} | b |", "{}", "<details>\n\n- {}\n\n</details>"],
)
def test_markdown_has_the_structure_of_a_plain_word(around: str, hostile: str) -> None:
    written = text.markdown(hostile)
    if written:
        assert structure(around.replace("{}", written)) == structure(around.replace("{}", "word"))


@given(ANY)
def test_a_code_span_is_one_span_or_plain_text(hostile: str) -> None:
    if text.line(hostile).strip():
        plain = {(), ("code_inline",)}
        assert tuple(kind for kind, _ in structure(f"- x {text.code(hostile)} y") if kind == "code_inline") in plain
        assert [one for one in structure(f"- x {text.code(hostile)} y") if one[0] != "code_inline"] == structure(
            "- x y"
        )


@pytest.mark.parametrize(
    "linked", ["https://evil.example/x", "www.evil.example", "@team", "a@evil.example", "#12", "GH-12"]
)
def test_github_makes_no_link_or_mention_of_it(linked: str) -> None:
    assert linked not in text.markdown(f"see {linked} now")


@given(ANY)
def test_xml_parses_to_the_visible_text(hostile: str) -> None:
    document = xml.dom.minidom.parseString(f'<a b="{text.xml(hostile)}">{text.xml(hostile)}</a>'.encode())
    element = document.documentElement
    assert [one.nodeType for one in element.childNodes] in ([], [element.TEXT_NODE])
    assert "".join(one.data for one in element.childNodes) == text.visible(hostile)


@given(ANY)
def test_json_is_the_same_value(hostile: str) -> None:
    written = text.json_text(json.dumps({hostile: [hostile]}, ensure_ascii=False))
    assert json.loads(written) == {hostile: [hostile]}
    assert not text.INVISIBLE.search(written)


@given(
    ANY.filter(lambda one: ("\0" not in one and one.isprintable()) or one.encode("utf-8", "replace").decode() == one)
)
def test_yaml_is_the_same_value_to_its_own_reader(hostile: str) -> None:
    if "\0" in hostile:
        return
    for written in (
        yaml_text({"a": hostile, "b": [hostile], "c": {"d": hostile}}, hostile, hostile),
        f"a: {flow(hostile)}\n",
    ):
        content, wrong = decode(written.encode(), "a.yaml")
        assert not wrong, written
        (node,), wrong = documents(content, "a.yaml")
        assert not wrong, written
        assert node.value["a"].value == hostile  # type: ignore[index, call-overload]


@pytest.mark.slow
def test_a_shell_reads_the_same_words_from_one_line() -> None:
    words = [one for one in HOSTILE if "\0" not in one and one.encode("utf-8", "replace").decode() == one]
    line = text.shell_command("printf", "%s\\0", *words)
    assert "\n" not in line
    assert not text.INVISIBLE.search(line)
    said = subprocess.run(["bash", "-c", line], check=True, capture_output=True, env={"LC_ALL": "C"}).stdout
    assert said.decode().split("\0")[:-1] == words


@given(some.lists(WORDS, min_size=1, max_size=3))
def test_a_shell_line_has_nothing_unseen(words: list[str]) -> None:
    assert not text.NOT_ON_A_LINE.search(text.shell_command(*words))


@pytest.mark.parametrize(
    ("value", "said"),
    [
        ("", ""),
        ("plain", "`plain`"),
        ("a|b", "a\\|b"),
        ("a`b", "``a`b``"),
        ("`a", "`` `a ``"),
        (" a ", "`a`"),
        (7, "`7`"),
    ],
)
def test_code_spans_by_hand(value: object, said: str) -> None:
    assert text.code(value) == said


def test_a_paragraph_has_as_many_lines_as_it_was_given() -> None:
    assert text.paragraph(["one\ntwo", "three"]).count("\n") == 1
    assert text.paragraph(["one", "two"]) == "one\ntwo"


def test_a_table_shortens_names_that_do_not_fit_in_their_middle() -> None:
    names = [f"c6i.{'very-long-' * 20}{size}" for size in ("large", "4xlarge")]
    lines = table(
        [["instance type", "price", ""], *([name, "$0.68/h", "measured\u00a0here\u00a0twice"] for name in names)], 80
    )
    assert all(len(one) <= 80 for one in lines)
    for name, one in zip(names, lines[1:], strict=True):
        start, _, end = one.split()[0].partition("…")
        assert name.startswith(start)
        assert name.endswith(end)
        assert len(start) >= len(end) > 15
    assert lines[1].endswith("$0.68/h  measured here twice")
    assert table([["name"], ["motion-planning-cubicles-recorded"], ["motion-planning-apartment-recorded"]], 18) == [
        "  name",
        "  motion-pla…s-recorded",
        "  motion-pla…t-recorded",
    ]
    assert table([["name"], ["x" * 30]], 20) == ["  name", f"  {'x' * 9}…{'x' * 8}"]


def test_a_table_may_have_empty_columns_and_cells_that_are_not_broken() -> None:
    assert table([["name", ""], ["a", ""]], 80) == ["  name", "  a"]
    assert table([["", ""]], 80) == [""]
    rows = [["application", "x"], ["tiny\u00a0(no\u00a0spec)", "long words here"]]
    assert table(rows, 26, indent=0) == ["application     x", "tiny (no spec)  long words", "                here"]


def test_a_table_of_figures_is_cut_into_blocks_that_fit() -> None:
    rows = [["name", "one", "two", "three"], ["a", "1", "22", "333"]]
    assert blocks(rows, 21) == ["name  one  two  three", "a       1   22    333"]
    twice = [["name", "of", "one"], ["a", "b", "1"]]
    assert blocks(twice, 13, keys=2) == ["name  of  one", "a     b     1"]
    assert blocks(twice, 12, keys=2) == ["name  of  one", "a     b     1"], "at least one figure"
    assert blocks(rows, 20) == ["name  one  two", "a       1   22", "", "name  three", "a       333"]
