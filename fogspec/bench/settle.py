"""The sample past the plan that may settle whether a machine meets the limits."""

from fogspec.bench.prepare import Prepared
from fogspec.catalog.filters import offers_for
from fogspec.choice.next_samples import DECIDES
from fogspec.compile.decision import outlook_after, select
from fogspec.compile.inputs import Inputs
from fogspec.language.lockfile import pinned
from fogspec.plan.reuse import selects_more
from fogspec.plan.schema import next_on


def settling(prepared: Prepared, inputs: Inputs) -> Prepared:
    """Return what measures the one sample that may let a machine qualify, once all of the plan is measured; else the same."""
    results, plan = prepared.results, prepared.plan
    if results is None or prepared.todo or prepared.only or inputs.refused is not None or inputs.unread is not None:
        return prepared
    if selects_more(prepared.application, plan.spec.sampler, results.spec.sampling):
        return prepared
    application = pinned(prepared.application, inputs.pins)
    offers = offers_for(inputs.catalog, application.spec)
    found = select(inputs, application, offers, results)
    one = outlook_after(application, found, results, plan)
    if one is None or one.cause != "one sample":
        return prepared
    sample = next_on(found.choice.offers.machine(one.row), DECIDES, results.spec.machines)
    return prepared.measuring(sample, inputs)
