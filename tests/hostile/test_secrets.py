"""The value of a secret is in nothing that a verb prints and in no file that it leaves, wherever a machine says it."""

import gzip
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from fogspec.backends.local import backend as local
from fogspec.backends.protocol import Unreachable
from fogspec.cli import VERBS
from tests.support.deployed import MANIFEST, SPEC, Deployed, app, tiny  # noqa: F401

SECRET = "s3ntinel-of-a-robot"
FIRST, LOCAL = "local-1cpu-1gib", ("--runner", "local")
SAYS = SPEC.replace("[python3, work.py]", "[sh, -c, 'echo \"with $TOKEN\"; exec python3 work.py']")
SAYS = SAYS.replace("  probe:", "  secrets: [TOKEN]\n  probe:")
# The words of each verb; those that look at what runs have a deployment before them.
PLAYED: dict[str, list[list[str]]] = {
    "init": [["init", "another"]],
    "validate": [["validate"], ["validate", "-o", "json"]],
    "lock": [["lock", "tiny"]],
    "compile": [["compile", "tiny"]],
    "bench": [["bench", "tiny", "--only", FIRST, *LOCAL], ["bench", "tiny", "--only", FIRST, *LOCAL, "-o", "json"]],
    "status": [["status", "tiny"], ["status", "tiny", "-o", "json", "-v"]],
    "menu": [["menu", "tiny"], ["menu", "tiny", "-o", "json"]],
    "explain": [["explain", "secrets"], ["explain", "tiny"]],
    "report": [["report", "tiny"]],
    "apply": [["apply", MANIFEST, "--yes"]],
    "watch": [["watch", "tiny", "--once", "--yes", "-o", "json"], ["watch", "tiny", "--once", "--yes"]],
    "logs": [["logs", "tiny"]],
    "down": [["down", "tiny"]],
    "diff": [["diff", "tiny"], ["diff", "tiny", "-o", "json"]],
    "check": [["check", "tiny"], ["check", "tiny", "-o", "json"]],
}
DEPLOYED = ("status", "watch", "logs", "down", "diff")


def saying(method: Callable[..., Any]) -> Callable[..., Any]:
    """An engine's method that says the secret in whatever it answers."""

    def says(self: Any, *words: Any) -> Any:
        try:
            found = method(self, *words)
        except Unreachable as lost:
            raise Unreachable(f"{lost} {SECRET}") from None
        return replace(found, detail=f"{found.detail or 'the engine'} says {SECRET}")

    return says


@pytest.mark.parametrize("verb", VERBS)
def test_a_secret_is_in_nothing_that_a_verb_says_or_leaves(
    verb: str, app: Callable[..., Deployed], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TOKEN", SECRET)
    one = app(SAYS)
    if verb in DEPLOYED:
        one.apply()
    for engine in (local.LocalSamples, local.LocalDeployments):
        monkeypatch.setattr(engine, "poll", saying(engine.poll))
    if verb == "down":
        monkeypatch.setattr(local.LocalDeployments, "list", lambda *_: (_ for _ in ()).throw(Unreachable(SECRET)))
    played = [one(*words, code=None) for words in PLAYED[verb]]
    assert not [ended for ended in played if ended.returncode in (2, 70)], "each was played"
    said = "".join(ended.stdout + ended.stderr for ended in played)
    monkeypatch.undo()
    one("down", "tiny", code=None)
    assert SECRET not in said
    left = [path for path in one.folder.rglob("*") if path.is_file() and not path.is_symlink()]
    contents = {
        path: gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes() for path in left
    }
    assert [path for path, content in contents.items() if SECRET.encode() in content] == []
    if verb in ("bench", "status", "down"):
        assert "$TOKEN" in said, "the engine said it"
