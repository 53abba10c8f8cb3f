"""Warnings are codes with values; people get sentences."""

import inspect
import json
import math
import types
from typing import Any, Literal, get_args

import pytest

from fogspec.base.diagnostics import DiagnosticError
from fogspec.choice.menu import Menu
from fogspec.language.loader import UPGRADE, SourceFile
from fogspec.language.schema import Waiver
from fogspec.language.warned import CODES, NEWER, as_data, no_confidence, sentence, warned
from tests.support.site import ROOT

MENU = ROOT / "compiled" / "vslam-recorded" / "menu.yaml"
EXAMPLES: dict[Any, Any] = {
    Literal["image", "spot", "login"]: "image", int: 3, float: 0.5,
    str: "a-name", list[str]: ["a", "b"], tuple[float, float]: [1.0, 2.0],
    list[Waiver]: [{"change": "spec.cloud[0].env.LOG", "old": "info", "new": "debug", "reason": "a level"}],
}  # fmt: skip


def example(code: str, optional: bool) -> dict[str, Any]:
    """A warning of this code, with or without the values that it may lack."""
    found: dict[str, Any] = {"code": code}
    for one in inspect.signature(CODES[code]).parameters.values():
        kind = next(iter(get_args(one.annotation)), None) if isinstance(one.annotation, types.UnionType) else None
        if one.default is inspect.Parameter.empty or optional:
            found[one.name] = True if one.annotation is bool else EXAMPLES[kind or one.annotation]
    return found


@pytest.mark.parametrize("optional", [True, False])
@pytest.mark.parametrize("code", CODES)
def test_each_code_has_a_sentence_of_one_line_with_its_values(code: str, optional: bool) -> None:
    one = example(code, optional)
    text = sentence(one)
    assert NEWER not in text
    assert "\n" not in text
    for value in one.values():
        assert not isinstance(value, str) or value == code or value in text
    assert as_data([one]) == [{**one, "text": text}]


def test_values_are_written_rounded_and_without_those_that_are_missing() -> None:
    found = warned(no_confidence, machine="a.large", probability=1 / 3)
    assert found == {"code": "no_confidence", "machine": "a.large", "probability": 0.3333}
    assert warned(CODES["relaxed_end"], machine=None, better=None) == {"code": "relaxed_end"}


@pytest.mark.parametrize(
    "wrong",
    [{}, {"code": "not_yet"}, {"code": ["a"]}, {"code": "host_only", "new": 1}, {"code": "unpredicted"},
     {"code": "unpredicted", "machines": "many"}, {"code": "contended", "sample": "a", "cpu_time": math.nan},
     {"code": "contended", "sample": "a", "cpu_time": 10**400}, {"code": "unpredicted", "machines": 10**5000},
     {"code": "swapped", "sample": "a", "swapped_gib": 1e308}, {"code": "\x1b[2J\n"},
     {"code": "waived", "samples": 1, "of": 2, "waivers": [1]}, {1: 2}],
)  # fmt: skip
def test_what_another_version_or_a_stranger_wrote_is_a_line_of_text(wrong: dict[str, Any]) -> None:
    text = sentence(wrong)
    assert "\n" not in text
    assert "\x1b" not in text


def menu_with(warning: dict[str, Any]) -> SourceFile:
    lines = MENU.read_text("utf-8").splitlines()
    kept = lines[: lines.index("  warnings:")]
    return SourceFile(MENU, "\n".join([*kept, "  warnings:", f"    - {json.dumps(warning)}", ""]).encode())


@pytest.mark.parametrize("warning", [{"code": "not_yet", "samples": 3}, {"code": "host_only", "since": 3}])
def test_an_unknown_code_or_value_in_a_file_is_of_a_newer_fogspec(warning: dict[str, Any]) -> None:
    with pytest.raises(DiagnosticError) as caught:
        menu_with(warning).document(Menu)
    [found] = caught.value.diagnostics
    assert (found.message, found.fix) == ("spec.warnings[0] is written by a newer fogspec", UPGRADE)


def test_a_wrong_value_is_located() -> None:
    with pytest.raises(DiagnosticError) as caught:
        menu_with({"code": "unpredicted", "machines": "many"}).document(Menu)
    [found] = caught.value.diagnostics
    assert found.message.startswith("spec.warnings[0] of code unpredicted: machines: ")
    assert found.code == "FS303"


@pytest.mark.parametrize(("code", "page"), [("gpu_idle", "FS901"), ("swapped", "FS902"), ("cpu_quota", "FS903")])
def test_what_a_page_explains_names_it(code: str, page: str) -> None:
    assert sentence(example(code, optional=True)).endswith(f"[{page}]")
