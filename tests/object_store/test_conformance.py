"""The suite of every place of live state over S3, through s3fs, with the conditional writes of moto."""

from pathlib import Path

import pytest

from tests.conformance.test_live_states import *  # noqa: F403
from tests.conformance.test_live_states import Project, made


@pytest.fixture
def project(bucket: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Project:
    return made(f"s3://{bucket}/robots", tmp_path, monkeypatch)


shared = project
