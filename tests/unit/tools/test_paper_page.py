"""The page of the paper: its figures are the paper's, at their line, and our own runs are listed and drawn."""

import re

import numpy as np
import pytest

from fogspec.numerics.pareto import pareto
from fogspec_lab.paper import figures, page, tables
from fogspec_lab.paper.cases import TITLES, Case, OwnRun, cases
from fogspec_lab.paper.claims import Claim, claims, unaccounted
from tests.conftest import ROOT, SHARED

RUN = OwnRun("arm", "m", "shapes of one host", (("1cpu-1gib", 1.0, 2.0, 40.0), ("2cpu-1gib", 2.0, 1.5, 35.0)))


def test_path_lengths_are_listed_with_their_unit_and_where_they_were_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tables, "own_runs", lambda: (RUN,))
    found = tables._path_length()
    assert found.rows == [("arm", "1cpu-1gib", "1", "2 s", "40 m"), ("arm", "2cpu-1gib", "2", "1.5 s", "35 m")]
    assert "not published as numbers" in found.before
    assert "shapes of one host" in found.before
    assert "paper-path-length.svg" in page.page([found])


def test_every_run_is_drawn_by_its_latency_and_its_path_length() -> None:
    drawn = figures._path_lengths((RUN,))
    assert drawn.count("<circle") == 2 * len(RUN.samples) + 1  # and the legend
    assert "path length in m" in drawn
    assert "Our own runs, on shapes of one host" in drawn


def test_no_line_of_the_page_is_broken_inside_a_word() -> None:
    assert page._wrapped("one two three", 7) == ["one two", "three"]


TEX = SHARED / "data" / "paper" / "fogros2-config.tex"
DOCS = [page.PAGE, ROOT / "README.md", *(one for one in sorted((ROOT / "docs").rglob("*.md")) if one != page.PAGE)]


def cells_of_the_paper() -> list[str]:
    """Every cell of the page's columns that are headed `paper`."""
    found, column = [], None
    for line in page.PAGE.read_text("utf-8").splitlines():
        cells = [cell.strip() for cell in line.strip("|").split(" | ")] if line.startswith("| ") else None
        if cells is None:
            column = column if line.startswith("|--") else None
        elif column is None:
            column = cells.index("paper") if "paper" in cells else -1
        elif column >= 0:
            found.append(cells[column])
    return found


def test_what_the_page_says_of_the_paper_is_its_claims_and_all_of_them() -> None:
    shown = {one.shown for one in claims().values() if one.cell}
    cells = [[cell] if cell in shown else cell.split("; ") for cell in cells_of_the_paper() if cell != "-"]
    said = {text for cell in cells for text in cell}
    assert said <= shown
    in_sentences = {claims()[name].shown for name in ("limit.caption", "window", "alpha")}
    assert shown - said == in_sentences
    assert all(one in page.PAGE.read_text("utf-8") for one in in_sentences)


def test_a_claim_is_on_the_page_or_says_why_not(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert unaccounted(page.PAGE.read_text("utf-8")) == []
    mine = {
        "shown": Claim(line=1, says="a", cell="12 s"),
        "left": Claim(line=1, says="a", cell="2 s"),
        "mute": Claim(line=1, says="a"),
        "both": Claim(line=1, says="a", cell="12 s", not_shown="b"),
        "reasoned": Claim(line=1, says="a", not_shown="b"),
    }
    monkeypatch.setattr("fogspec_lab.paper.claims.claims", lambda: mine)
    assert unaccounted("| 12 s |") == ["mute", "both", "left"]
    assert page.main(check=True) == 3
    assert "claims.yaml: give a cell" in capsys.readouterr().out


# What is in these commands of LaTeX is layout; a name with a digit in it is no figure.
COMMANDS = "url|cite|ref|label|includegraphics|begin|end|renewcommand|cmidrule|multicolumn|cellcolor"
LAYOUT = re.compile(rf"\\(?:{COMMANDS})(?:\[[^]]*\]|\{{[^}}]*\}})+")
NAMES = {
    "ROS2",
    "fogros2",
    "FogROS2",
    "SLAM2",
    "x_1",
    "x_2",
    "fr1",
    "C3.ai",
    "fogros2.SkyLaunchDescription",
    "fogros2_examples",
}


def figures_in(text: str) -> set[str | float]:
    words = re.findall(r"[\w.]*\d[\w.]*", text.replace("ROS 2", "").replace("^{2}", ""))
    found = {word.strip(".").removesuffix("x") for word in words} - NAMES
    return {float(one) if re.fullmatch(r"[\d.]+", one) else one for one in found}


def lines_of_the_paper() -> dict[int, str]:
    text = TEX.read_text("utf-8")
    start = text[: text.index("\\begin{document}")].count("\n") + 1
    return {number: line for number, line in enumerate(text.splitlines(), 1) if number > start}


needs_the_paper = pytest.mark.skipif(not TEX.is_file(), reason="FOGSPEC_SHARED has no data/paper/fogros2-config.tex")


@needs_the_paper
def test_each_figure_of_a_claim_stands_at_its_lines_of_the_paper() -> None:
    paper = lines_of_the_paper()
    for name, one in claims().items():
        there = figures_in(" ".join(paper[line] for line in one.lines))
        # What is inferred is not there, but what it is inferred from.
        cell = "" if one.one_of and not one.machines else one.cell
        values = " ".join(map(str, one.values.values()))
        assert figures_in(f"{one.says} {cell} {values}") <= there, name


@needs_the_paper
def test_each_figure_of_the_paper_is_a_claim() -> None:
    for number, line in lines_of_the_paper().items():
        ours = " ".join(f"{one.says} {one.cell}" for one in claims().values() if number in one.lines)
        assert figures_in(LAYOUT.sub(" ", line)) <= figures_in(ours), number


@needs_the_paper
def test_claims_and_page_have_no_words_of_the_paper() -> None:
    def runs(text: str) -> set[tuple[str, ...]]:
        words = re.findall(r"[a-z]+", text.lower())
        return {tuple(words[i : i + 6]) for i in range(len(words) - 5)}

    paper = runs(LAYOUT.sub(" ", "\n".join(lines_of_the_paper().values())))
    assert len(paper) > 1000
    assert not paper & runs(" . ".join(f"{one.says} . {one.cell}" for one in claims().values()))
    assert not paper & runs(page.PAGE.read_text("utf-8"))


def test_what_fits_the_paper_and_is_not_in_it_is_marked() -> None:
    assert claims()["price.SLAM"].shown.endswith("(inferred)")
    text = page.PAGE.read_text("utf-8")
    assert "178.033 (inferred, one of 55)" in text
    assert [name for name, one in claims().items() if one.one_of and one.mark not in text] == []


@pytest.mark.parametrize(
    ("misquote", "unless"),
    [
        (r"r6i\.xlarge", r"\(inferred\b"),
        (r"4\.95x", r"c4\.8xlarge|Tables I and II"),
        (r"i3\.16xlarge", None),
        (r"Figures? [345]\b", r"frontier"),
        (r"full sweep has no", None),
        (r"deviation, (paper|ours)", None),
        (r"word for word", None),
    ],
)
def test_no_page_misquotes_the_paper_again(misquote: str, unless: str | None) -> None:
    for path in DOCS:
        for block in path.read_text("utf-8").replace("\n| ", "\n\n| ").split("\n\n"):
            if re.search(misquote, block):
                assert unless is not None, f"{path}: {block}"
                assert re.search(unless, block), f"{path}: {block}"


def medians(case: Case) -> dict[float, float]:
    """The median latency by vCPUs of the samples without a GPU."""
    known = [one for one in case.models.observations if one.machine.gpu is None]
    values = {vcpus: [one.values["latency"] for one in known if one.machine.cpus == vcpus]
              for vcpus in {one.machine.cpus for one in known}}  # fmt: skip
    return {vcpus: float(np.median(found)) for vcpus, found in values.items()}


@pytest.mark.parametrize("title", TITLES.values())
def test_the_titles_of_the_charts_are_true_of_the_measurements(title: str) -> None:
    (case,) = [one for one in cases() if one.title == title]
    latency_s = medians(case)
    assert (latency_s[64] > latency_s[16]) == (title == "SLAM")
    offers, latency = case.open.offers, case.open.latency
    front = pareto(offers.price_usd_per_hour, latency.value)
    assert not latency.measured[front].all(), "predicted machines are on the frontier"
