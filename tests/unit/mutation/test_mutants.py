"""Mutants are single changes that compile, found by what they say, drawn by lot; and their process tells life from death."""

import ast
from pathlib import Path

import pytest

from tests.mutation.mutants import Mutant, mutants
from tests.mutation.run import outcome, sample, survives

SOURCE = '''"""A module."""

LIMIT = 3


def spend(usd: float, *, most: float = 2.0) -> bool:
    """Spend."""
    if usd > most and usd != LIMIT:
        raise ValueError(f"{usd} is more than {most}")
    log("α", sync=True)
    while True:
        return not usd | 4
'''


@pytest.fixture
def module(tmp_path: Path) -> Path:
    (tmp_path / "one.py").write_text(SOURCE)
    return tmp_path


def test_each_is_one_change_that_compiles(module: Path) -> None:
    found = mutants(module, "one.py")
    assert {(one.where, one.was, one.now) for one in found} == {
        ("module", "3", "4"),
        ("spend", "2.0", "3.0"),
        ("spend", "usd > most and usd != LIMIT", "True"),
        ("spend", "usd > most and usd != LIMIT", "False"),
        ("spend", "usd > most and usd != LIMIT", "usd > most"),
        ("spend", "usd > most and usd != LIMIT", "usd != LIMIT"),
        ("spend", "usd > most", "usd >= most"),
        ("spend", "usd != LIMIT", "usd == LIMIT"),
        ("spend", 'raise ValueError(f"{usd} is more than {most}")', "pass"),
        ("spend", 'log("α", sync=True)', "pass"),
        ("spend", 'log("α", sync=True)', "log('α')"),
        ("spend", '"α"', "'αx'"),
        ("spend", "True", "False"),
        ("spend", "not usd | 4", "None"),
        ("spend", "not usd | 4", "usd | 4"),
        ("spend", "usd | 4", "usd"),
        ("spend", "usd | 4", "4"),
        ("spend", "4", "5"),
    }
    for one in found:
        changed = one.source(SOURCE.encode())
        assert ast.dump(ast.parse(changed)) != ast.dump(ast.parse(SOURCE)), one


def test_a_change_elsewhere_leaves_the_names_of_mutants_and_the_lots(module: Path) -> None:
    before = mutants(module, "one.py")
    (module / "one.py").write_text(SOURCE.replace("LIMIT = 3", "# a comment\nLIMIT = 3\nOTHER = LIMIT"))
    after = mutants(module, "one.py")
    assert [one.key for one in after] == [one.key for one in before]
    assert [one.start for one in after] != [one.start for one in before]
    drawn = [one.key for one in sample({"one.py": before}, 7, seed=1)]
    assert drawn == [one.key for one in sample({"one.py": after}, 7, seed=1)]
    assert len(drawn) == 7
    assert drawn != [one.key for one in sample({"one.py": after}, 7, seed=2)]
    assert len(sample({"one.py": before}, 10**9, seed=1)) == len(before)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("test", "alive"), [("assert LIMIT == 3", False), ("assert LIMIT", True), ("while 1: 0", False)]
)
def test_a_mutant_lives_if_its_tests_pass_in_time(module: Path, test: str, alive: bool) -> None:
    (module / "test_one.py").write_text(f"from one import LIMIT\ndef test_it():\n    {test}\n")
    (mutant,) = (one for one in mutants(module, "one.py") if one.was == "3")
    # What never ends is over its time whatever it is.
    assert survives(mutant, module, ["test_one.py"], 3.0 if "while" in test else 20.0) is alive
    assert (module / "one.py").read_text() == SOURCE
    if "while" not in test:
        assert outcome(module, ["test_one.py"], 60.0) == 0
        assert outcome(module, ["absent.py"], 60.0) != 0


def test_a_mutant_is_known_by_what_it_says() -> None:
    one = Mutant("m.py", "f", "a", "b", 2, "(b)", 3, 4)
    assert one.key == ("m.py", "f", "a", "b", 2)
    assert one.source(b"xyza;") == b"xyz(b);"
