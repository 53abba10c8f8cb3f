"""Small files that unpack, nest, double or backtrack without end: refused by name, within little time and memory."""

from pathlib import Path

import pytest

from tests.support.hostile_files import BOMBS, Bomb, run_bounded


@pytest.mark.slow
@pytest.mark.parametrize("bomb", BOMBS, ids=[f"{one.reader}: {one.name}" for one in BOMBS])
def test_a_reader_ends_with_a_sentence(bomb: Bomb, tmp_path: Path) -> None:
    """Within 2 GiB and ten minutes of processor time, which are far above what any of them takes."""
    ended = run_bounded(tmp_path, *bomb.write(tmp_path))
    assert bomb.ended_as_said(ended), ended
    assert "has a bug" not in ended.stderr
