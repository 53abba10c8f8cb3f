"""The list of a machine's packages: collected from names of files, read as untrusted text, and compared."""

import base64
import zlib
from pathlib import Path

import pytest

from fogspec.agent import packages
from fogspec.results.packages import checked, differences, unpacked
from fogspec.results.schema import ServerFacts

DPKG = """Package: libc6
Status: install ok installed
Version: 2.35-0ubuntu3.8
Description: GNU C Library
 Version: 9, not this one

Package: gone
Status: deinstall ok config-files
Version: 1.0
"""
LIST = "dpkg libc6 2.35-1\npip numpy 1.26.4\n"


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    site, conda = tmp_path / "site", tmp_path / "conda/conda-meta"
    for folder in (site / "numpy-1.26.4.dist-info", site / "rclpy-3.3.1-py3.10.egg-info", site / "numpy", conda):
        folder.mkdir(parents=True)
    (conda / "ros-humble-nav2-1.1.7-py310h1_0.json").touch()
    (conda / "history").touch()
    monkeypatch.setattr("sys.path", [str(site), str(tmp_path / "missing"), ""])
    monkeypatch.setenv("CONDA_PREFIX", str(tmp_path / "conda"))
    monkeypatch.setenv("LOADEDMODULES", "gcc/12.2.0:cuda")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "status").write_text(DPKG)
    return tmp_path


def test_packages_of_every_kind_are_listed_in_order(machine: Path) -> None:
    text = packages.listed(machine / "status")
    assert text.splitlines() == [
        "conda ros-humble-nav2 1.1.7_py310h1_0",
        "dpkg libc6 2.35-0ubuntu3.8",
        "module cuda default",
        "module gcc 12.2.0",
        "pip numpy 1.26.4",
        "pip rclpy 3.3.1",
    ]
    assert checked(text.encode()) == text == unpacked(packages.packed(text))


def test_a_machine_without_any_has_an_empty_list(machine: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.path", [])
    for name in ("CONDA_PREFIX", "LOADEDMODULES"):
        monkeypatch.delenv(name)
    assert packages.listed(machine / "none") == ""
    assert checked(b"") is unpacked(packages.packed("")) is None


def test_names_that_are_not_of_packages_are_left_out(machine: Path) -> None:
    (machine / "site/evil \x1b[31m-1.dist-info").mkdir()
    (machine / "site/-1.dist-info").mkdir()
    text = packages.listed(machine / "status")
    assert "evil" not in text
    assert text.count("pip ") == 2


def test_part_of_a_list_is_no_list(machine: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(packages, "MOST_PACKAGES", 3)
    assert packages.listed(machine / "status") == ""


@pytest.mark.parametrize(
    "wrong",
    [b"dpkg libc6", b"dpkg libc6 2.35 more", b"exe a 1", b"dpkg libc6 \x1b[31m1", "dpkg lib 1é".encode(), b"\xff",
     b"dpkg ../a 1", b"dpkg a 1\n" * 200_000, b"dpkg a 1\r\n\r\n", b"dpkg " + b"a" * 200 + b" 1"],
)  # fmt: skip
def test_a_list_with_a_line_of_anything_else_is_none(wrong: bytes) -> None:
    assert checked(wrong) is None
    assert unpacked(base64.b64encode(zlib.compress(wrong)).decode()) is None


@pytest.mark.parametrize(
    "wrong", [None, 7, "", "%%%", "aGVsbG8=", base64.b64encode(zlib.compress(LIST.encode())[:-6]).decode()]
)
def test_a_damaged_report_has_no_list(wrong: object) -> None:
    assert unpacked(wrong) is None


def test_a_report_that_unpacks_to_gigabytes_is_not_unpacked() -> None:
    bomb = zlib.compressobj()
    content = b"".join(bomb.compress(bytes(2**20)) for _ in range(64)) + bomb.flush()
    assert unpacked(base64.b64encode(content).decode()) is None


def test_what_differs_is_named_with_both_versions() -> None:
    before = ServerFacts(cpu="a", kernel="6.1", driver="535.1"), LIST + "dpkg old 1\n"
    after = ServerFacts(cpu="b", kernel="6.8"), "dpkg libc6 2.39-0\ndpkg new 2\npip numpy 1.26.4\npip numpy 2.0.1\n"
    assert differences(before, after) == [
        "kernel 6.1 → 6.8",
        "libc6 2.35-1 → 2.39-0",
        "new none → 2",
        "old 1 → none",
        "pip numpy 1.26.4 → 1.26.4, 2.0.1",
    ]
    assert differences(before, before) == []
