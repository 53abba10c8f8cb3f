"""What validate makes of many mutants: `python -m tests.damage.survey [COUNT] [SEED]` prints the figures."""

import sys
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from fogspec.base.diagnostics import Diagnostic
from fogspec.language.loader import check_text
from tests.damage.specs import Mutant, mutants

ROOT = Path(__file__).resolve().parents[2]
SPECS = ("grasp-planning-recorded", "vslam-recorded", "motion-planning-recorded")


@dataclass
class Survey:
    """Counts by kind of mutation; `bad` are mutants that broke the promise: located diagnostics, or valid."""

    total: Counter[str] = field(default_factory=Counter)
    valid: Counter[str] = field(default_factory=Counter)
    at_line: Counter[str] = field(default_factory=Counter)
    with_right: Counter[str] = field(default_factory=Counter)
    right: Counter[str] = field(default_factory=Counter)
    bad: list[tuple[Mutant, str]] = field(default_factory=list)
    missed: dict[str, list[tuple[Mutant, Diagnostic]]] = field(default_factory=lambda: defaultdict(list))

    def take(self, mutant: Mutant) -> None:
        """Validate one mutant and count what came of it."""
        kind = mutant.kind
        self.total[kind] += 1
        try:
            found, diagnostics = check_text(mutant.content, "spec.yaml")
        except Exception as bug:
            self.bad.append((mutant, f"{type(bug).__name__}: {bug}"))
            return
        errors = [one for one in diagnostics if one.severity == "error"]
        if not errors:
            self.valid[kind] += 1
            if not found:
                self.bad.append((mutant, "neither applications nor errors"))
            return
        lines = mutant.content.decode().count("\n") + 1
        if any(not 1 <= one.span.line <= lines or one.span.column < 1 for one in errors):
            self.bad.append((mutant, "a diagnostic is outside of the file"))
        first = errors[0]
        near = (mutant.line, mutant.line - 1) if kind in ("line repeated", "line dropped") else (mutant.line,)
        if first.span.line in near:
            self.at_line[kind] += 1
        else:
            self.missed[kind].append((mutant, first))
        if mutant.right is not None:
            self.with_right[kind] += 1
            self.right[kind] += mutant.right in (first.fix or "")


def survey(count: int, seed: int = 1) -> Survey:
    """The survey of `count` mutants of the example specs."""
    result = Survey()
    for number, name in enumerate(SPECS):
        text = (ROOT / "specs" / f"{name}.yaml").read_text("utf-8")
        share = count // len(SPECS) + (number < count % len(SPECS))
        for mutant in mutants(text, share, seed * 1000 + number):
            result.take(mutant)
    return result


def report(result: Survey) -> Iterator[str]:
    """The figures as a table."""
    yield f"{'mutation':<20}{'mutants':>9}{'valid':>9}{'at the line':>13}{'right fix':>11}"
    for kind in [*result.total, "all"]:

        def count(of: Counter[str], kind: str = kind) -> int:
            return sum(of.values()) if kind == "all" else of[kind]

        wrong = count(result.total) - count(result.valid)
        line = f"{count(result.at_line) / wrong:.1%}" if wrong else "-"
        fix = f"{count(result.right) / count(result.with_right):.1%}" if count(result.with_right) else "-"
        yield f"{kind:<20}{count(result.total):>9,}{count(result.valid):>9,}{line:>13}{fix:>11}"
    yield f"neither valid nor located, or a traceback: {len(result.bad)}"


def main() -> int:
    """Print the figures; 1 when a mutant broke the promise."""
    count, seed = (int(one) for one in (sys.argv[1:] + ["100000", "1"][len(sys.argv) - 1 :])[:2])
    start = time.perf_counter()
    result = survey(count, seed)
    print("\n".join(report(result)))
    print(f"seed {seed}, {time.perf_counter() - start:.0f} s")
    for mutant, why in result.bad[:5]:
        print(f"{mutant.kind} at line {mutant.line}: {why}")
    return 1 if result.bad else 0


if __name__ == "__main__":
    sys.exit(main())
