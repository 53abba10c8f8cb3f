"""One benchmark from start to end: locked, journaled, interruptible, and reported."""

import os
import secrets
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fogspec import stages
from fogspec.base import digest
from fogspec.base.outcomes import CloudFailed, Interrupted, Refused, WrongFile
from fogspec.effects import watching
from fogspec.effects.clock import SystemClock
from fogspec.effects.collecting import Rules
from fogspec.effects.journal import Journal
from fogspec.effects.layout import Layout
from fogspec.effects.locking import held
from fogspec.effects.orders import Order
from fogspec.effects.preparing import Prepared
from fogspec.effects.recording import ResultsFile
from fogspec.effects.sampling import Campaign
from fogspec.plan import lifetime_s
from fogspec.results import Results
from fogspec.seams import Runner

DEADLINE_BEFORE_END_S = 60.0


@dataclass(slots=True)
class Interrupt:
    """Whether the user asked to stop: the first Ctrl-C stops cleanly, the second at once."""

    asked: bool = False

    def __call__(self, number: int, _frame: Any) -> None:
        """Handle the signal."""
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True


def bench(prepared: Prepared, runner: Runner, watch: Callable[[Campaign], watching.Watcher]) -> Results:
    """Measure what is to be measured, and return the results as they are on disk.

    Raises Refused when another bench of this application runs, CloudFailed for machines that could not be
    verified gone, Interrupted when the user stopped it, WrongFile for a disk that cannot be written; results are on
    disk in every case.
    """
    layout, left = prepared.layout, list[str]()
    again = f"run the bench of {layout.name} again: it goes on where this one stopped"
    try:
        with held(layout.state / "lock", f"a bench of {layout.name}"), interruptible() as interrupt:
            results = _measure(prepared, runner, watch, interrupt, left)
    except KeyboardInterrupt:
        raise Interrupted("interrupted at once", *map("may still run: {}".format, left), again) from None
    except BrokenPipeError:
        raise
    except OSError as problem:
        said = f"{problem.filename or layout.state}: {problem.strerror or problem}"
        raise WrongFile(said, *map("may still run: {}".format, left), again) from None
    if left:
        raise CloudFailed("these machines could not be verified gone", *left, again)
    if interrupt.asked:
        raise Interrupted("interrupted: nothing runs any more", again)
    return results


def _measure(
    prepared: Prepared, runner: Runner, watch: Callable[[Campaign], watching.Watcher], interrupt: Interrupt,
    left: list[str],
) -> Results:  # fmt: skip
    """Run the campaign; `left` gets the names of machines that are not known to be gone, also when this raises."""
    journal = Journal(prepared.layout.state / "journal.jsonl")
    try:
        campaign, ledger = _campaign(prepared, runner, journal, interrupt)
        campaign.left = left
        with watch(campaign) as watcher:
            campaign.tell = watcher
            running_on = campaign.recover()
            campaign.run([sample for sample in prepared.todo if sample.id not in running_on])
        return ledger.results()
    finally:
        journal.close()


def _campaign(
    prepared: Prepared, runner: Runner, journal: Journal, interrupt: Interrupt
) -> tuple[Campaign, ResultsFile]:
    layout, body = prepared.layout, prepared.plan.spec
    application = stages.measured_digest(prepared.application)
    ledger = ResultsFile(
        layout, application, prepared.plan_digest, runner.name, runner.source, body.budget,
        [sample.id for sample in body.samples], redactor(prepared.application.spec.secrets),
        body.pins or None, body.application.reads,
    )  # fmt: skip
    if prepared.outdated:
        set_aside(layout)
    if prepared.results is not None:
        check_same_runner(prepared.results, runner)
        ledger.take(prepared.results)
    # A sample that runs on from before must have been started by a task with the same pins.
    measures = digest.of_value([application, body.pins])
    journal.begin(runner.name, measures, prepared.plan_digest, ledger.spent_usd)
    life = lifetime_s(body.after, body.setup)
    order = Order(
        application=measures, plan=prepared.plan_digest, rules=Rules.of(prepared.application), budget_usd=body.budget,
        deadline_s=life - DEADLINE_BEFORE_END_S, lifetime_s=life, tasks=prepared.tasks, root=layout.root,
        attempts=layout.state / "attempts", token=secrets.token_hex(4),
    )  # fmt: skip
    return Campaign(order, runner, journal, ledger, SystemClock(), stopping=lambda: interrupt.asked), ledger


def check_same_runner(results: Results, runner: Runner) -> None:
    """Raises Refused when results of one kind of measurement would be mixed with those of another."""
    if results.spec.samples and results.spec.runner != runner.name:
        raise Refused(
            f"the results there were measured with the runner {results.spec.runner}, not {runner.name}: they are not mixed",
            "move the results file away to measure everything anew",
        )


def set_aside(layout: Layout) -> Path:
    """Keep results that measured something else, with their raw timings, in another folder: they were paid for."""
    number, beside = 1, layout.results.parent
    while (folder := beside / f"{layout.name}.old-{number}").exists():
        number += 1
    timings = folder / layout.timings.relative_to(beside)
    timings.parent.mkdir(parents=True)
    if layout.timings.is_dir():
        os.rename(layout.timings, timings)
    return layout.results.rename(folder / layout.results.name)


def redactor(names: list[str]) -> Callable[[str], str]:
    """Takes the values of these environment variables out of a text."""
    values = {os.environ[name]: f"${name}" for name in names if len(os.environ.get(name, "")) > 3}

    def redact(text: str) -> str:
        for value, name in values.items():
            text = text.replace(value, name)
        return text

    return redact


@contextmanager
def interruptible() -> Iterator[Interrupt]:
    """Ctrl-C and TERM ask first, then insist."""
    interrupt = Interrupt()
    before = {number: signal.signal(number, interrupt) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield interrupt
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
