"""Read files at other commits of a git repository, and find the applications that a change concerns."""

import os
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from fogspec.base.errors import UsageError
from fogspec.base.git import git
from fogspec.base.layout import PROJECT
from fogspec.base.text import shell_command
from fogspec.language.loader import LoadedSpec, SourceFile
from fogspec.language.rules.policies import FOLDER, SUFFIX

LONGEST_TEXT = 500  # to look for in the history
UNKNOWN_BASE = (
    "where this change starts is not in this clone: what others merged since {} is in it, too; "
    "git fetch --unshallow, or fetch-depth: 0 for actions/checkout"
)
PRICES = ".csv"  # how a price list ends, in whatever folder
PROSE = (".md", ".rst")  # how files end that nothing reads, outside of an application's own folder
OWN_FOLDERS = ("specs", "compiled", "results", "environments")  # of a project: each file belongs to some application


class Repository:
    """The git repository that contains the working directory."""

    def __init__(self) -> None:
        """Find the repository. Raise UsageError if there is none, or git refuses to read it."""
        try:
            self.top = Path(git("rev-parse", "--show-toplevel").decode().strip())
        except UsageError as failed:
            raise UsageError(
                f"{os.getcwd()} is in no git repository that can be read",
                "run it in a clone, to compare what is committed with what is checked out",
                "fogspec diff compares without git: what compile would change",
                failed.message,
            ) from None

    def base_of(self, range_: str) -> tuple[str, bool]:
        """Return the commit that a change starts from: the merge base of BASE in `BASE..HEAD` or `BASE` and the checkout.

        And whether it is known: a shallow clone may not reach it, and then it is BASE, since when others may have merged. Raise
        UsageError for a missing commit, or a HEAD that is not checked out.
        """
        base, dots, head = range_.partition("..")
        if dots and (head := head.lstrip(".")) and self._commit(head) != self._commit("HEAD"):
            raise UsageError(f"{head} is not what is checked out", shell_command("git", "checkout", head))
        commit = self._commit(base or "HEAD")
        try:
            return git("merge-base", commit, "HEAD").decode().strip(), True
        except UsageError:
            # A commit names its parents also where a shallow clone has none of them, as that of a pull request's merge.
            lines = git("cat-file", "commit", "HEAD").partition(b"\n\n")[0].split(b"\n")
            return commit, f"parent {commit}".encode() in lines

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
        return self._differing([":/"], commit)

    def not_staged(self, below: Iterable[Path]) -> list[Path]:
        """Return the files in these places that the next commit lacks as they are here, also those that git does not know yet.

        In a hook of git's, the next commit is the one that is being made. Raise UsageError for a place outside.
        """
        index = os.path.abspath(os.environ.get("GIT_INDEX_FILE", ""))  # of a hook, which git starts at the top
        own = os.path.dirname(index) == git("rev-parse", "--absolute-git-dir").decode().strip()
        places = [f":(literal){os.path.abspath(path)}" for path in below]
        return self._differing(places, index=index if own else None) if places else []

    def _differing(self, places: Sequence[str], *commit: str, index: str | None = None) -> list[Path]:
        plain = ("--name-only", "-z", "--no-ext-diff", "--no-textconv", "--no-renames", "--no-relative")
        names = git("diff", *plain, *commit, "--", *places, index=index).split(b"\0")
        others = ("ls-files", "--others", "--exclude-standard", "--full-name", "-z", "--", *places)
        names += git(*others, index=index).split(b"\0")
        return [self.top / os.fsdecode(name) for name in dict.fromkeys(names) if name]

    def first_day(self, path: Path, text: str) -> str | None:
        """Return the day of the commit that first had a text in a file; None if the history of the clone does not reach it."""
        if not (0 < len(text) <= LONGEST_TEXT and text.isprintable()):
            return None
        words = ("log", "--format=%cs", "--no-textconv", "--no-ext-diff", f"-S{text}", "--", os.fspath(path.absolute()))
        try:
            is_whole = git("rev-parse", "--is-shallow-repository").strip() == b"false"
            found = git(*words).decode().split() if is_whole else []
        except UsageError:
            return None
        return found[-1] if found else None

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


@dataclass(frozen=True, slots=True)
class Base:
    """What a change is compared with: a commit, and the files that differ between it and the checkout.

    Unless it `is_known`, they are not only the change's own.
    """

    repository: Repository
    commit: str
    is_known: bool
    paths: frozenset[str]
    _content: dict[str, bytes | None] = field(default_factory=dict)

    @classmethod
    def of(cls, range_: str) -> "Base":
        """Find the commit and the files that differ. Raise the errors of `Repository`."""
        repository = Repository()
        commit, is_known = repository.base_of(range_)
        return cls(
            repository, commit, is_known, frozenset(os.path.realpath(path) for path in repository.changed(commit))
        )

    @property
    def warning(self) -> str | None:
        """Return that the files are not only the change's own; None if they are."""
        return None if self.is_known else UNKNOWN_BASE.format(self.commit[:12])

    def differs(self, path: Path) -> bool:
        """Return whether a file differs between the base and the checkout."""
        return os.path.realpath(path) in self.paths

    def below(self, folder: Path) -> list[str]:
        """Return the files that differ in a folder, at any depth, sorted: their paths relative to it."""
        start = os.path.realpath(folder) + os.sep
        return sorted(path.removeprefix(start) for path in self.paths if path.startswith(start))

    def at(self, path: Path) -> bytes | None:
        """Return the content of a file at the base, None if it did not exist; git is asked once."""
        key = os.path.realpath(path)
        if key not in self._content:
            self._content[key] = self.repository.at(self.commit, Path(key))
        return self._content[key]

    def file(self, path: Path) -> SourceFile | None:
        """Return a file at the base, None if it did not exist."""
        content = self.at(path)
        return None if content is None else SourceFile(path, content)


@dataclass(frozen=True, slots=True)
class Rules:
    """What judges a change and differs since its base: policies, and where the live state is (`fogspec.yaml`).

    `before` are the policies of the base that the change edited or removed, by project, as `Policies` takes them.
    """

    changed: tuple[str, ...] = ()
    before: Mapping[str, Mapping[str, bytes]] = field(default_factory=dict)

    @classmethod
    def of(cls, repository: Repository, commit: str, roots: Iterable[Path], paths: Iterable[Path]) -> "Rules":
        """Find them among the files that differ since this commit, in the projects with these roots."""
        changed, before = dict[str, None](), defaultdict[str, dict[str, bytes]](dict)
        known = {os.path.realpath(root): root for root in roots}
        for path in paths:
            is_policy = path.parent.name == FOLDER and path.name.endswith(SUFFIX)
            root = known.get(str(path.parents[1] if is_policy else path.parent))
            if root is None or not (is_policy or path.name == PROJECT):
                continue
            name = os.path.normpath(root / FOLDER / path.name if is_policy else root / PROJECT)
            changed[name] = None
            content = repository.at(commit, path) if is_policy else None
            if content is not None:
                before[os.path.realpath(root)][f"{commit[:12]}:{name}"] = content
        return cls(tuple(sorted(changed)), dict(before))


def concerned(loaded: Sequence[LoadedSpec], paths: Iterable[str]) -> set[str]:
    """Return the applications that a change of these files, by their real paths, may concern.

    One is left out only if each changed file belongs wholly to others, or is a text for people outside their folders. It is
    not known whose price list a file is.
    """
    owners, specs, folders, shared = defaultdict[str, set[str]](set), set[str](), set[str](), set[str]()
    for one in loaded:
        layout = one.layout
        own = (layout.spec.parent, layout.compiled, layout.planned, layout.results, layout.overlay)
        for owned in (*filter(None, own), layout.spec, layout.lock):
            owners[os.path.realpath(owned)].add(one.name)
        specs |= {os.path.realpath(layout.spec), os.path.realpath(layout.lock)}
    for layout in {one.layout.root: one.layout for one in loaded}.values():
        folders |= {os.path.realpath(layout.root / name) for name in OWN_FOLDERS}
        shared.add(os.path.realpath(layout.agent))
    found = set[str]()
    for path in paths:
        above = [path, *map(str, Path(path).parents)]
        if path.endswith(PROSE) and owners.keys().isdisjoint(above) and path not in specs:
            continue
        if path in shared or path.endswith(PRICES) or folders.isdisjoint(above[1:]):
            return {one.name for one in loaded}
        found.update(*(owners[one] for one in (above[:1] if path in specs else above) if one in owners))
    return found
