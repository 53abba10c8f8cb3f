"""Files that a user names: whole regular files within a limit, or an error that says why."""

import errno
import gzip
import os
import socket
from pathlib import Path

import pytest

from fogspec.base import files


def made(path: Path, kind: str) -> Path:
    if kind == "folder":
        path.mkdir()
    elif kind == "pipe":
        os.mkfifo(path)
    else:
        with socket.socket(socket.AF_UNIX) as one:
            one.bind(os.path.relpath(path))
    return path


@pytest.mark.parametrize("kind", ["folder", "pipe", "socket"])
def test_what_is_no_file_is_said_and_not_waited_for(tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    path = made(tmp_path / "one", kind)
    with pytest.raises(OSError, match=f"it is a {kind}, not a file") as wrong:
        files.read_file(path, 9)
    assert (wrong.value.errno, wrong.value.filename) == (errno.EINVAL, str(path))


@pytest.mark.parametrize("path", ["/dev/zero", "/dev/null"])
def test_a_device_is_no_file(path: str) -> None:
    with pytest.raises(OSError, match="it is a device, not a file"):
        files.read_file(path, 9)


def test_a_block_device_is_no_file_either() -> None:
    assert files.not_a_file(0o060660) == "it is a device, not a file"
    assert files.not_a_file(0o100644) is None


def test_reading(tmp_path: Path) -> None:
    path = tmp_path / "one"
    path.write_bytes(b"12345")
    assert (files.read_file(path, 9), files.read_file(str(path), 2)) == (b"12345", b"12")
    assert files.read_bounded(path, 5) == b"12345"
    with pytest.raises(OSError, match="more than 0 KiB") as wrong:
        files.read_bounded(path, 4)
    assert (wrong.value.errno, wrong.value.filename) == (errno.EFBIG, str(path))
    with pytest.raises(FileNotFoundError):
        files.read_file(tmp_path / "absent", 9)


def test_unpacking_stops_at_its_limit() -> None:
    packed = gzip.compress(b"a" * 5000)
    assert files.decompress(packed, "a.gz", 5000) == b"a" * 5000
    assert files.decompress(packed, "a.csv", 1) == packed
    with pytest.raises(OSError, match="more than 4 KiB unpacked") as wrong:
        files.decompress(packed, "a.gz", 4999)
    assert wrong.value.filename == "a.gz"
    for damaged in (packed[:-3], packed[:20] + b"x" + packed[21:], b"no gzip"):
        with pytest.raises(OSError, match="not a complete gzip file"):
            files.decompress(damaged, "a.gz", 5000)


def test_what_a_sample_left_is_a_plain_file_or_nothing(tmp_path: Path) -> None:
    (tmp_path / "one").write_bytes(b"12")
    with files.open_untrusted(tmp_path / "one") as file:
        assert file.read() == b"12"
    (tmp_path / "link").symlink_to("one")
    with pytest.raises(OSError, match="symbolic links") as wrong:
        files.open_untrusted(tmp_path / "link")
    assert wrong.value.errno == errno.ELOOP
    os.mkfifo(tmp_path / "pipe")
    before = len(os.listdir("/proc/self/fd"))
    for name in ("pipe", "."):
        with pytest.raises(OSError, match="not a plain file"):
            files.open_untrusted(tmp_path / name)
    assert len(os.listdir("/proc/self/fd")) == before, "nothing stays open"
