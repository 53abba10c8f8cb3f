"""Tests with real ROS 2: skipped with a reason where it is not installed; with CI=true that fails."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.ros.namespaces import Net, lacking, network

HERE = Path(__file__).parent


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip all of this folder's tests where they cannot run."""
    mine = [item for item in items if str(item.path).startswith(f"{HERE}{os.sep}")]  # of thousands
    reason = lacking() if mine else None
    for item in mine:
        if reason:
            item.add_marker(pytest.mark.skip(reason=reason))


@pytest.fixture
def net(tmp_path: Path) -> Iterator[Net]:
    """A network of its own, with a ROS domain of its own."""
    with network(tmp_path) as one:
        yield one
