"""Write generated files, or with `--check` compare them with what is committed: for every tool that makes files."""

from collections.abc import Mapping, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def write_or_check(files: Mapping[Path, str], arguments: Sequence[str], command: str) -> int:
    """Write the files that differ, or with `--check` in `arguments` list them with the command that writes them.

    Return the exit code: 3 if a check finds a difference, else 0.
    """
    check = "--check" in arguments
    differing = [path for path, text in files.items() if not path.is_file() or path.read_text("utf-8") != text]
    for path in differing:
        if not check:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(files[path], "utf-8")
        print(f"{path.relative_to(ROOT)} {'differs' if check else 'written'}")
    if not (check and differing):
        return 0
    print(f"write them: {command}")
    return 3
