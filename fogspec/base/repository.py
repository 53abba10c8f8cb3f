"""The repository that a directory belongs to: the same for every clone of it, and not to be forged by a committed file.

Git's own configuration is read as text, so that the identity is the same where git is absent. Only the content of committed
files is asked of git.
"""

import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path

from fogspec.base.errors import UsageError
from fogspec.base.files import read_file
from fogspec.base.git import git

ACTORS = ("GITHUB_TRIGGERING_ACTOR", "GITHUB_ACTOR", "GITLAB_USER_LOGIN")
LONGEST = 1 << 20  # bytes of a configuration
URL = re.compile(
    r"(?P<scheme>[a-z][a-z0-9+.-]*)://(?:[^@/]*@)?(?P<host>\[[^\]/]*\]|[^:/]*)(?::(?P<port>[^/]*))?(?P<path>.*)", re.I
)
SCP = re.compile(r"(?:[^@/:]+@)?(?P<host>\[[^\]/]+\]|[^:/]+):(?P<path>(?!//).*)")
SECTION = re.compile(r'\[\s*(?P<name>[\w.-]+)(?:\s+"(?P<sub>(?:[^"\\]|\\.)*)")?\s*\]')
PORTS = {"ssh": "22", "git": "9418", "http": "80", "https": "443"}
CASELESS = ("github.com", "gitlab.com", "bitbucket.org")  # where Org/Repo and org/repo are one repository


def repository_of(root: Path) -> str:
    """Return the origin of the git repository and the directory inside it; without an origin, this host and the real path.

    All clones of one origin return the same, by whatever protocol they were cloned; forks return another.
    """
    if (found := origin_of(root)) is not None and (repository := repository_at(found[0], root)) is not None:
        return repository
    return f"file://{os.uname().nodename}{os.path.realpath(root)}"


def repository_at(url: str, root: Path) -> str | None:
    """Return what `repository_of` returns in a clone of the repository at this URL; None for an empty one."""
    real = Path(os.path.realpath(root))
    top = top_of(root) or real
    if (origin := normalized(url, top)) is None:
        return None
    inside = real.relative_to(top).as_posix()
    return origin if inside == "." else f"{origin}//{inside}"


def origin_of(root: Path) -> tuple[str, Path] | None:
    """Return the URL of the remote `origin` as it is configured, and the top of the clone; None without one."""
    top = top_of(root)
    url = None if top is None else _origin(top / ".git")
    return None if url is None or top is None else (url, top)


def top_of(root: Path) -> Path | None:
    """Return the top of the git checkout that a directory is in; None if it is in none."""
    real = Path(os.path.realpath(root))
    return next((top for top in (real, *real.parents) if os.path.lexists(top / ".git")), None)


def head_of(root: Path) -> str | None:
    """Return the commit that is checked out; None without git."""
    return _asked(root, "rev-parse", "--verify", "HEAD^{commit}")


def actor_of(root: Path) -> str | None:
    """Return the user of CI, or git's `user.name`; None without git."""
    if top_of(root) is None:
        return None
    return next(filter(None, map(os.environ.get, ACTORS)), None) or _asked(root, "config", "user.name")


def _asked(root: Path, *words: str) -> str | None:
    if top_of(root) is None:
        return None
    try:
        return git(*words, folder=os.path.realpath(root)).decode("utf-8", "replace").strip() or None
    except (UsageError, OSError):
        return None


def committed(root: Path, path: Path) -> bytes | None:
    """Return the content of a file below `root` as it was last committed; None if there is none, or git cannot tell."""
    inside = Path(os.path.relpath(path, root)).as_posix()
    try:
        return git("cat-file", "blob", f"HEAD:./{inside}", folder=os.path.realpath(root))
    except UsageError:
        return None


def committed_below(root: Path, folder: Path, wanted: Callable[[str], bool]) -> dict[str, bytes]:
    """Return the files that are `wanted` of a folder below `root`, at any depth, as they were last committed.

    By their paths in the folder; none if git cannot tell.
    """
    inside, real = Path(os.path.relpath(folder, root)).as_posix(), os.path.realpath(root)
    try:
        listed = git("ls-tree", "-r", "-z", "--name-only", f"HEAD:./{inside}", folder=real)
        names = [name for name in listed.decode("utf-8", "surrogateescape").split("\0") if name and wanted(name)]
        return {name: git("cat-file", "blob", f"HEAD:./{inside}/{name}", folder=real) for name in names}
    except UsageError:
        return {}


def normalized(url: str, top: Path) -> str | None:
    """Return `host/path` for the URL of a remote, without protocol, user, password and `.git`; None for an empty one.

    A path on this host, also one relative to the top of the clone, becomes `file://host/path`.
    """
    url = url.strip()
    if not url:
        return None
    if (found := URL.fullmatch(url)) is not None and found["scheme"].lower() != "file":
        usual = found["port"] in (None, "", PORTS.get(found["scheme"].lower()))
        return _joined(found["host"] if usual else f"{found['host']}:{found['port']}", found["path"])
    if found is None and (found := SCP.fullmatch(url)) is not None:
        return _joined(found["host"], found["path"])
    path = os.path.realpath(top / url.removeprefix("file://"))
    return f"file://{os.uname().nodename}{_bare(path)}"


def _joined(host: str, path: str) -> str:
    host = host.lower()
    path = _bare(re.sub(r"/+", "/", path).strip("/"))
    return f"{host}/{path.lower() if host in CASELESS else path}"


def _bare(path: str) -> str:
    return path.rstrip("/").removesuffix(".git").rstrip("/")


def _origin(dot_git: Path) -> str | None:
    """Return the URL of the remote `origin`; None without one, or if the configuration cannot be read."""
    found = None
    try:
        config = _common(dot_git) / "config"
        text = read_file(config, LONGEST).decode("utf-8", "replace")
    except OSError:
        return None
    for section, key, value in _entries(text):
        if section == ("remote", "origin") and key == "url":
            found = value  # the last one counts, as for `git config --get`
    return found


def _common(dot_git: Path) -> Path:
    """Return the directory with the configuration that a clone and its worktrees share; raise OSError."""
    folder = dot_git
    if not dot_git.is_dir():
        pointer = read_file(dot_git, LONGEST).decode("utf-8", "replace").strip()
        folder = dot_git.parent / pointer.removeprefix("gitdir:").strip()
    if (folder / "commondir").is_file():
        folder = folder / read_file(folder / "commondir", LONGEST).decode("utf-8", "replace").strip()
    return folder


def _entries(text: str) -> Iterator[tuple[tuple[str, str], str, str]]:
    """Yield section, key and value of each line of a git configuration; includes are not followed."""
    section = ("", "")
    for line in text.replace("\\\n", "").splitlines():
        line = line.strip()
        if (head := SECTION.match(line)) is not None:
            section = head["name"].lower(), re.sub(r"\\(.)", r"\1", head["sub"] or "")
            line = line[head.end() :].strip()
        key, equals, value = line.partition("=")
        if equals and not line.startswith(("#", ";")):
            yield section, key.strip().lower(), _value(value)


def _value(text: str) -> str:
    """Return a value without quotes and comment."""
    found, quoted, escaped = "", False, False
    for char in text.strip():
        if escaped:
            found, escaped = found + {"n": "\n", "t": "\t"}.get(char, char), False
        elif char == "\\":
            escaped = True
        elif char == '"':
            quoted = not quoted
        elif char in "#;" and not quoted:
            break
        else:
            found += char
    return found.strip()
