"""Records in a git repository that a team shares: one ref for each, replaced only by a writer that saw what it replaces.

The refs are below `refs/fogspec/state/`: no branch, so nothing checks them out and no workflow starts. A record is one file in
one commit on top of the record before it. Every exchange runs in a temporary repository of fogspec's own, not in the clone.
"""

import contextlib
import os
import re
import shlex
import tempfile
from collections.abc import Mapping
from pathlib import Path

from fogspec.base import child
from fogspec.base.errors import UsageError
from fogspec.base.git import Ended, exchange, git
from fogspec.base.repository import normalized
from fogspec.base.text import shell_command
from fogspec.deploy.stores import Overtaken, Stored, StoreRefused, StoreUnavailable

REFS = "refs/fogspec/state/"
FILE = "state.yaml"
HEADER = r"^http\..+\.extraheader$"
# What serves a repository on this host reads that repository's configuration, and would run its hooks.
SERVE = ("-c", f"core.hooksPath={os.devnull}", "-c", "core.alternateRefsCommand=", "-c", "gc.auto=0")
# So it may hold only these settings: those that git writes into a bare repository, and others that name no program.
PLAIN = re.compile(
    r"core\.(repositoryformatversion|filemode|sharedrepository|logallrefupdates|ignorecase|precomposeunicode|symlinks|fsync"
    r"|(loose)?compression|bigfilethreshold)|receive\.(deny(nonfastforwards|deletes|deletecurrent)|unpacklimit|maxinputsize"
    r"|fsckobjects|autogc)|transfer\.(fsckobjects|unpacklimit|hiderefs)|uploadpack\.allow\w+|http\.(receive|upload)pack"
    r"|gc\.(auto(detach|packlimit)?|\w+expire|reflogexpireunreachable)|remote\..+\.(url|fetch|push|mirror|prune|tagopt)"
    r"|extensions\.(objectformat|refstorage)|(user|pack|gitweb)\.\w+"
)
FIXED = {"core.bare": "true", "receive.denycurrentbranch": "refuse"}


class GitStore:
    """Records below `refs/fogspec/state/` of the repository at a URL; `clone` is where its log-in is configured."""

    def __init__(self, url: str, top: Path, clone: Path) -> None:
        self.where = f"state in {normalized(url, top) or url}"
        self._local = url.startswith("file://") or normalized(url, top) == normalized(os.path.abspath(top / url), top)
        self._url = os.path.abspath(top / url.removeprefix("file://")) if self._local else url
        self._clone = clone
        self._folder: tempfile.TemporaryDirectory[str] | None = None

    def read(self, key: str) -> Stored:
        """Return the record with this key; raise StoreUnavailable."""
        return self._fetched(f"{REFS}{key}*").get(key, Stored())

    def read_all(self) -> dict[str, Stored]:
        """Return all records by their keys; raise StoreUnavailable."""
        return self._fetched(f"{REFS}*")

    def write(self, key: str, content: bytes | None, replaced: str | None, why: str) -> str | None:
        """Replace the version `replaced` of a record, or remove it; return the new version.

        Raise Overtaken if the record is another version, StoreUnavailable if the store refuses or what became of it is unknown.
        """
        new = None if content is None else self._commit(content, replaced, why)
        ref = f"{REFS}{key}"
        lease = f"--force-with-lease={ref}:{replaced or ''}"
        words = ["push", "--porcelain", "--quiet", "--no-verify", lease, *self._served("receive-pack")]
        ended = self._exchange(*words, "--", self._url, f"{new or ''}:{ref}")
        if ended.code == 0:
            return new
        now = self.read(key).version
        if now == new:
            return new  # it was written, and only the answer was lost
        if now != replaced:
            raise Overtaken
        raise StoreUnavailable(self.where, self._reason(ended))

    def path(self, key: str) -> str:
        """Return where a record is, for people."""
        return f"{REFS}{key} of {self.where.removeprefix('state in ')}"

    def _commit(self, content: bytes, parent: str | None, why: str) -> str:
        blob = self._made("hash-object", "-w", "--stdin", stdin=content)
        tree = self._made("mktree", stdin=f"100644 blob {blob}\t{FILE}\n".encode())
        parents = [] if parent is None else ["-p", parent]
        return self._made("commit-tree", tree, *parents, "-F", "-", stdin=f"{why}\n".encode())

    def _made(self, *words: str, stdin: bytes) -> str:
        ended = self._exchange(*words, stdin=stdin)
        if ended.code:
            raise StoreUnavailable(self.where, self._reason(ended))
        return ended.output.decode("utf-8", "replace").strip()

    def _fetched(self, pattern: str) -> dict[str, Stored]:
        words = ["fetch", "--quiet", "--depth=1", "--no-tags", "--prune", "--no-write-fetch-head", "--no-auto-gc"]
        words += [*self._served("upload-pack"), "--", self._url, f"+{pattern}:{pattern}"]
        ended = self._exchange(*words)
        if ended.code:  # to fetch the top of nothing is an error without a word
            there = self._lists_any(pattern)
            if there is False:
                return {}
            if there:  # somebody may have created the first since
                ended = self._exchange(*words)
        if ended.code:
            raise StoreUnavailable(self.where, self._reason(ended))
        listed = self._made("for-each-ref", "--format=%(refname) %(objectname)", REFS, stdin=b"").splitlines()
        versions = dict(line.removeprefix(REFS).split(" ", 1) for line in listed)
        asked = "".join(f"{version}:{FILE}\n" for version in versions.values()).encode()
        read = self._exchange("cat-file", "--batch", "--buffer", stdin=asked)
        if read.code:
            raise StoreUnavailable(self.where, self._reason(read))
        return dict(zip(versions, _blobs(read.output, list(versions.values())), strict=True))

    def _lists_any(self, pattern: str) -> bool | None:
        """Return whether the remote lists such a ref; None if it cannot be asked."""
        listed = self._exchange("ls-remote", "--quiet", *self._served("upload-pack"), "--", self._url, pattern)
        return None if listed.code else bool(listed.output.strip())

    def _served(self, program: str) -> list[str]:
        """Return the option for a repository on this host, whose configuration and hooks are not the user's."""
        if not self._local:
            return []
        for folder in (f"{self._url}/.git", self._url, f"{self._url}.git/.git", f"{self._url}.git"):
            self._check(folder)  # wherever git looks for it
        return [f"--{program}={shlex.join([child.program('git'), *SERVE, program])}"]

    def _check(self, folder: str) -> None:
        """Raise StoreRefused for a repository on this host that is not bare, or in which git might run something."""
        copy = f"{self._url.removesuffix('.git')}-bare.git"  # with the records, too
        clone = shell_command("git", "clone", "--mirror", folder, copy)
        bare = f"make a bare one: {clone} && {shell_command('git', 'remote', 'set-url', 'origin', copy)}"
        if os.path.isfile(folder) or os.path.lexists(f"{folder}/commondir"):
            raise StoreRefused(folder, "points to another repository, and a bare one is needed", bare)
        if not os.path.lexists(head := f"{folder}/HEAD"):
            return
        config = f"{folder}/config"
        for entry in self._made("config", "--file", config, "--null", "--list", stdin=b"").split("\0")[:-1]:
            name, _, value = entry.partition("\n")
            if value.lower() != FIXED[name] if name in FIXED else not PLAIN.fullmatch(name):
                unset = shell_command("git", "config", "--file", config, "--unset-all", name)
                reason = f"{name} = {value[:99]}: only plain settings of a bare repository are accepted"
                raise StoreRefused(config, reason, bare if name == "core.bare" else f"if nothing needs it: {unset}")
        named = self._exchange(f"--git-dir={folder}", "symbolic-ref", "--quiet", "HEAD").output
        if named.startswith(b"refs/fogspec/"):
            fix = shell_command("git", f"--git-dir={folder}", "symbolic-ref", "HEAD", "refs/heads/main")
            raise StoreRefused(head, "names a record, not a branch", f"name a branch: {fix}")

    def _exchange(self, *words: str, stdin: bytes = b"") -> Ended:
        try:
            if self._folder is None:
                self._folder = tempfile.TemporaryDirectory(prefix="fogspec-state-", ignore_cleanup_errors=True)
                exchange("init", "--bare", "--quiet", "--template=", folder=Path(self._folder.name))
            return exchange(*words, folder=Path(self._folder.name), stdin=stdin, headers=self._headers())
        except (UsageError, FileNotFoundError) as failed:
            raise StoreUnavailable(self.where, str(failed)) from None

    def _headers(self) -> Mapping[str, str]:
        """Return the headers that the clone's configuration has for URLs: this is how CI logs in."""
        if self._local:
            return {}
        with contextlib.suppress(UsageError):
            listed = git("config", "-z", "--get-regexp", HEADER, folder=self._clone).decode("utf-8", "replace")
            pairs = (entry.partition("\n") for entry in listed.split("\0") if entry)
            return {name: value for name, _, value in pairs}
        return {}

    def _reason(self, ended: Ended) -> str:
        """Return git's own reason in one line, without what may be in the URL."""
        refused = [
            line.split("\t")[-1] for line in ended.output.decode("utf-8", "replace").splitlines() if line[:1] == "!"
        ]
        lines = [
            *refused,
            *(one for one in ended.report.splitlines() if one.startswith(("fatal:", "error:"))),
            ended.report,
        ]
        return lines[0].splitlines()[0].replace(self._url, self.where.removeprefix("state in "))


def _blobs(output: bytes, versions: list[str]) -> list[Stored]:
    """Return the records in the output of `cat-file --batch`; one without its file has no content."""
    found, at = list[Stored](), 0
    for version in versions:
        end = output.index(b"\n", at)
        head, at = output[at:end].split(), end + 1
        size = int(head[2]) if len(head) == 3 and head[1] == b"blob" else None
        found.append(Stored(version, output[at : at + size] if size is not None else b""))
        at += 0 if size is None else size + 1
    return found
