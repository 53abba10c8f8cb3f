"""Say how to restore a damaged file that people commit: from a commit that has it as it was written."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

from fogspec.base.diagnostics import Diagnostic, DiagnosticError
from fogspec.base.errors import UsageError
from fogspec.base.files import PULL
from fogspec.base.git import git
from fogspec.base.layout import Layout
from fogspec.base.text import shell_command
from fogspec.language.loader import UPGRADE, SourceFile
from fogspec.language.lockfile import Lock
from fogspec.results.io import result_in


def restorable(damaged: DiagnosticError, layout: Layout, base: str | None = None) -> DiagnosticError:
    """Return the errors of a damaged lock and of damaged results with the command that restores the file.

    What a newer fogspec wrote is not damaged, nor what Git LFS has not fetched.
    Where the damage was committed, HEAD has it too: then it is the commit `base`, or the one before that change.
    """

    def fix(one: Diagnostic) -> str | None:
        path = Path(one.span.path)
        if one.fix in (UPGRADE, PULL):
            return one.fix
        if path == layout.lock:
            return _fix(path, lambda file: file.document(Lock), "remove it and write it again: fogspec lock", base)
        if path.parent == layout.results:
            return _fix(path, result_in, "move it away and measure its sample again", base)
        return one.fix

    return DiagnosticError([replace(one, fix=fix(one)) for one in damaged.diagnostics])


def _fix(path: Path, read: Callable[[SourceFile], object], otherwise: str, base: str | None) -> str:
    for commit in _commits(path, base):
        try:
            read(SourceFile(path, git("cat-file", "blob", f"{commit}:./{path.name}", folder=path.parent)))
        except (UsageError, DiagnosticError):
            continue
        return f"restore the file ({shell_command('git', 'checkout', commit, '--', path)}), or {otherwise}"
    return f"no commit has it undamaged: {otherwise}"


def _commits(path: Path, base: str | None) -> Iterator[str]:
    yield "HEAD"
    if base is not None:
        yield base[:12]
    try:
        changed = git("log", "-1", "--format=%h", "--", path.name, folder=path.parent).decode().strip()
    except UsageError:
        return
    if changed:
        yield f"{changed}~1"
