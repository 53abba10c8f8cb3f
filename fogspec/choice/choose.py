"""The choice for an application: its rule over every admissible offer.

An infeasible problem is an answer too, with the limits that would have to be relaxed (ADR 0005, ADR 0021).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fogspec.catalog.table import Catalog
from fogspec.choice.rule import Rule, Selection
from fogspec.language.schema import Application
from fogspec.model.predict import PredictionSet


@dataclass(frozen=True, kw_only=True)
class Choice(Selection):
    """The rule applied to the offers of a catalog.

    With `by_relaxation` the relaxed method decides by its own model, and `relaxed_row` is the offer that it ends at, None if it
    finds none: the limits must hold for it as for any other.
    """

    offers: Catalog
    by_relaxation: bool = False
    relaxed_row: int | None = None

    @property
    def chosen(self) -> int | None:
        """The row of the chosen offer; None if none meets the limits with the required probability."""
        row = self.relaxed_row if self.by_relaxation else self.best
        return row if row is None or self.confidence is None or self.feasible[row] else None

    @cached_property
    def baseline(self) -> int | None:
        """The machine that people would take without a benchmark; None if none was measured, or it is of the chosen type.

        It is the measured one without a GPU that has the most vCPUs, of these the one of the lowest price.
        """
        offers = self.offers
        rows = np.flatnonzero(self.eligible & self.latency.measured & (offers.gpu == ""))
        if not len(rows):
            return None
        row = int(rows[np.lexsort((rows, offers.price_usd_per_hour[rows], -offers.vcpus[rows]))[0]])
        same = self.chosen is not None and offers.instance[row] == offers.instance[self.chosen]
        return None if same else row


def choose(application: Application, predicted: PredictionSet) -> Choice:
    """Return the choice under the application's limits and objective (the paper, section 2.E, over all offers)."""
    return Choice(
        rule=Rule.of(application, predicted.offers, predicted.busy_ratio, predicted.waiting, predicted.alone),
        latency=predicted.targets["latency"],
        metrics={name: one for name, one in predicted.targets.items() if name != "latency"},
        offers=predicted.offers,
    )
