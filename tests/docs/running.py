"""Runs a page's blocks, one shell a page, in a copy of what a fresh checkout holds."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from tests.docs.blocks import DIFFERS, ROOT, Step, blocks, steps
from tests.support.loaded import programs

COPIED = (
    "specs",
    "results",
    "compiled",
    "schemas",
    "templates",
    "tests/cases/launch",
    "tests/cases/graph",
    "docs/examples",
)
MACHINE_DEPENDENT = ("__pycache__",)
AUTHOR = ("-c", "user.name=you", "-c", "user.email=you@example.org")
BEGINS, ENDS = "\x1e", "\x1f"
LONGEST_S = 1200
NO_VARIABLES: Mapping[str, str] = MappingProxyType({})
# What a bench warns of on a busy computer.
# What bench says of requests that a busy host slowed down for a while.
UNSTEADY = re.compile(
    r" \((?:the (?:first|second) half was|one of \d+ requests took|requests \d+ to \d+ of \d+ took) [^)]*\)(?=\n)"
)
BUSY = re.compile(
    r"^(?:warning: load [\d.]+ on \d+ CPUs: .*\n|[! ]*warning: (?:sample \S+:\s+)?contended: .*\n(?:    (?! |warning: ).*\n)*)",
    re.MULTILINE,
)


@dataclass(frozen=True, slots=True)
class Ran:
    """What a command did: its exit code and what it printed, both streams as on a terminal."""

    step: Step
    code: int
    printed: tuple[str, ...]


def run(
    page: Path,
    folder: Path,
    inside: Callable[[list[str]], list[str]] | None = None,
    variables: Mapping[str, str] = NO_VARIABLES,
    longest_s: float = LONGEST_S,
) -> list[Ran]:
    """Run a page in `folder`; raises AssertionError when its shell ended early.

    `inside` makes of a command the one that runs it somewhere else, such as in a network of its own; `variables` are added to
    the environment. Here each `fogspec` begins with everything loaded.
    """
    here = folder / "checkout"
    for name in COPIED:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, here / name, ignore=shutil.ignore_patterns(*MACHINE_DEPENDENT[1:]))
    for kind in ("compiled", "results"):
        for pattern in MACHINE_DEPENDENT[:1]:
            for path in (here / kind).glob(pattern):
                shutil.rmtree(path) if path.is_dir() else path.unlink()
    for words in (("init", "--quiet"), ("add", "--all"), (*AUTHOR, "commit", "--quiet", "--message", "a checkout")):
        subprocess.run(["git", *words], cwd=here, check=True)
    (folder / "home").mkdir()
    script = folder / "page.sh"
    command = ["bash", "--noprofile", "--norc", str(script)]
    asked = _script(page, script)
    environment = {
        "PATH": os.pathsep.join(
            [*([] if inside else [str(programs())]), str(Path(sys.executable).parent), os.environ["PATH"]]
        ),
        "HOME": str(folder / "home"),
        "LANG": "C.UTF-8",
        "COLUMNS": "120",
        "SKYPILOT_DISABLE_USAGE_COLLECTION": "1",
    } | dict(variables)
    try:
        ended = subprocess.run(
            inside(command) if inside else command, cwd=here, env=environment, timeout=longest_s,
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        )  # fmt: skip
    finally:
        for live in here.glob(".fogspec/*/deployment.yaml"):
            subprocess.run(["fogspec", "down", live.parent.name], cwd=here, env=environment, timeout=600)
    said = ended.stdout.replace(environment["HOME"], "/home/you")
    found = re.findall(rf"{BEGINS}(\d+)\n(.*?)\n?{ENDS}(\d+)\n", said, re.DOTALL)
    assert len(found) == len(asked), f"{page.name} ended after {len(found)} of {len(asked)} commands:\n{ended.stdout}"
    return [Ran(asked[int(n)], int(code), tuple(_printed(text))) for n, text, code in found]


def _printed(text: str) -> list[str]:
    """The lines, without what depends on what else runs on this machine."""
    calm = UNSTEADY.sub("", BUSY.sub("", f"{text}\n")).removesuffix("\n")
    return calm.replace(" ok, contended: ", " ok: ").splitlines()


def _script(page: Path, path: Path) -> list[Step]:
    """Write the page as a script, with marks around what each command prints."""
    asked: list[Step] = []
    lines = ["_last=0"]
    for block in blocks(page):
        if block.file:
            target = shlex.quote(block.file)
            lines += [f"mkdir -p $(dirname {target})", f"cat > {target} <<'END-OF-BLOCK'", block.text, "END-OF-BLOCK"]
        for step in steps(block) if block.run else ():
            lines += [f"printf '{BEGINS}{len(asked)}\\n'", "(exit $_last)", "{", step.command, "} 2>&1", "_last=$?"]
            lines += [f"printf '\\n{ENDS}%s\\n' $_last"]
            asked.append(step)
    path.write_text("\n".join(lines) + "\n", "utf-8")
    return asked


def mistakes(page: Path, ran: list[Ran]) -> list[str]:
    """What of a page is not as it shows: commands that failed, or that print something else."""
    wrong = []
    for one, after in zip(ran, [*ran[1:], None], strict=True):
        where = f"{page.relative_to(ROOT)}:{one.step.line}: $ {one.step.command}\n"
        said = after is not None and after.step.command == "echo $?"
        if one.code and not said:
            wrong.append(f"{where}ended with {one.code}:\n" + "\n".join(one.printed))
        elif differs(one):
            wrong.append(f"{where}prints (python -m tests.docs.update):\n" + "\n".join(one.printed))
    return wrong


def differs(ran: Ran) -> bool:
    """Whether a command printed something else than its page shows."""
    if ran.step.shown is None:
        return False
    loose = ran.step.block.title == DIFFERS
    shown = [_tidy(line, loose) for line in ran.step.shown]
    printed = [_tidy(line, loose) for line in ran.printed]
    return not re.fullmatch(_pattern(shown), "".join(f"{line}\n" for line in printed), re.DOTALL)


def _pattern(shown: list[str]) -> str:
    """A pattern that matches what is shown, with its elisions."""
    parts = []
    for line in shown:
        text = "[^\n]*".join(re.escape(part) for part in line.split("…"))
        parts.append("(?:[^\n]*\n)*?" if line.strip() == "..." else f"{text}\n")
    return "".join(parts)


def _tidy(line: str, loose: bool) -> str:
    line = line.rstrip()
    if loose:
        line = re.sub(r"\d+(,\d{3})*(\.\d+)?(e[+-]?\d+)?( ?(ns|us|µs|ms|s|min)\b)?", "N", line)
        line = re.sub(r"\s+", " ", line)
    return line
