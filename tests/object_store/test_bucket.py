"""What a bucket does that a folder does not: it is away, has no rights, overwrites, and is used through the command line."""

import json
import shutil
import subprocess
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

import boto3
import pytest

from fogspec.base.errors import Refused
from fogspec.deploy.object_store import FsspecObjects, ObjectStore
from fogspec.deploy.stores import StoreUnavailable
from tests.support.deployed import Deployed, app  # noqa: F401


@pytest.fixture
def team(app: Callable[..., Deployed], bucket: str) -> tuple[Deployed, Deployed, str]:
    """Two clones without a common folder or repository but the bucket."""
    first = app()
    (first.folder / "fogspec.yaml").write_text(
        f"apiVersion: fogspec.dev/v1alpha1\nkind: Project\nspec: {{state: s3://{bucket}/robots}}\n"
    )
    for words in (["init", "-q"], ["remote", "add", "origin", "https://git.example.org/robots.git"]):
        git(first.folder, *words)
    shutil.copytree(first.folder, first.folder.parent / "other", symlinks=True)
    return first, Deployed(first.folder.parent / "other"), bucket


def git(folder: Path, *words: str) -> None:
    subprocess.run(["git", *words], cwd=folder, check=True)


def names(bucket: str) -> list[str]:
    listed = boto3.client("s3").list_objects_v2(Bucket=bucket)
    return [one["Key"] for one in listed.get("Contents", [])]


def test_another_clone_sees_updates_and_ends_what_one_started(team: tuple[Deployed, Deployed, str]) -> None:
    first, other, bucket = team
    first.apply()
    assert not (first.state / "deployment.yaml").exists()
    assert len([one for one in names(bucket) if one.startswith("robots/tiny-")]) <= 2
    assert (other.status()["sync"], other.status()["health"]) == ("Synced", "Healthy")
    assert "no changes" in other.apply().stdout
    other.change("latency: 1s", "latency: 2s")
    other("compile", "specs/tiny.yaml")
    assert "the machine stays, under the new manifest" in other.apply().stdout
    assert first.alive()
    assert len(json.loads(first("ps", "-o", "json").stdout)) == 1
    assert "1 ended" in other("down", "tiny").stdout
    assert not first.alive()
    assert first.status() is None
    assert "answered after" in first.apply().stdout
    assert "1 ended" in first("down", "tiny").stdout


def test_two_at_once_start_one_machine(team: tuple[Deployed, Deployed, str]) -> None:
    first, other, _ = team
    begun = [one.begin("apply", "compiled/tiny/manifest.yaml", "--yes") for one in (first, other)]
    ended = [(one.communicate()[1], one.returncode) for one in begun]
    assert sorted(code for _, code in ended) in ([0, 0], [0, 8]), ended
    assert [bool(first.alive()), bool(other.alive())].count(True) == 1
    first("down", "tiny")
    assert not first.alive()
    assert not other.alive()


def test_a_bucket_that_is_away_or_missing_starts_and_ends_nothing(
    team: tuple[Deployed, Deployed, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    first, _, bucket = team
    (first.folder / "fogspec.yaml").write_text(
        "apiVersion: fogspec.dev/v1alpha1\nkind: Project\nspec: {state: s3://missing}\n"
    )
    said = first.apply(code=6).stderr
    assert "s3://missing: no contact: The specified bucket does not exist" in said
    assert "FOGSPEC_STATE=folder" in said
    assert not first.alive()
    here = {"FOGSPEC_STATE": f"s3://{bucket}"}
    first.apply(env=here)
    away = {**here, "AWS_ENDPOINT_URL_S3": "http://127.0.0.1:9"}
    for words in (["status"], ["ps"], ["down", "tiny"], ["apply", "tiny", "--yes"]):
        assert "no contact: Could not connect" in first(*words, code=6, env=away).stderr
    assert first.alive()
    assert "1 ended" in first("down", "tiny", env=here).stdout


def test_without_the_package_it_says_what_to_install(team: tuple[Deployed, Deployed, str], bucket: str) -> None:
    first = team[0]
    said = first.apply(code=2, env={"FOGSPEC_STATE": "gs://robots/live"}).stderr
    assert "the package gcsfs is not installed" in said
    assert "pip install 'fogspec[gs]'" in said


def test_a_store_that_overwrites_is_refused(bucket: str, monkeypatch: pytest.MonkeyPatch) -> None:
    create = FsspecObjects.create

    def overwrites(self: FsspecObjects, name: str, content: bytes) -> None:
        self._call(self._system()._pipe_file, f"{self._root}/{name}", content)

    store = ObjectStore(f"s3://{bucket}/a", FsspecObjects(f"s3://{bucket}/a"))
    with monkeypatch.context() as old:
        old.setattr(FsspecObjects, "create", overwrites)
        with pytest.raises(Refused, match="overwrites an object"):
            store.write("tiny-x", b"a: 1\n", None, "first")
    assert names(bucket) == ["a/README.txt"]
    assert FsspecObjects.create is create
    assert store.write("tiny-x", b"a: 1\n", None, "first") == "1"


class Cut:
    """Objects whose connection is cut: `lost` after the store did it, `held` before."""

    def __init__(self, objects: FsspecObjects) -> None:
        self._objects = objects
        self.lost = self.held = self.denied = False

    def sizes(self, folder: str) -> Mapping[str, int]:
        return self._objects.sizes(folder)

    def read(self, names: Collection[str]) -> Mapping[str, bytes]:
        return self._objects.read(names)

    def create(self, name: str, content: bytes) -> None:
        if self.held and "/" in name:
            raise TimeoutError("timed out")
        self._objects.create(name, content)
        if self.lost and "/" in name:
            raise TimeoutError("timed out")

    def remove(self, name: str) -> None:
        if self.denied:
            raise PermissionError("Access Denied")
        self._objects.remove(name)


def cut(bucket: str) -> tuple[ObjectStore, Any]:
    objects = Cut(FsspecObjects(f"s3://{bucket}/a"))
    return ObjectStore(f"s3://{bucket}/a", objects), objects


def test_an_answer_that_is_lost_is_a_write_that_was_done(bucket: str) -> None:
    store, objects = cut(bucket)
    objects.lost = True
    assert store.write("tiny-x", b"a: 1\n", None, "first") == "1"
    assert store.write("tiny-x", b"a: 2\n", "1", "second") == "2"
    assert store.read("tiny-x").content == b"a: 2\n"


def test_a_request_that_is_sent_twice_is_one_write(bucket: str) -> None:
    store, objects = cut(bucket)
    assert store.write("tiny-x", b"a: 1\n", None, "first") == "1"
    objects._objects.create("tiny-x/000000000002.yaml", b"a: 2\n")  # what the package sent again after it had arrived
    assert store.write("tiny-x", b"a: 2\n", "1", "second") == "2"


def test_a_request_that_is_not_done_changes_nothing(bucket: str) -> None:
    store, objects = cut(bucket)
    store.write("tiny-x", b"a: 1\n", None, "first")
    objects.held = True
    with pytest.raises(StoreUnavailable, match="timed out"):
        store.write("tiny-x", b"a: 2\n", "1", "second")
    assert store.read("tiny-x").content == b"a: 1\n"
    with pytest.raises(StoreUnavailable, match="timed out"):
        store.write("tiny-y", b"a: 2\n", None, "second")


def test_without_the_right_to_remove_objects_the_record_is_still_right(bucket: str) -> None:
    store, objects = cut(bucket)
    objects.denied = True
    version: str | None = None
    for number in range(1, 6):
        version = store.write("tiny-x", b"a: %d\n" % number, version, "again")
    assert store.read("tiny-x").content == b"a: 5\n"
    assert len(names(bucket)) == 6
    objects.denied = False
    store.write("tiny-x", b"a: 6\n", version, "again")
    assert len(names(bucket)) == 3


def test_what_others_keep_there_is_neither_read_nor_removed(bucket: str) -> None:
    store, _ = cut(bucket)
    client = boto3.client("s3")
    for key in ("a/x", "a/tiny-x/notes.txt", "a/tiny-x/000000000001.yaml.bak", "a/tiny-xy/000000000009.yaml", "other"):
        client.put_object(Bucket=bucket, Key=key, Body=b"theirs")
    version = store.write("tiny-x", b"a: 1\n", None, "first")
    for _ in range(4):
        version = store.write("tiny-x", b"a: 1\n", version, "again")
    assert store.read("tiny-x").version == "5"
    assert set(store.read_all()) == {"tiny-x", "tiny-xy"}
    assert len(names(bucket)) == 5 + 1 + 2


def test_many_records_are_read_in_a_few_exchanges(bucket: str) -> None:
    store, _ = cut(bucket)
    client = boto3.client("s3")
    for number in range(40):
        client.put_object(Bucket=bucket, Key=f"a/app{number}-x/000000000001.yaml", Body=b"a: %d\n" % number)
    found = store.read_all()
    assert len(found) == 40
    assert found["app7-x"].content == b"a: 7\n"
