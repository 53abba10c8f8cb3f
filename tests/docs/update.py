"""Writes what commands print into the pages that show it: `python -m tests.docs.update [PAGE]...`.

Where what is shown still matches, elisions included, it stays. Read the difference before you commit it.
"""

import re
import sys
import tempfile
from pathlib import Path

from tests.docs.blocks import blocks, pages
from tests.docs.running import Ran, differs, run

DIGEST = re.compile("sha256:[0-9a-f]{64}")


def main(arguments: list[str]) -> None:
    """Update the pages that are named, or all."""
    for page in [Path(one).resolve() for one in arguments] or pages():
        if not any(block.run for block in blocks(page)):
            continue
        with tempfile.TemporaryDirectory() as folder:
            ran = run(page, Path(folder))
        failed = [one for one, after in zip(ran, [*ran[1:], None], strict=True)
                  if one.code and not (after and after.step.command == "echo $?")]  # fmt: skip
        for one in failed:
            print(f"{page}:{one.step.line}: ended with {one.code}: {one.step.command}", *one.printed, sep="\n  ")
        if failed:
            print(f"{page}: left as it is")
            continue
        changed = [one for one in ran if differs(one)]
        _rewrite(page, changed)
        print(f"{page}: {len(changed)} of {len(ran)} commands print something new")


def _rewrite(page: Path, changed: list[Ran]) -> None:
    lines = page.read_text("utf-8").splitlines()
    for one in reversed(changed):
        first = one.step.line - 1 + len(one.step.command.splitlines())
        printed = [f"{one.step.block.indent}{DIGEST.sub('sha256:…', line)}" for line in one.printed]
        lines[first : first + len(one.step.shown or ())] = [line.rstrip() for line in printed]
    page.write_text("\n".join(lines) + "\n", "utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
