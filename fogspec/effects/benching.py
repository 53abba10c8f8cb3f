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
from fogspec.base.outcomes import CloudFailed, Refused
from fogspec.effects import watching
from fogspec.effects.clock import SystemClock
from fogspec.effects.collecting import Rules
from fogspec.effects.journal import Journal
from fogspec.effects.locking import held
from fogspec.effects.preparing import Prepared
from fogspec.effects.recording import ResultsFile
from fogspec.effects.sampling import Campaign, Order
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
    verified gone, KeyboardInterrupt when the user stopped it; results are on disk in every case.
    """
    layout = prepared.layout
    with held(layout.state / "lock", f"a bench of {layout.name}"), interruptible() as interrupt:
        journal = Journal(layout.state / "journal.jsonl")
        try:
            campaign, ledger = _campaign(prepared, runner, journal, interrupt)
            with watch(campaign) as watcher:
                campaign.tell = watcher
                running_on = campaign.recover()
                campaign.run([sample for sample in prepared.todo if sample.id not in running_on])
        finally:
            journal.close()
    if campaign.left:
        raise CloudFailed(
            "these machines could not be verified gone", *campaign.left, f"run the bench of {layout.name} again"
        )
    if interrupt.asked:
        raise KeyboardInterrupt
    return ledger.results()


def _campaign(
    prepared: Prepared, runner: Runner, journal: Journal, interrupt: Interrupt
) -> tuple[Campaign, ResultsFile]:
    layout, body = prepared.layout, prepared.plan.spec
    application = stages.measured_digest(prepared.application)
    ledger = ResultsFile(
        layout, application, prepared.plan_digest, runner.name, runner.source, body.budget,
        [sample.id for sample in body.samples], redactor(prepared.application.spec.secrets),
    )  # fmt: skip
    if prepared.outdated:
        set_aside(layout.results)
    if prepared.results is not None:
        check_same_runner(prepared.results, runner)
        ledger.take(prepared.results)
    journal.begin(runner.name, application, prepared.plan_digest, ledger.spent_usd)
    life = lifetime_s(body.after, body.setup)
    order = Order(
        application=application, plan=prepared.plan_digest, rules=Rules.of(prepared.application), budget_usd=body.budget,
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


def set_aside(results: Path) -> Path:
    """Keep results that measured something else under another name: they were paid for."""
    number = 1
    while (kept := results.with_name(f"{results.stem}.old-{number}.yaml")).exists():
        number += 1
    os.rename(results, kept)
    return kept


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
