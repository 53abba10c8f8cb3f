"""Write generated files of the repository, or with `--check` compare them with what is committed."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from fogspec.base.errors import Refused

ROOT = Path(__file__).resolve().parents[2]


def require_checkout() -> None:
    """Raise Refused if this package is not in a checkout of fogspec, which has the files to read and to write."""
    if not (ROOT / "lab" / "pyproject.toml").is_file():
        raise Refused("this command makes files of fogspec's repository", "pip install --editable ./lab, in a checkout")


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
