"""Whether a plan was carried out: what of it is still to be measured."""

from dataclasses import dataclass

from fogspec.plan.reuse import covers
from fogspec.plan.schema import Plan
from fogspec.results.schema import Results, completed
from fogspec.spec.schema import Application

NAMED = 6


@dataclass(frozen=True, slots=True)
class Unfinished:
    """A plan that was not carried out: how many of its samples are measured, and the ids of those that are not."""

    measured: int
    planned: int
    missing: tuple[str, ...]
    why: str

    @property
    def state(self) -> str:
        """Return how much of the plan was measured, for people."""
        return state_text(self.measured, self.planned)

    @property
    def warning(self) -> str:
        """Return what a reviewer should know of a choice that was made before the plan was carried out."""
        return f"partial: {self.state}; {self.why}"


def state_text(measured: int, planned: int) -> str:
    """Return how much of a plan that was not carried out was measured, for people."""
    if measured < planned:
        return f"{measured} of {planned} planned samples are measured"
    return f"sampling did not end after {planned} samples"


def unfinished(application: Application, plan: Plan, results: Results) -> Unfinished | None:
    """Return what is left of a plan, None if it was carried out.

    A sample that failed for good is done. Adaptive sampling ends when no further machine is requested.
    """
    samples = {sample.id for sample in plan.spec.samples}
    left = sorted(samples - completed(results))
    sampling = results.spec.sampling if plan.spec.sampler == "adaptive" else None
    if left:
        more = ", ..." if len(left) > NAMED else ""
        why = f"to measure: {', '.join(left[:NAMED])}{more}"
    elif sampling is not None and sampling.stop_reason is None:
        why = "the next machines are not selected yet"
    elif sampling is not None and not covers(application, sampling):
        why = "the candidates have changed since machines were selected"
    else:
        return None
    return Unfinished(len(samples) - len(left), len(samples), tuple(left), why)
