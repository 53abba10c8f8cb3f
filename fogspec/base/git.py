"""Run git on a checkout that others wrote: it reads, and runs nothing that the checkout or its configuration names.

What reaches a remote (`exchange`) runs in a repository of fogspec's own, with the user's own settings and log-in.
"""

import os
import subprocess
import tempfile
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import IO

from fogspec.base import child
from fogspec.base.errors import Refused, UsageError
from fogspec.base.layout import Layout

# What git would run while it reads. A folder that only looks like a bare repository has a configuration that anybody could
# commit; without it, a prepared checkout with its .git could name a program.
OVERRIDES = {
    "safe.bareRepository": "explicit",
    "core.fsmonitor": "false",
    "core.hooksPath": os.devnull,
    "core.pager": "cat",
    "core.sshCommand": "false",
    "core.askPass": "false",
    "credential.helper": "",
    "diff.external": "",
    "gpg.program": "false",
    "log.showSignature": "false",
}
# A partial clone fetches what is missing from where its configuration says, by a protocol that may be a command.
QUIET = {"GIT_NO_LAZY_FETCH": "1", "GIT_ALLOW_PROTOCOL": "none", "GIT_OPTIONAL_LOCKS": "0", "GIT_TERMINAL_PROMPT": "0"}

# A repository of fogspec's own has no hooks; what the user configured for every repository must not sign or follow either.
OWN = {
    "core.hooksPath": os.devnull,
    "core.fsmonitor": "false",
    "core.pager": "cat",
    "push.gpgSign": "false",
    "push.followTags": "false",
    "push.recurseSubmodules": "no",
    "fetch.recurseSubmodules": "no",
    "commit.gpgSign": "false",
    "gc.auto": "0",
    "maintenance.auto": "false",
}
REACHED = {
    "GIT_ALLOW_PROTOCOL": "https:http:ssh:git:file",
    "GIT_TERMINAL_PROMPT": "0",
    "GIT_NO_LAZY_FETCH": "1",
    "GIT_AUTHOR_NAME": "fogspec",
    "GIT_AUTHOR_EMAIL": "fogspec@localhost",
    "GIT_COMMITTER_NAME": "fogspec",
    "GIT_COMMITTER_EMAIL": "fogspec@localhost",
}
LOG_IN = ("GIT_CONFIG", "GIT_SSH", "GIT_ASKPASS", "GIT_PROXY", "GIT_SSL", "GIT_HTTP")

GIT_S = 60.0
LONGEST_OUTPUT = 64 << 20  # bytes; what a checkout holds is not ours to bound
LONGEST_REPORT = 1 << 16


def git(*words: str, folder: str | os.PathLike[str] = ".", index: str | None = None) -> bytes:
    """Return the output of a git command that reads; raise UsageError with git's own first line if it fails.

    It reads what is staged from the file `index`, by default the repository's own.
    """
    kept = {k: v for k, v in child.environment().items() if not k.startswith("GIT_") or k.startswith("GIT_CONFIG")}
    kept = kept | QUIET | ({} if index is None else {"GIT_INDEX_FILE": index})
    if "diff" in words:  # it passes files through the filters of their attributes: programs, too
        kept = _configured(kept, _no_filters(folder, kept))
    ended = _run(words, folder, OVERRIDES, kept)
    if ended.code:
        raise UsageError(f"git {words[0]}: {ended.report.splitlines()[0]}")
    return ended.output


@dataclass(frozen=True, slots=True)
class Ended:
    """How a git command ended; `report` is what it said of it, never empty."""

    code: int
    output: bytes
    report: str


def exchange(*words: str, folder: Path, stdin: bytes = b"", headers: Mapping[str, str] | None = None) -> Ended:
    """Run a git command in a bare repository of fogspec's own, which may read from a remote and write to it.

    It logs in as the user's git does; `headers` are settings `http.URL.extraheader`, which are not shown in a list of
    processes. Raise UsageError if git cannot be started or does not end.
    """
    kept = {k: v for k, v in child.environment().items() if not k.startswith("GIT_") or k.startswith(LOG_IN)}
    # A Ctrl-C in the terminal must not cut an exchange off in the middle: who runs this decides what is ended.
    return _run(
        words, folder, OWN, _configured(kept | REACHED | {"GIT_DIR": os.path.abspath(folder)}, headers or {}), stdin
    )


def _no_filters(folder: str | os.PathLike[str], environment: dict[str, str]) -> dict[str, str]:
    """Return settings that turn off filters of the checkout's own configuration, but not those that are the user's, too."""
    listed = _run(("config", "--show-scope", "-z", "--get-regexp", r"^filter\."), folder, OVERRIDES, environment).output
    words = listed.decode("utf-8", "surrogateescape").split("\0")
    entries = list(zip(words[::2], words[1::2], strict=False))
    ours = {entry for scope, entry in entries if scope not in ("local", "worktree")}
    found: dict[str, str] = {}
    for scope, entry in entries:
        name = entry.partition("\n")[0]
        if scope in ("local", "worktree") and entry not in ours:
            # A filter that is required and empty would be an error.
            found |= {name: "", f"{name.rpartition('.')[0]}.required": "false"}
    return found


def _configured(environment: dict[str, str], settings: Mapping[str, str]) -> dict[str, str]:
    """Return the environment with these settings of git, after those that it has."""
    try:
        count = int(environment.get("GIT_CONFIG_COUNT") or 0)
    except ValueError:
        count = 0
    for number, (name, value) in enumerate(settings.items(), count):
        environment |= {f"GIT_CONFIG_KEY_{number}": name, f"GIT_CONFIG_VALUE_{number}": value}
    return environment | ({"GIT_CONFIG_COUNT": str(count + len(settings))} if settings else {})


def _run(
    words: Sequence[str],
    folder: str | os.PathLike[str],
    overrides: Mapping[str, str],
    environment: Mapping[str, str],
    stdin: bytes | None = None,
) -> Ended:
    """Run a git command; raise UsageError if it cannot be started, does not end, or prints too much."""
    settings = [word for name, value in overrides.items() for word in ("-c", f"{name}={value}")]
    try:
        command = [child.program("git"), "--no-pager", *settings, "-C", os.path.abspath(folder), *words]
        with tempfile.TemporaryFile() as errors, tempfile.TemporaryFile() as given:
            given.write(stdin or b"")
            given.seek(0)
            code, content = _output(command, environment, errors, None if stdin is None else given)
            errors.seek(0)
            report = errors.read(LONGEST_REPORT).decode("utf-8", "replace").strip() or f"exit code {code}"
    except OSError as problem:
        raise UsageError(f"git cannot be started: {problem.strerror}") from None
    if content is None:
        raise UsageError(f"git {words[0]}: it has not ended within {GIT_S:g} s")
    if len(content) > LONGEST_OUTPUT:
        raise UsageError(f"git {words[0]}: it prints more than {LONGEST_OUTPUT >> 20} MiB")
    return Ended(code, content, report)


def _output(
    command: Sequence[str], environment: Mapping[str, str], errors: IO[bytes], given: IO[bytes] | None
) -> tuple[int, bytes | None]:
    """Return the exit code and the output, one byte more than allowed at most; None if it did not end in time.

    With something `given` to read, the command has a session of its own.
    """
    late = threading.Event()
    with subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL if given is None else given,
        stdout=subprocess.PIPE,
        stderr=errors,
        cwd=child.ELSEWHERE,
        env=environment,
        start_new_session=given is not None,
    ) as process:

        def end() -> None:
            late.set()
            process.kill()

        timer = threading.Timer(GIT_S, end)
        timer.start()
        try:
            content = process.stdout.read(LONGEST_OUTPUT + 1) if process.stdout is not None else b""
            if len(content) > LONGEST_OUTPUT:
                process.kill()
            code = process.wait()
        finally:
            timer.cancel()
            process.kill()
    return code, None if late.is_set() else content


def tracked_state(layout: Layout) -> str | None:
    """Return a file of `.fogspec/NAME` that git tracks, None if there is none, or no git repository."""
    if not layout.files.exists(layout.state):
        return None
    return _tracked(os.path.abspath(layout.root), layout.relative(layout.state))


@cache
def _tracked(root: str, state: str) -> str | None:
    try:
        # Not the folder alone: a submodule at `.fogspec` or at the state itself is one entry of that name.
        found = git("ls-files", "-z", "--", ".fogspec", folder=root).decode("utf-8", "replace").split("\0")
    except UsageError:
        return None
    inside = (name for name in found if name in (os.path.dirname(state), state) or name.startswith(f"{state}/"))
    return next(inside, None)


def check_untracked(layout: Layout, *hints: str) -> None:
    """Raise Refused for live state that git tracks: what others commit must not name machines to end or to pay."""
    if (name := tracked_state(layout)) is not None:
        folder = Path(layout.relative(layout.state)).parts[0]
        raise Refused(
            f"{layout.root / name}: git tracks it: what runs is a record of this computer, and a checkout may bring others",
            *hints,
            f"look at what it names, then: git rm -r -f --cached {folder}, and add {folder}/ to .gitignore",
        )
