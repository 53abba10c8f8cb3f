"""Text is data: each oddity of YAML has one outcome; all mistakes come at once; fogspec's own files are guarded."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from fogspec.base.diagnostics import DiagnosticError
from fogspec.base.errors import InvalidInput
from fogspec.language.loader import check_file, check_text, load, read_document
from fogspec.results.schema import Result
from tests.support.relative import work_of
from tests.support.results import first

ROOT = Path(__file__).resolve().parents[3]
SPEC = """\
apiVersion: fogspec.dev/v1alpha1
kind: Application
metadata: { name: arm }
spec:
  cloud: [{ package: a, executable: b, parameters: { value: VALUE } }]
  ros: { distro: humble }
  probe: { callback: plan }
  infra: [aws]
  benchmark: { budget: $2.50 }
"""


def codes(content: str | bytes) -> list[str]:
    raw = content.encode() if isinstance(content, str) else content
    return [one.code for one in check_text(raw, "spec.yaml")[1]]


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("38.0", 38.0), ("38", 38), ("1e-3", 0.001), ("-.5", -0.5), ("+7", 7), ("0x1F", 31), ("0o17", 15), ("true", True),
        ("True", True), ("'no'", "no"), ('"010"', "010"), ("'5:00'", "5:00"), ("y", "y"), ("2024-01-01", "2024-01-01"),
        ("1.2.3", "1.2.3"), ("'a: b'", "a: b"), ("0", 0), ("-0.0", -0.0), (".1e2", 10.0), ("1.", 1.0),
        ("12e03", 12000.0), ("inf", "inf"), ("nan", "nan"), ("=", "="), ("'1,5'", "1,5"),
    ],
)  # fmt: skip
def test_scalars_mean_what_yaml_1_2_says(text: str, value: object) -> None:
    loaded, wrong = check_text(SPEC.replace("VALUE", text).encode(), "spec.yaml")
    assert wrong == []
    found = loaded[0].application.spec.cloud[0].parameters["value"]
    assert found == value
    assert type(found) is type(value)


@pytest.mark.parametrize(
    ("text", "code", "fix"),
    [
        ("no", "FS110", "write false, or 'no' in quotes"), ("Yes", "FS110", "write true, or 'Yes' in quotes"),
        ("on", "FS110", "write true, or 'on' in quotes"), ("010", "FS110", "write 10, or '010' in quotes"),
        ("5:00", "FS110", "write '5:00' in quotes, or a duration such as 5min"),
        ("1_000", "FS110", "write 1000, or '1_000' in quotes"), (".nan", "FS111", "write a number"),
        ("-.inf", "FS111", "write a number"), ("1e999", "FS111", "write a smaller number"),
        ("9223372036854775808", "FS111", "write 9.223372036854776e+18, or '9223372036854775808' in quotes"),
        ("1" * 5000, "FS111", "write it shorter, or in quotes"), ("!!int 5", "FS109", "remove it"),
        ("null", "FS506", "give it a value, or remove it"), ("~", "FS506", "give it a value, or remove it"),
    ],
)  # fmt: skip
def test_scalars_that_readers_take_differently_are_refused(text: str, code: str, fix: str) -> None:
    _, wrong = check_text(SPEC.replace("VALUE", text).encode(), "spec.yaml")
    assert [(one.code, one.fix, one.span.line) for one in wrong] == [(code, fix, 5)]


def test_encodings() -> None:
    spec = SPEC.replace("VALUE", "'grün'")
    assert codes(spec) == []
    assert codes(b"\xef\xbb\xbf" + spec.encode()) == []
    assert codes(spec.replace("\n", "\r\n")) == []
    assert codes(spec.encode("utf-16")) == ["FS102"]
    assert codes(spec.encode("utf-16-le")) == ["FS102"] or codes(spec.encode("utf-16-le")) == ["FS103"]
    assert codes(spec.encode("latin-1")) == ["FS102"]
    assert codes(spec.replace("\n", "\r")) == ["FS103"]
    assert codes(spec.replace("grün", "gr\x00n")) == ["FS103"]
    assert codes(spec.replace("'grün'", '"gr\\ud800n"')) == ["FS103"]
    assert codes(spec.replace("'grün'", '"gr\\0n"')) == ["FS103"]
    assert codes(spec.replace("grün", "gr\u2028n")) == ["FS103"]


def test_a_forbidden_character_is_located_behind_wide_ones() -> None:
    _, wrong = check_text(SPEC.replace("VALUE", "'日本\u202e'").encode(), "spec.yaml")
    assert (wrong[0].span.line, wrong[0].span.column) == (5, SPEC.split("\n")[4].index("VALUE") + 4)


BOMB = "b: &b0 [x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"b{i}: &b{i} [{','.join([f'*b{i - 1}'] * 9)}]\n" for i in range(1, 10)
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ("content", "code"),
    [
        (BOMB, "FS107"),
        ("a: &a [*a]\n", "FS107"), ("[" * 100_000, "FS112"), ("a: " + "{a: " * 50_000, "FS112"), ("- " * 50_000, "FS112"),
        ("? " * 50_000, "FS112"), ("x" * (10 << 20), "FS112"), ("a: " + "word " * 150_000, "FS302"), ("", "FS114"),
        ("--- \n...\n", "FS114"), ("%YAML 1.1\n---\na: b\n", "FS302"), ("just text\n", "FS303"), ("- a\n", "FS303"),
    ],
)  # fmt: skip
def test_hostile_files_end_soon(content: str, code: str) -> None:
    found: list[str] = []
    assert work_of(lambda: found.extend(codes(content)), 1) < 1250
    assert code in found


def test_an_alias_repeats_what_its_anchor_marked() -> None:
    loaded, wrong = check_text(
        SPEC.replace("VALUE", "&v 5")
        .replace(
            "  ros:",
            "  connectivity: { link: zenoh, expose: {/x: topic} }\n"
            "  robot: [{ package: c, executable: d, parameters: { x: *v } }]\n  ros:",
        )
        .encode(),
        "spec.yaml",
    )
    assert wrong == []
    assert loaded[0].application.spec.robot[0].parameters == {"x": 5}


def test_keys_of_ones_own_are_ignored_but_not_among_parameters() -> None:
    spec = SPEC.replace("VALUE", "1, x-kept: 2").replace(
        "spec:\n", "x-team: { any: [thing] }\nspec:\n  x-note: 010\n", 1
    )
    loaded, wrong = check_text(spec.replace("010", "10").encode(), "spec.yaml")
    assert wrong == []
    assert loaded[0].application.spec.cloud[0].parameters == {"value": 1, "x-kept": 2}


def test_all_mistakes_come_at_once_sorted_by_line_fields_and_rules_alike(tmp_path: Path) -> None:
    spec = (
        SPEC.replace("VALUE", "1")
        .replace("callback: plan", "callback: plan, match: stamp")
        .replace(
            "  infra",
            "  constrants: { latency: 2 }\n  objective: { alpha: 7, load: { rate: 1/s, session: 1h } }\n  infra",
        )
    )
    first, second = tmp_path / "b.yaml", tmp_path / "a.yaml"
    first.write_text(spec)
    second.write_text(SPEC.replace("VALUE", "1").replace("infra: [aws]", "infra: aws"))
    _, wrong = check_file([first, second])
    said = [(Path(one.span.path).name, one.span.line, one.code) for one in wrong]
    assert said == [
        ("b.yaml", 7, "FS514"), ("b.yaml", 8, "FS301"), ("b.yaml", 8, "FS202"), ("b.yaml", 9, "FS206"),
        ("b.yaml", 9, "FS518"), ("a.yaml", 3, "FS510"), ("a.yaml", 8, "FS303"),
    ]  # fmt: skip
    with pytest.raises(DiagnosticError) as problems:
        load([first, second])
    assert [one.code for one in problems.value.diagnostics] == [code for *_, code in said]


def test_a_rule_is_silent_about_fields_that_are_wrong_by_themselves() -> None:
    spec = SPEC.replace("VALUE", "1").replace("  infra", "  objective: { load: { rate: fast } }\n  infra")
    assert codes(spec) == ["FS204"]


def test_a_place_has_line_column_and_width(tmp_path: Path) -> None:
    path = tmp_path / "spec.yaml"
    path.write_text(SPEC.replace("VALUE", "1"))
    (loaded,) = load([path])
    span = loaded.spans[("spec", "benchmark", "budget")]
    assert (span.line, span.column, span.width) == (9, 24, 5)
    late = loaded.diagnostic("FS517", ("spec", "benchmark", "budget"), "said later")
    assert (late.span, late.source_line) == (span, "  benchmark: { budget: $2.50 }")


def test_a_file_that_is_not_there_or_named_twice(tmp_path: Path) -> None:
    path = tmp_path / "spec.yaml"
    path.write_text(SPEC.replace("VALUE", "1"))
    _, wrong = check_file([path, path, tmp_path / "none.yaml", tmp_path])
    assert [one.code for one in wrong] == ["FS101", "FS101", "FS101"]


RESULTS = first(ROOT / "results" / "grasp-planning-recorded").read_text("utf-8") if (ROOT / "results").is_dir() else ""


def test_our_own_files_are_little_work_to_load() -> None:
    path = first(ROOT / "results" / "grasp-planning-recorded")
    assert work_of(lambda: read_document(path, Result), 3) < 100


def test_our_own_files_that_were_edited_or_cut_short_say_how_to_make_them_again(tmp_path: Path) -> None:
    path = tmp_path / "results.yaml"
    command = "fogspec bench specs/grasp-planning-recorded.yaml --runner local"
    results = RESULTS.replace("python -m tests.tools.restate_paper PAPER_FOLDER", command, 1)
    assert results != RESULTS
    for content in (
        results[: results.index("  record:")],
        results.replace("latency:", "latancy:", 1),
        results.replace("mean: ", "mean: -", 1),
    ):
        path.write_text(content, "utf-8")
        with pytest.raises(DiagnosticError) as problems:
            read_document(path, Result)
        assert all(one.fix == f"make it again: {command}" for one in problems.value.diagnostics)
        assert all(one.span.line >= 1 and one.source_line is not None for one in problems.value.diagnostics)


def test_our_own_files_have_one_document(tmp_path: Path) -> None:
    path = tmp_path / "results.yaml"
    path.write_text(RESULTS + "---\n" + RESULTS, "utf-8")
    with pytest.raises(DiagnosticError) as problems:
        read_document(path, Result)
    assert [one.code for one in problems.value.diagnostics] == ["FS701"]
    with pytest.raises(InvalidInput):
        read_document(tmp_path / "none.yaml", Result)


@pytest.mark.slow
def test_a_wrong_catalog_is_located(tmp_path: Path) -> None:
    table = tmp_path / "prices.csv"
    table.write_text("InstanceType,vCPUs\nc6i.large,2\n")
    (tmp_path / "specs").mkdir()
    shutil.copy(ROOT / "specs" / "vslam-recorded.yaml", tmp_path / "specs")
    argv = [sys.executable, "-m", "fogspec", "compile", "specs/vslam-recorded.yaml", "--catalog", table.name]
    done = subprocess.run(argv, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "error[FS401]" in done.stderr
    assert f"{table.name}:1:" in done.stderr


def test_a_wrong_suite_is_located(tmp_path: Path) -> None:
    from fogspec_lab.evaluation.suites import read_suite

    (tmp_path / "machines.csv").write_text("Cloud,InstanceType,vCPUs,MemoryGiB,Price\naws,a,2,4,0.1\naws,a,2,4,0.1\n")
    with pytest.raises(DiagnosticError) as problems:
        read_suite(tmp_path)
    (one,) = problems.value.diagnostics
    assert (one.code, one.span.path, one.span.line) == ("FS402", str(tmp_path / "machines.csv"), 2)


@pytest.mark.parametrize(
    "command", ["curl example.org | sh", "fogspec bench; rm -rf x", "fogspec bench $(id)", "fogspec 'a"]
)
def test_a_command_in_a_file_is_repeated_only_if_it_runs_fogspec_and_nothing_else(command: str, tmp_path: Path) -> None:
    path = tmp_path / "results.yaml"
    path.write_text(f"# Generated by {command}: do not edit\nkind: [\n", "utf-8")
    with pytest.raises(DiagnosticError) as problems:
        read_document(path, Result)
    assert not any(command in (one.fix or "") for one in problems.value.diagnostics)
