"""Git's merge driver for `compiled/`: what two branches compiled is not merged by lines, but compiled from the merged inputs.

While git merges, it has not written the merged specs yet. So the driver asks git for the tree that the merge makes, writes it
to a temporary directory, and compiles there.
"""

import io
import os
import re
import tarfile
import tempfile
from collections.abc import Mapping
from pathlib import Path

from fogspec.base.errors import OutOfDate, UsageError
from fogspec.base.files import read_bounded
from fogspec.base.git import git
from fogspec.base.text import shell_command
from fogspec.compile.agent_archive import agent_archive
from fogspec.compile.compiler import compile_application
from fogspec.compile.inputs import Inputs
from fogspec.spec.discover import find_specs
from fogspec.spec.loader import load

HEAD = re.compile(r"GITHEAD_([0-9a-f]{40}(?:[0-9a-f]{24})?)")
PICKED = re.compile(r"^(?:pick|reword|edit|squash|fixup)\s+(?:-[cC]\s+)?([0-9a-f]{7,64})\b")
MOST_BYTES = 1 << 20  # of git's list of what a rebase has done


def other_side(environment: Mapping[str, str]) -> str:
    """Return the commit that is merged into HEAD; raise UsageError if git does not say it, as in a cherry-pick."""
    heads = [found[1] for name in environment if (found := HEAD.fullmatch(name)) is not None]
    if len(heads) == 1:
        return heads[0]
    folder = Path(os.fsdecode(git("rev-parse", "--absolute-git-dir").rstrip(b"\n")))
    try:
        done = read_bounded(folder / "rebase-merge" / "done", MOST_BYTES).decode("utf-8", "replace").splitlines()
    except OSError:
        done = []
    if not heads and done and (found := PICKED.match(done[-1])) is not None:
        return found[1]
    raise UsageError("git does not say which commit is merged")


def merged(path: str, other: str) -> bytes:
    """Return a compiled file as it follows from the merge of HEAD and another commit; `path` is relative to the top.

    Raise UsageError if the inputs conflict or git cannot tell, OutOfDate if the file does not follow from them, and the errors
    of `compile_application`.
    """
    parts = Path(path).parts
    if "compiled" not in parts[:-1]:
        raise UsageError(f"{path} is not below compiled/")
    place = parts.index("compiled")
    if parts[place + 1 :] == ("agent.pyz",):
        return agent_archive()
    root, name = Path(*parts[:place]), parts[place + 1]
    if not hasattr(tarfile, "data_filter"):
        raise UsageError("this Python cannot unpack an archive safely: install Python 3.11.4 or later")
    try:
        # A file below compiled/ that conflicts is what this driver is about: any side of it will do here.
        said = git("-c", "merge.fogspec.driver=true", "merge-tree", "--write-tree", "HEAD", other)
    except UsageError:
        raise UsageError("specs, results or other files conflict (or git is older than 2.38)") from None
    tree = said.split(b"\n")[0].decode()
    with tempfile.TemporaryDirectory(prefix="fogspec-merge-") as folder:
        with tarfile.open(fileobj=io.BytesIO(git("archive", "--format=tar", tree))) as content:
            content.extractall(folder, filter="data")
        return _compiled(Path(folder) / root, name, Path(*parts[place:]))


def _compiled(root: Path, name: str, path: Path) -> bytes:
    before = Path.cwd()
    os.chdir(root)
    try:
        loaded = [one for one in load(find_specs()) if one.name == name]
        for inputs in Inputs.load([], loaded=loaded):
            content = compile_application(inputs).files.get(path)
            if content is not None:
                return content
    finally:
        os.chdir(before)
    raise OutOfDate(f"{path}: does not follow from the merged specs and results")


def again(path: str) -> str:
    """Return what to do about a compiled file that could not be compiled."""
    return f"resolve specs and results, then: fogspec compile, {shell_command('git', 'add', path)}"
