"""Load, compute, write: each command reads each file once, parses it once, and fits the same data once.

A *full fit* is one call of `fogspec.model.fit.fit` (the curves and the evidence of an application). The surrogate is
conditioned once on all samples; `explain` and `report` condition it besides on all samples but one, each subset once.
"""

import hashlib
import os
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from fogspec.base import project_files
from fogspec.base.yaml import reader
from fogspec.language.loader import SourceFile
from fogspec.model import fit as model_fit
from fogspec.numerics.surrogate import Space
from tests.support.running import Shell, shell  # noqa: F401

ROOT = Path(__file__).resolve().parents[2]
SAMPLES = {
    "specs/vslam-recorded.yaml": 9,
    "specs/grasp-planning-recorded.yaml": 12,
    "specs/motion-planning-recorded.yaml": 17,
}
MANIFESTS = {
    "specs/vslam-recorded.yaml": ["vslam-recorded"],
    "specs/grasp-planning-recorded.yaml": ["grasp-planning-recorded"],
    "specs/motion-planning-recorded.yaml": ["motion-planning-apartment-recorded", "motion-planning-cubicles-recorded"],
}


@dataclass
class Counts:
    """How often each file below `folder` was opened for reading and parsed, and each set of samples was fitted."""

    folder: Path
    opened: Counter[str] = field(default_factory=Counter)
    parsed: Counter[str] = field(default_factory=Counter)
    full_fits: Counter[str] = field(default_factory=Counter)
    conditioned: Counter[str] = field(default_factory=Counter)

    def clear(self) -> None:
        for counter in (self.opened, self.parsed, self.full_fits, self.conditioned):
            counter.clear()


COUNTING: list[Counts] = []


def _on_open(event: str, arguments: tuple[Any, ...]) -> None:
    """Count what is opened for reading; an audit hook can be added and never removed."""
    if event != "open" or not COUNTING or not isinstance(arguments[0], (str, bytes)):
        return
    path, flags = os.path.realpath(os.fsdecode(arguments[0])), arguments[2]
    if flags & os.O_NOFOLLOW:
        return  # relative to a folder's handle, which the event does not have: counted where it is opened
    folder = str(COUNTING[0].folder)
    if path.startswith(folder + os.sep) and not flags & (os.O_WRONLY | os.O_RDWR) and not os.path.isdir(path):
        COUNTING[0].opened[os.path.relpath(path, folder)] += 1


@pytest.fixture
def counts(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> Iterator[Counts]:
    """This repository's compiled and measured specs, committed, and what commands read and fit there."""
    for name in ("specs", "compiled", "results"):
        shutil.copytree(ROOT / name, shell.folder / name)
    (shell.folder / "specs/ros2_ws").mkdir(exist_ok=True)
    who = ["-c", "user.name=a", "-c", "user.email=a@example.org", "-c", "commit.gpgsign=false"]
    for words in (["init", "-q"], ["add", "-A"], [*who, "commit", "-q", "-m", "all"]):
        subprocess.run(["git", *words], cwd=shell.folder, check=True)
    found = Counts(Path(os.path.realpath(shell.folder)))

    def counting(function: Callable[..., Any], counter: Counter[str], key: Callable[..., str]) -> Callable[..., Any]:
        def counted(*arguments: Any) -> Any:
            counter[key(*arguments)] += 1
            return function(*arguments)

        return counted

    opened = project_files._opened

    def counted_open(folder: int, name: str, path: Path, flags: int) -> int:
        if not flags & (os.O_WRONLY | os.O_RDWR):
            found.opened[os.path.relpath(os.path.realpath(path), found.folder)] += 1
        return opened(folder, name, path, flags)

    monkeypatch.setattr(project_files, "_opened", counted_open)
    monkeypatch.setattr(reader, "documents", counting(reader.documents, found.parsed, lambda _text, name: name))
    monkeypatch.setattr(
        Space, "fit", counting(Space.fit, found.conditioned, lambda space, samples: _key(space, samples))
    )
    # `is_proxy` is called once in every full fit, whoever imported `fit` by name.
    fits = counting(model_fit.is_proxy, found.full_fits, lambda application, known: application.metadata.name)
    monkeypatch.setattr(model_fit, "is_proxy", fits)
    if _on_open not in HOOKS:
        sys.addaudithook(_on_open)
        HOOKS.append(_on_open)
    COUNTING.append(found)
    yield found
    COUNTING.clear()


HOOKS: list[Callable[..., None]] = []


def _key(space: Space, samples: Any) -> str:
    columns = [getattr(samples, name).tobytes() for name in samples.__dataclass_fields__]
    return hashlib.sha256(b"|".join([str(id(space)).encode(), *columns])).hexdigest()


def commands(spec: str) -> list[tuple[str, ...]]:
    found = [
        ("compile", spec),
        ("menu", spec, "--alpha", "0.3"),
        ("explain", spec),
        ("explain", spec, "-o", "json"),
        ("report", spec),
        ("status", spec),
        ("diff", spec),
        ("diff", "--since", "HEAD", spec),
        ("check", spec),
        ("check", spec, "-o", "statement"),
        ("bench", spec, "--dry-run"),
    ]
    for name in MANIFESTS[spec]:
        found += [("apply", f"compiled/{name}/manifest.yaml", "--dry-run"), ("apply", name, "--dry-run")]
        # A name leads to no path: the spec is found among those of the project, then loaded.
        found += [(verb, name) for verb in ("menu", "status", "check", "diff")]
    return found


@pytest.mark.parametrize("spec", list(SAMPLES))
def test_every_command_reads_parses_and_fits_once(shell: Shell, counts: Counts, spec: str) -> None:
    for words in commands(spec):
        counts.clear()
        shell(*words, code=None)
        # The image of vslam is not pinned, and no price is known to `apply` then; all else was read before it says so.
        most = {name: value for name, value in counts.opened.items() if value > 1}
        assert not most, f"{words} opened more than once: {most}"
        assert counts.parsed, f"{words} parsed nothing"
        most = {name: value for name, value in counts.parsed.items() if value > 1}
        assert not most, f"{words} parsed more than once: {most}"
        assert all(value == 1 for value in counts.full_fits.values()), f"{words}: {counts.full_fits}"
        assert all(value == 1 for value in counts.conditioned.values()), f"{words} fitted the same samples again"
        applications = len(counts.full_fits)
        if words[0] in ("explain", "report"):
            assert len(counts.conditioned) == SAMPLES[spec] + applications, words
        else:
            assert len(counts.conditioned) == applications, words


def test_an_unmeasured_application_is_not_fitted(shell: Shell, counts: Counts) -> None:
    shutil.rmtree(shell.folder / "results")
    for words in ((verb, "specs/vslam-recorded.yaml") for verb in ("compile", "status", "diff")):
        counts.clear()
        shell(*words)
        assert not counts.full_fits
        assert not [name for name, value in counts.opened.items() if value > 1]


def test_what_is_compared_without_parsing_is_what_a_reader_would_see(shell: Shell, counts: Counts) -> None:
    """`diff` compares the manifest's values, not the text that they would be written as."""
    from fogspec.compile.compiler import compile_application
    from fogspec.compile.inputs import Inputs

    for spec in SAMPLES:
        for inputs in Inputs.load([shell.folder / spec]):
            decision = compile_application(inputs).decision
            assert decision is not None
            assert decision.manifest is not None
            content = decision.files[inputs.layout.manifest]
            assert SourceFile("manifest.yaml", content).plain() == decision.manifest.model_dump(mode="json")
