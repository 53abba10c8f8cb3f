"""The choice for an application: its rule over every admissible offer.

An infeasible problem is an answer too, with the limits that would have to be relaxed (ADR 0005, ADR 0021).
"""

from dataclasses import dataclass
from functools import cached_property

from fogspec.catalog.table import Catalog
from fogspec.choice.rule import Rule, Selection
from fogspec.model.predict import PredictionSet
from fogspec.spec.schema import Application


@dataclass(frozen=True, kw_only=True)
class Choice(Selection):
    """The rule applied to the offers of a catalog.

    With `by_relaxation` the relaxed method decides by its own model, and `relaxed_row` is the offer that it ends at, None if it
    finds none: what `feasible` says of that offer may differ.
    """

    offers: Catalog
    by_relaxation: bool = False
    relaxed_row: int | None = None

    @property
    def chosen(self) -> int | None:
        """The row of the chosen offer; None if no offer meets the limits."""
        return self.relaxed_row if self.by_relaxation else self.best

    @cached_property
    def meets_confidence(self) -> bool:
        """True if the chosen offer meets the limits with the required confidence."""
        return self.chosen is not None and bool(self.feasible[self.chosen]) and self.level == self.confidence


def choose(application: Application, predicted: PredictionSet) -> Choice:
    """Return the choice under the application's limits and objective (the paper, section 2.E, over all offers)."""
    return Choice(
        rule=Rule.of(application, predicted.offers),
        latency=predicted.targets["latency"],
        metrics={name: one for name, one in predicted.targets.items() if name != "latency"},
        offers=predicted.offers,
    )
