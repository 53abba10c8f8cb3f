"""What an adaptive benchmark will cost and save, before anything is measured: campaigns on programs drawn from the model."""

from dataclasses import dataclass, replace

import numpy as np

from fogspec.base.units import REQUESTS_SHOWN, REQUESTS_TEXT, dollars, money, rounded
from fogspec.catalog.instance_types import instance_types
from fogspec.catalog.table import Catalog, Floats
from fogspec.choice.rule import Rule, Scale, Selection
from fogspec.model.predict import Predictions
from fogspec.numerics.acquisition import Policy, propose_batch
from fogspec.numerics.observations import TYPICAL_NOISE, observations
from fogspec.numerics.priors import PriorData, prior_for
from fogspec.numerics.surrogate import Space, prepare
from fogspec.spec.schema import Application, Volume

PROGRAMS = 8  # that are benchmarked
GUESSED = 60  # that are drawn, to tell which machine is best unmeasured
MOST_SAMPLES = 30
MOST_TYPES = 80  # instance types that they run on, evenly from the list: more would take long and say the same


@dataclass(frozen=True, slots=True)
class Payoff:
    """Medians over the drawn programs in USD: the price of the samples, and what the choice after them saves.

    It saves against the machine that would be chosen unmeasured, over the volume, if the cheapest machine's request costs
    `usd_per_request`. Latency counts as the objective weighs it against money.
    """

    volume: Volume
    usd_per_request: float
    spends_usd: float
    saves_usd: float

    def line(self) -> str:
        """Return it as one sentence."""
        months = f"{self.volume.months:g} month" + ("" if self.volume.months == 1 else "s")
        cost = f"{REQUESTS_TEXT} cost {money(REQUESTS_SHOWN * self.usd_per_request)}"
        return (
            f"spends {_about(self.spends_usd)} to save an expected {_about(self.saves_usd)} over {months} of "
            f"{self.volume.requests_per_month:,.0f} requests (median of {PROGRAMS} programs drawn from the model, if "
            f"{cost} on the cheapest machine, with latency as alpha weighs it)"
        )


def expected_payoff(
    application: Application, offers: Catalog, usd_per_sample: Floats, library: PriorData | None = None
) -> Payoff | None:
    """Return what the benchmark of a spec is expected to spend and save; None without a volume.

    `usd_per_sample` (n,) is the price of a sample of each offer. Before anything is measured it is unknown what a request
    costs: it is taken as what the spec counts as 1, its scale or limit of cost; None without either, where requests are billed
    by their time. Limits are left out, for the same reason.
    """
    spec = application.spec
    level = spec.objective.scale.cost or spec.constraints.cost
    by_time = spec.objective.billing == "busy"
    if spec.benchmark.volume is None or spec.objective.alpha == 1 or not len(offers) or (by_time and level is None):
        return None
    types = instance_types(offers)
    rows = types.offer[np.unique(np.linspace(0, len(types) - 1, MOST_TYPES).round().astype(int))]
    some = offers.take(rows)
    types = instance_types(some)
    prior = None if library is None else prior_for(library, types.names, types.machines)
    space = prepare(types.machines, prior)
    rule = replace(
        Rule.of(application, some.take(types.offer)),
        metric=None,
        max_latency_s=None,
        max_cost_usd=None,
        max_metrics={},
        measured_first=False,
    )
    return _simulated(spec.benchmark.volume, rule, space, usd_per_sample[rows][types.offer], level if by_time else None)


def _simulated(volume: Volume, rule: Rule, space: Space, usd: Floats, level: float | None) -> Payoff:
    latency_s = np.exp(space.fit(observations([], [])).draws)
    latency_s = latency_s[np.linspace(0, len(latency_s) - 1, GUESSED).round().astype(int)]
    if level is not None:
        latency_s *= (level / rule.costs.per_request(latency_s).min(axis=1))[:, None]
    rules = [_scaled(rule, one) for one in latency_s]
    usd_per_request = np.array([_usd_per_request(*both) for both in zip(rules, latency_s, strict=True)])
    unmeasured = int(np.argmin(np.log(usd_per_request).mean(axis=0)))
    random = np.random.default_rng(0)
    spent, saved = np.empty((2, PROGRAMS))
    for i in range(PROGRAMS):
        noise = np.exp(TYPICAL_NOISE * random.standard_normal((Policy().each, len(usd))))
        chosen, spent[i] = _campaign(volume.requests, rules[i], space, usd, latency_s[i] * noise)
        saved[i] = volume.requests * (usd_per_request[i, unmeasured] - usd_per_request[i, chosen])
    cheapest = rules[0].cost_scale or 0.0
    return Payoff(volume, cheapest, float(np.median(spent)), float(np.median(saved)))


def _scaled(rule: Rule, latency_s: Floats) -> Rule:
    """Return the rule with the best attainable latency and cost of a program as scales."""
    return replace(rule, metric_scale=float(latency_s.min()), cost_scale=float(rule.costs.per_request(latency_s).min()))


def _usd_per_request(rule: Rule, latency_s: Floats) -> Floats:
    """Return the objective of every machine (N,) in USD for a request."""
    scale = Scale(rule.metric_scale or 1.0, rule.cost_scale or 1.0)
    return rule.value(latency_s, scale) * scale.cost / (1 - rule.alpha)


def _campaign(requests: float, rule: Rule, space: Space, usd: Floats, latency_s: Floats) -> tuple[int, float]:
    """Return the choice and the price of a campaign on a program whose samples (repeats, N) are these."""
    at: list[int] = []
    while True:
        posterior = space.fit(observations(at, [float(latency_s[at[:i].count(one), one]) for i, one in enumerate(at)]))
        selection = Selection(rule=rule, latency=Predictions.of_posterior(posterior))
        policy = Policy(first=1, worth=requests * (selection.usd_per_request() or 0.0), most_with_worth=MOST_SAMPLES)
        batch = propose_batch(posterior, selection.utility(), sample_cost=usd, policy=policy)
        if not batch.machines:
            return int(np.argmin(selection.objective)), float(usd[at].sum())
        at += batch.machines


def _about(usd: float) -> str:
    """Return an estimate of money with two digits."""
    usd = rounded(max(usd, 0.0), 2)
    return f"${usd:,.0f}" if usd >= 10 else dollars(usd)
