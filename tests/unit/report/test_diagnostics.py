"""One object, three renderings; a terminal obeys nothing that a file says."""

import json

import pytest

from fogspec.base.diagnostics import Diagnostic, Span
from fogspec.report.diagnostics import annotation, as_text, bug_paragraph, show_diagnostics, summary
from fogspec_lab.evaluation.scores import median_error

ONE = Diagnostic(
    "FS201", "spec.constraints.cost must say per what", Span("specs/broken.yaml", 15, 11, 5), "write '$0.002/request'",
    source_line="    cost: 0.002",
)  # fmt: skip


def test_text_is_that_of_the_design() -> None:
    assert as_text(ONE) == (
        "error[FS201]: spec.constraints.cost must say per what\n"
        "  --> specs/broken.yaml:15:11\n"
        "   |\n"
        "15 |     cost: 0.002\n"
        "   |           ^^^^^ write '$0.002/request'"
    )


def test_json_and_github_carry_the_same(capsys: pytest.CaptureFixture[str]) -> None:
    show_diagnostics([ONE], "json")
    (found,) = json.loads(capsys.readouterr().out)
    assert found == {
        "severity": "error", "code": "FS201", "message": ONE.message, "fix": ONE.fix, "path": "specs/broken.yaml",
        "line": 15, "column": 11, "width": 5,
    }  # fmt: skip
    show_diagnostics([ONE], "github")
    assert capsys.readouterr().out == (
        "::error file=specs/broken.yaml,line=15,endLine=15,col=11,endColumn=15,title=FS201::"
        "spec.constraints.cost must say per what; write '$0.002/request'\n"
    )


def test_github_annotations_cannot_be_broken_out_of() -> None:
    odd = Diagnostic("FS104", "50%\nthen\r::error::x", Span("a,b:c.yaml", 1, 1))
    assert (
        annotation(odd)
        == "::error file=a%2Cb%3Ac.yaml,line=1,endLine=1,col=1,endColumn=1,title=FS104::50%25%0Athen%0D::error::x"
    )


def test_nothing_reaches_the_terminal_that_it_would_obey() -> None:
    odd = Diagnostic(
        "FS104", "bad \x1b[31mred", Span("\x1b]0;x\x07.yaml", 1, 3), "write \x9b", source_line="a: \x1b[2J\tb"
    )
    assert not set("\x1b\x07\x9b\t") & set(as_text(odd))


def test_carets_stand_under_what_is_meant_behind_wide_characters() -> None:
    wide = Diagnostic("FS303", "x", Span("s.yaml", 1, 7, 2), source_line="日本: [no]")
    line, caret = as_text(wide).split("\n")[-2:]
    assert line == "1 | 日本: [no]"
    assert caret == "  |         ^^"


def test_long_lines_are_shown_around_the_place() -> None:
    far = Diagnostic("FS303", "x", Span("s.yaml", 1, 5001, 4), source_line="a" * 5000 + "here" + "b" * 5000)
    line, caret = as_text(far).split("\n")[-2:]
    assert len(line) < 200
    assert line[caret.index("^") : caret.rindex("^") + 1] == "here"


def test_long_lists_are_capped_in_text_and_whole_in_json(capsys: pytest.CaptureFixture[str]) -> None:
    show_diagnostics([ONE] * 120)
    err = capsys.readouterr().err
    assert err.count("error[FS201]") == 50
    assert "... and 70 more" in err
    assert "120 errors in 1 file" in err
    show_diagnostics([ONE] * 120, "json")
    assert len(json.loads(capsys.readouterr().out)) == 120


def test_color_is_asked_for_and_never_alone_says_anything(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    show_diagnostics([ONE], color=True)
    painted = capsys.readouterr().err
    assert "\x1b[" in painted
    show_diagnostics([ONE], color=False)
    assert "\x1b[" not in capsys.readouterr().err
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    monkeypatch.setenv("NO_COLOR", "1")
    show_diagnostics([ONE])
    assert "\x1b[" not in capsys.readouterr().err


def test_the_summary_counts() -> None:
    warning = Diagnostic("FS532", "w", Span("b.yaml", 1, 1), severity="warning")
    assert summary([ONE, ONE, warning]) == "2 errors, 1 warning in 2 files; details: fogspec explain FS201"


def test_a_bug_is_one_paragraph_without_paths() -> None:
    try:
        show_diagnostics([None])  # type: ignore[list-item]
    except AttributeError as bug:
        paragraph = bug_paragraph(bug)
    assert "\n" not in paragraph
    assert "AttributeError at report/diagnostics.py:" in paragraph
    assert "/fogspec/" not in paragraph


def test_a_bug_of_the_lab_names_its_place_there() -> None:
    try:
        median_error(None, None, ())  # type: ignore[arg-type]
    except Exception as bug:
        paragraph = bug_paragraph(bug)
    assert " at fogspec_lab/evaluation/scores.py:" in paragraph
    assert "/lab/" not in paragraph
