"""Read files at other commits of a git repository."""

import os
from pathlib import Path

from fogspec.base.errors import UsageError
from fogspec.base.git import git
from fogspec.base.text import shell_command


class Repository:
    """The git repository that contains the working directory."""

    def __init__(self) -> None:
        """Find the repository. Raise UsageError if there is none, or git refuses to read it."""
        try:
            self.top = Path(git("rev-parse", "--show-toplevel").decode().strip())
        except UsageError as failed:
            raise UsageError(
                f"{os.getcwd()} is in no git repository that can be read",
                "a review compares what is committed with what is checked out: run it in a clone",
                "fogspec diff says without git what compile would change",
                failed.message,
            ) from None

    def base_of(self, range_: str) -> str:
        """Return the commit that a change starts from: the merge base of BASE in `BASE..HEAD` or `BASE` and the checkout.

        Raise UsageError for a missing commit, or a HEAD that is not checked out.
        """
        base, dots, head = range_.partition("..")
        if dots and (head := head.lstrip(".")) and self._commit(head) != self._commit("HEAD"):
            raise UsageError(f"{head} is not what is checked out", shell_command("git", "checkout", head))
        commit = self._commit(base or "HEAD")
        try:
            return git("merge-base", commit, "HEAD").decode().strip()
        except UsageError:
            return commit

    def at(self, commit: str, path: Path) -> bytes | None:
        """Return the content of a file at a commit, None if it did not exist."""
        inside = Path(os.path.relpath(path.absolute(), self.top)).as_posix()
        try:
            return git("cat-file", "blob", f"{commit}:{inside}")
        except UsageError:
            return None

    def paths(self, commit: str) -> list[Path]:
        """Return the files at a commit below the working directory, as relative paths."""
        return [Path(os.fsdecode(name)) for name in git("ls-tree", "-r", "-z", "--name-only", commit).split(b"\0")[:-1]]

    def changed(self, commit: str) -> list[Path]:
        """Return the files that differ between a commit and the checkout, those that git does not know yet included."""
        plain = ("--name-only", "-z", "--no-ext-diff", "--no-textconv", "--no-renames", "--no-relative")
        names = git("diff", *plain, commit, "--").split(b"\0")
        names += git("ls-files", "--others", "--exclude-standard", "--full-name", "-z", "--", ":/").split(b"\0")
        return [self.top / os.fsdecode(name) for name in names if name]

    def _commit(self, name: str) -> str:
        if name.startswith("-"):
            raise UsageError(f"{name} is not a commit")
        try:
            return git("rev-parse", "--verify", "--quiet", f"{name}^{{commit}}").decode().strip()
        except UsageError:
            hint = (
                "commit something first"
                if name == "HEAD"
                else f"fetch it: {shell_command('git', 'fetch', 'origin', name)}"
            )
            raise UsageError(f"there is no commit {name} here", hint) from None
