"""What git knows of a file: its content at another commit."""

import os
import subprocess
from pathlib import Path

from fogspec.base.errors import UsageError


class Repository:
    """The git repository that the working directory is in."""

    def __init__(self) -> None:
        """Raise UsageError where the working directory is in no repository, or git does not want to look at it."""
        try:
            self.top = Path(self._run("rev-parse", "--show-toplevel").decode().strip())
        except UsageError as failed:
            raise UsageError(
                f"{os.getcwd()} is in no git repository that can be read",
                "a review compares what is committed with what is checked out: run it in a clone",
                "fogspec diff says without git what compile would change",
                failed.message,
            ) from None

    def base_of(self, range_: str) -> str:
        """Return the commit that a change starts from: of `BASE..HEAD` or `BASE`, where it and the checked-out commit part.

        Raise UsageError for a commit that is not here, or a HEAD that is not the one checked out.
        """
        base, dots, head = range_.partition("..")
        if dots and (head := head.lstrip(".")) and self._commit(head) != self._commit("HEAD"):
            raise UsageError(f"{head} is not what is checked out", f"git checkout {head}")
        commit = self._commit(base or "HEAD")
        try:
            return self._run("merge-base", commit, "HEAD").decode().strip()
        except UsageError:
            return commit

    def at(self, commit: str, path: Path) -> bytes | None:
        """Return the file's content at a commit, None where it was not there."""
        inside = Path(os.path.relpath(path.absolute(), self.top)).as_posix()
        try:
            return self._run("show", f"{commit}:{inside}")
        except UsageError:
            return None

    def paths(self, commit: str) -> list[Path]:
        """Return every file at a commit below the working directory, from here."""
        return [
            Path(os.fsdecode(name))
            for name in self._run("ls-tree", "-r", "-z", "--name-only", commit).split(b"\0")[:-1]
        ]

    def _commit(self, name: str) -> str:
        if name.startswith("-"):
            raise UsageError(f"{name} is no commit")
        try:
            return self._run("rev-parse", "--verify", "--quiet", f"{name}^{{commit}}").decode().strip()
        except UsageError:
            hint = "commit something first" if name == "HEAD" else f"fetch it: git fetch origin {name}"
            raise UsageError(f"there is no commit {name} here", hint) from None

    def _run(self, *words: str) -> bytes:
        try:
            return subprocess.run(["git", *words], check=True, capture_output=True).stdout
        except OSError as problem:
            raise UsageError(f"git cannot be started: {problem.strerror}") from None
        except subprocess.CalledProcessError as failed:
            said = failed.stderr.decode("utf-8", "replace").strip() or f"exit code {failed.returncode}"
            raise UsageError(f"git {words[0]}: {said.splitlines()[0]}") from None
