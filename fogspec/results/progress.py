"""Whether a plan was carried out: what of it is still to be measured."""

from dataclasses import dataclass

from fogspec.language.schema import Application
from fogspec.language.warned import Warned, partial, warned
from fogspec.plan.reuse import covers
from fogspec.plan.schema import Plan
from fogspec.results.schema import Results, completed


@dataclass(frozen=True, slots=True)
class Unfinished:
    """A plan that was not carried out: how many of its samples are measured, and the ids of those that are not."""

    measured: int
    planned: int
    missing: tuple[str, ...]
    candidates_changed: bool

    @property
    def state(self) -> str:
        """Return how much of the plan was measured, for people."""
        if self.measured < self.planned:
            return f"{self.measured} of {self.planned} planned samples are measured"
        return f"sampling did not end after {self.planned} samples"

    @property
    def warning(self) -> Warned:
        """Return the warning about a choice that was made before the plan was carried out."""
        return warned(
            partial,
            measured=self.measured,
            planned=self.planned,
            missing=list(self.missing),
            candidates_changed=self.candidates_changed,
        )


def unfinished(application: Application, plan: Plan, results: Results) -> Unfinished | None:
    """Return what is left of a plan, None if it was carried out.

    A sample that failed for good is done. Adaptive sampling ends when no further machine is requested.
    """
    samples = {sample.id for sample in plan.spec.samples}
    left = sorted(samples - completed(results))
    sampling = results.spec.sampling if plan.spec.sampler == "adaptive" else None
    ended = sampling is None or sampling.stop_reason is not None
    changed = not left and ended and sampling is not None and not covers(application, sampling)
    if ended and not left and not changed:
        return None
    return Unfinished(len(samples) - len(left), len(samples), tuple(left), changed)
