"""A folder without specs: what was looked for is named, and what still runs; a new project has nothing to answer for."""

import json
import shutil

from tests.support.deployed import MANIFEST, Deployed, app, tiny  # noqa: F401
from tests.support.running import Shell, shell  # noqa: F401

LOOKS = (["status"], ["status", "-o", "json"], ["check"], ["watch", "--once"])


def test_a_folder_that_is_no_project(shell: Shell) -> None:
    for made in (False, True):
        for words in LOOKS:
            ended = shell(*words, code=1)
            assert "specs" in ended.err, f"{words}: {ended}"
            assert ended.out == "", words
        shell.folder.joinpath("specs").mkdir(exist_ok=made)


def test_a_new_project_is_calm(shell: Shell) -> None:
    shell("init", "arm")
    assert "running" not in shell("status").out
    assert "no live state" not in shell("check", code=None).err


def test_what_runs_is_named_where_the_last_spec_is_gone(tiny: Deployed) -> None:
    tiny.apply()
    (name,) = tiny.names()
    shutil.rmtree(tiny.folder / "specs")
    said = tiny("status").stdout
    assert "tiny (no spec)\n  running   OutOfSync, NotJudged\n" in said
    assert name in said
    assert "next: fogspec down tiny\n" in said
    (found,) = json.loads(tiny("status", "-o", "json").stdout)
    assert (found["name"], found["has_spec"]) == ("tiny", False)
    assert [one["name"] for one in found["deployment"]["machines"]] == [name]
    tiny("down", "tiny")
    assert tiny.alive() == []
    assert "no machine in the live state" in tiny("status", code=1).stderr


def test_status_names_no_manifest_that_is_not_there(tiny: Deployed) -> None:
    (tiny.folder / MANIFEST).unlink()
    tiny.change("latency: 1s", "latency: 1us")
    tiny("compile", "tiny", code=4)
    assert MANIFEST not in tiny("status").stdout
