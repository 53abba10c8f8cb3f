"""The sections of the page: each a table of the paper's figures, ours, and why they differ."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from fogspec.base.units import HOURS_PER_MONTH, dollars, rounded, shown_duration
from fogspec.catalog.cost import Costs
from fogspec.catalog.table import Floats
from fogspec.choice.choose import Choice, choose
from fogspec.choice.relaxed import Relaxed
from fogspec.evaluation.scores import front, staircase_deviation
from fogspec.model.fit import Model, Observation
from fogspec.model.predict import predict_from
from fogspec.numerics import families, relaxation
from fogspec.numerics.families import Fit, fit_all
from fogspec.plan.design import design
from fogspec.plan.schema import Sample
from fogspec.spec.schema import Constraints, Objective, Usage
from tools.paper import published
from tools.paper.cases import Case, cases, own_runs, price_usd_per_hour, snapshot

ALPHAS = (0.0, 0.5, 1.0)
HOUR_S = 3600.0
CENTS = 100.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """A heading, what is compared, a table, charts as (file, text), and what follows from it."""

    title: str
    before: str
    head: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]
    after: str = ""
    charts: tuple[tuple[str, str], ...] = ()


def sections() -> list[Section]:
    """Return every section of the page."""
    return [
        _table_1(),
        _table_2(),
        _reductions(),
        _r2(),
        _prices(),
        _frontiers(),
        _path_length(),
        _choices(),
        _savings(),
        _listing_1(),
        _vacuum(),
    ]


def _samples(case: Case) -> tuple[Sample, ...]:
    return design(case.application.spec, snapshot(), case.admissible).samples


def _cents(usd_per_hour: float) -> float:
    return CENTS * usd_per_hour * published.WINDOW_S / HOUR_S


def _list(values: Sequence[float]) -> str:
    return ", ".join(f"{value:g}" for value in values)


def _percent(fraction: float | None) -> str:
    if fraction is None or not np.isfinite(fraction):
        return "-"
    return f"{CENTS * fraction:,.0f}%" if fraction >= 1 else f"{CENTS * fraction:.3g}%"


def _table_1() -> Section:
    rows = []
    for case in cases():
        machines = [one.machine for one in _samples(case)]
        cpu = [one for one in machines if one.gpu is None]
        vcpus = sorted({one.cpus for one in cpu})
        per_cpu = sorted({one.memory / one.cpus for one in cpu})
        with_gpu = [one.instance for one in machines if one.gpu is not None]
        beside = f"; with a T4: {', '.join(with_gpu)}" if with_gpu else ""
        why = "the table is of CPU machines; the authors' data have the same T4 machines" if with_gpu else "the same"
        rows.append((case.title, published.GRID, f"{_list(vcpus)} vCPUs with {_list(per_cpu)} GiB each{beside}", why))
    return Section(
        title="Table I: the machines to sample",
        before="Minimum, average and maximum vCPUs, each with minimum, average and maximum memory per vCPU (section 2.A).",
        head=("application", "paper", "ours (`compile`)", "why they differ"),
        rows=rows,
    )


def _ours_cents(case: Case, what: str) -> float:
    if what == "sampled":
        return _cents(sum(one.machine.price for one in _samples(case)))
    return _cents(float(case.admissible.offers.price_usd_per_hour.sum()))


def _table_2() -> Section:
    by_title = {case.title: case for case in cases()}
    rows = []
    for cell in published.TABLE_2:
        prices = [price_usd_per_hour(*machine) for machine in cell.machines]
        again = f"{_cents(sum(prices)):.3f}" if prices else "-"
        ours = f"{_ours_cents(by_title[cell.application], cell.what):.3f}"
        rows.append((cell.application, cell.what, f"{cell.cents:.2f}", again, ours, cell.why))
    return Section(
        title="Table II: what a benchmark costs",
        before="US cents, every machine paid for five minutes. *Rederived* is the sum of catalog prices of the machines "
        "that the "
        "paper's figure gives away. *Ours* is what `compile` plans for the spec in this repository, and, as a full sweep, "
        "every machine that the spec admits: the seven sizes of c6i, m6i and r6i, and three T4 machines for Dex-Net.",
        head=("application", "cell", "paper", "rederived", "ours", "why they differ"),
        rows=rows,
    )


def _reductions() -> Section:
    rows = []
    for case in cases():
        sampled, full = (
            next(one.cents for one in published.TABLE_2 if (one.application, one.what) == (case.title, what))
            for what in ("sampled", "full")
        )
        ours = 1 - _ours_cents(case, "sampled") / _ours_cents(case, "full")
        rows.append((case.title, _percent(1 - sampled / full), _percent(ours)))
    return Section(
        title="Table II: the reduction",
        before="How much cheaper the sampled benchmark is than the full sweep.",
        head=("application", "paper (from its cells)", "ours"),
        rows=rows,
        after="Ours is larger because the full sweep is of every machine that the spec admits, the sampled ones among "
        "them. The paper's, as far as prices give it away, is of 16 or 17 machines, and leaves out one that is sampled.",
    )


def _fits(case: Case, gpu: str | None) -> tuple[list[Observation], tuple[Fit, ...]]:
    known = [one for one in case.models.spec.observations if one.machine.gpu_key == gpu]
    vcpus, memory = [one.machine.cpus for one in known], [one.machine.memory for one in known]
    return known, fit_all(vcpus, memory, [one.values["latency"] for one in known])


def _r2() -> Section:
    rows = []
    for case in cases():
        for model in case.models.spec.models:
            known, fits = _fits(case, model.gpu)
            theirs, again = "-", "-"
            if model.gpu is None:
                cpu, memory, r2 = published.THEIR_FAMILIES[case.title]
                same = next(one for one in fits if (one.shape.cpu, one.shape.memory) == (cpu, memory))
                theirs, again = f"{r2:g}", f"{same.r2:.4f}"
            best = families.select(fits, "r2")
            rows.append(
                (
                    f"{case.title}{f', {model.gpu}' if model.gpu else ''}",
                    str(len(known)),
                    theirs,
                    again,
                    f"`{best.shape.formula()}`: {best.r2:.4f}",
                    _percent(best.loo_max),
                    _own(model),
                )
            )
    return Section(
        title="R² of the latency models",
        before="*Their families* is the R² of the authors' samples under the families of the authors' code, and beside "
        "it the same "
        "families fitted here. *The paper's rule* is the largest R² of every pair of its six families (section 2.C): what "
        "`objective.method: relaxed` uses. *Ours* is chosen by the error on left-out samples. Errors are the worst of "
        "predicting each sample from the others.",
        head=("model", "samples", "their families", "again", "the paper's rule", "worst error", "ours"),
        rows=rows,
        after="The two Apartment figures differ because the rule, taken literally over two variables, finds a curve in "
        "memory that "
        "bends around one outlier. Three samples with a T4 determine no curve: [what R² hides](what-r2-hides.md).",
        charts=(("paper-latency.svg", "Latency against vCPUs of the four applications (Figure 3)"),),
    )


def _own(model: Model) -> str:
    return f"`{model.formula}`: worst error {_percent(model.loo_max_error)}"


def _prices() -> Section:
    rows = []
    for case in cases():
        offers = case.admissible.offers
        cpu = np.flatnonzero(offers.gpu == "")
        vcpus, memory, price = (x[cpu] for x in (offers.vcpus, offers.memory_gib, offers.price_usd_per_hour))
        plane = relaxation.price_surface(vcpus, memory, price)(vcpus, memory)
        total = ((price - price.mean()) ** 2).sum()
        r2 = 1 - ((price - plane) ** 2).sum() / total
        rows.append((case.title, f"{r2:.5f}", _percent(float(np.abs(plane / price - 1).max())), "0%"))
    return Section(
        title="The cost model",
        before="Price per hour over 3600 times the seconds of a request (section 2.D). The relaxation needs a price "
        "between machines: "
        "a plane in vCPUs and GiB. The choice uses the exact price.",
        head=("application", "R² of the plane", "off by at most, relaxed", "off by, exhaustive"),
        rows=rows,
        charts=(("paper-cost.svg", "Cost against vCPUs of the four applications (Figure 4)"),),
    )


def _left_out(case: Case) -> tuple[list[Observation], Floats, Floats, Floats]:
    """Return the measured machines, and their latencies as the paper's curve and we predict them, each from the others.

    The first of three arrays is the paper's curve fitted to all samples.
    """
    known = case.models.spec.observations
    fitted, curve, ours = (np.full(len(known), np.nan) for _ in range(3))
    for gpu in {one.machine.gpu_key for one in known}:
        mine, fits = _fits(case, gpu)
        best = families.select(fits, "r2")
        at = [known.index(one) for one in mine]
        truth = np.array([one.values["latency"] for one in mine])
        fitted[at] = best.predict([one.machine.cpus for one in mine], [one.machine.memory for one in mine])
        curve[at] = truth * (1 + np.array(best.loo))
    offers = case.admissible.offers
    for i, one in enumerate(known):
        rest = [other for other in known if other is not one]
        found = predict_from(
            known=rest, unusable=case.models.spec.rejected, offers=offers, targets=["latency"], catalog=snapshot()
        )
        row = int(np.flatnonzero(offers.instance == one.machine.instance)[0])
        ours[i] = found.targets["latency"].value[row]
    return known, fitted, curve, ours


def _frontiers() -> Section:
    rows = []
    for case in cases():
        known, fitted, curve, ours = _left_out(case)
        truth, price = (np.array([f(one) for one in known]) for f in (_latency, _price))
        rows_of = [int(np.flatnonzero(case.admissible.offers.instance == one.machine.instance)[0]) for one in known]
        deviations = [staircase_deviation(one, truth, price) for one in (fitted, case.open.latency.value[rows_of])]
        errors = [float(np.median(np.abs(one / truth - 1))) for one in (curve, ours)]
        names = ", ".join(known[row].machine.instance for row in front(truth, price))
        rows.append((case.title, str(len(known)), names, *(_percent(one) for one in (*deviations, *errors))))
    return Section(
        title="Pareto frontiers, predicted against true",
        before="Latency against price per hour over the machines that the authors measured; the latencies of the others "
        "were never "
        "published. The deviation: how much slower the machine is that is predicted to be the fastest within a budget per "
        "hour, at the worst budget. The paper shows the frontiers of models fitted to the samples themselves, as the "
        "two columns "
        "of deviations do; the last two are the median errors of predicting each machine from the others.",
        head=(
            "application",
            "machines",
            "true frontier",
            "deviation, paper",
            "deviation, ours",
            "left-out error, paper",
            "left-out error, ours",
        ),
        rows=rows,
        charts=(
            ("paper-frontiers.svg", "Latency against price per hour: measured and predicted frontiers (Figure 5)"),
        ),
    )


def _path_length() -> Section:
    rows = [
        (
            run.name,
            machine,
            f"{vcpus:g}",
            f"{shown_duration(rounded(latency_s, 3))}",
            f"{length:.4g} {run.unit}".strip(),
        )
        for run in own_runs()
        for machine, vcpus, latency_s, length in sorted(run.samples, key=lambda one: one[1:])
    ]
    places = ", ".join(dict.fromkeys(run.where for run in own_runs()))
    return Section(
        title="Path length, the third objective",
        before="The paper weighs the length of a motion plan in place of its latency; the lengths that it measured were never "
        "published. "
        + (
            f"These are our own runs, on {places}: not the paper's planner, scenes or machines."
            if rows
            else "Our own runs will be here once results of an application with the metric `path_length` are in "
            "`tests/data/sweeps/`."
        ),
        head=("application", "machine", "vCPUs", "latency", "path length"),
        rows=rows or [("-", "-", "-", "-", "not measured yet")],
        charts=(("paper-path-length.svg", "Latency and path length against vCPUs, from our own runs"),) if rows else (),
    )


def _latency(one: Observation) -> float:
    return one.values["latency"]


def _price(one: Observation) -> float:
    return one.machine.price


def _choices() -> Section:
    return Section(
        title="The choices, with alpha at 0, 0.5 and 1",
        before="Without limits. *Paper* is `method: relaxed`: its own curve, the continuous optimum, the nearest "
        "machines. `alpha` weighs the latency, as in the paper's formula; its prose says the opposite.",
        head=("application", "alpha", "paper: optimum", "paper: machine", "ours", "why they differ"),
        rows=list(_choice_rows()),
    )


def _choice_rows() -> Iterator[tuple[str, ...]]:
    for case in cases():
        for alpha in ALPHAS:
            choice, relaxed = case.with_alpha(alpha)
            if relaxed is None or relaxed.row is None or choice.best is None:
                yield case.title, f"{alpha:g}", "-", "-", "-", "no machine"
                continue
            optimum = f"{relaxed.vcpus:.1f} vCPUs, {relaxed.memory_gib:.1f} GiB"
            yield (
                case.title,
                f"{alpha:g}",
                optimum,
                _machine(choice, relaxed.row, float(relaxed.selection.latency.value[relaxed.row])),
                _machine(choice, choice.best, float(choice.latency.value[choice.best])),
                _why(choice, relaxed),
            )


def _machine(choice: Choice, row: int, latency_s: float) -> str:
    return f"{choice.offers.instance[row]}: {shown_duration(rounded(latency_s, 3))}"


def _why(choice: Choice, relaxed: Relaxed) -> str:
    row, best = relaxed.row, choice.best
    if row is None or best is None:
        return "-"
    if choice.offers.instance[row] == choice.offers.instance[best]:
        return "the same"
    latency_s = float(choice.latency.value[row])
    how = "measured" if choice.latency.measured[row] else "predicted"
    more = float(choice.objective[row] / choice.objective[best] - 1)
    return (
        f"{choice.offers.instance[row]} is {how} at {shown_duration(rounded(latency_s, 3))}: "
        f"its objective is {_percent(more)} larger"
    )


def _savings() -> Section:
    case = next(one for one in cases() if one.title == "Cubicles")
    model = next(one for one in case.models.spec.models if one.gpu is None)
    curve = model.paper or model
    offers = snapshot()
    dearest = price_usd_per_hour(published.DEAREST, published.REGION)

    def latency_s(instance: str) -> float:
        row = int(np.flatnonzero((offers.instance == instance) & (offers.region == published.REGION))[0])
        return float(
            families.predict(curve.shape, list(curve.coefficients.values()), offers.vcpus[row], offers.memory_gib[row])
        )

    slow = latency_s(published.DEAREST)
    rows = []
    for instance, factor in published.SAVINGS:
        price, latency = price_usd_per_hour(instance, published.REGION), latency_s(instance)
        rows.append(
            (
                f"{factor:g}x",
                f"{published.DEAREST_USD_PER_HOUR / price:.2f}x: {dollars(published.DEAREST_USD_PER_HOUR)}/h against "
                f"${price:g}/h, {instance}",
                f"{latency / slow:.1f}x as long: {latency:.1f} s against {slow:.1f} s",
                f"{dearest * slow / (price * latency):.1f}x",
            )
        )
    return Section(
        title="4.95x and 20x",
        before="The savings that the paper names are ratios of prices per hour, on the frontier of Cubicles. It names "
        "r6i.xlarge and $4.99; the other machines are inferred from prices. No machine that was sampled is at $4.99: "
        f"{published.DEAREST} is at ${dearest:g}/h in {published.REGION}. Latencies are of the paper's curve for "
        "these machines.",
        head=("paper", "ours: price per hour", "latency of a plan", "cost per plan"),
        rows=rows,
        after="The ratio mixes two things: the price of an hour falls by the factor, and an hour then serves fewer "
        "plans. A robot that "
        "pays for the seconds of its plans saves the last column.",
    )


def _listing_1() -> Section:
    case = next(one for one in cases() if one.title == "Dex-Net")
    limits = Constraints(latency=published.LISTING_LATENCY_S, cost=published.LISTING_CENTS / CENTS)
    spec = case.application.spec.model_copy(update={"constraints": limits})
    choice = choose(case.application.model_copy(update={"spec": spec}), case.predicted)
    texts = {"latency": "0.01 s", "cost": "0.01 cent per request"}
    rows = [
        (
            texts[one.limit],
            "an example, without its outcome",
            f"infeasible: {one.factor:.3g}x too tight",
            f"{choice.offers.instance[one.row]} is nearest"
            + (" of those that meet the other limit" if one.alone else ""),
        )
        for one in choice.violations
    ]
    return Section(
        title="Listing 1",
        before="The constraints of the launch file in the paper, on its own grasp-planning samples: "
        f"`fogspec menu {case.application.metadata.name} --latency 0.01s --cost '0.01 cent/request'` ends with code "
        "4. The listing says 0.01 cent in a comment, its caption "
        "$0.01; at $0.01 only the latency is out of reach.",
        head=("limit", "paper", "ours", "why they differ"),
        rows=rows,
    )


def _vacuum() -> Section:
    price = price_usd_per_hour(published.VACUUM_MACHINE, published.REGION)
    months = published.VACUUM_YEARS * 12
    rows = []
    for startup_s in (0.0, 300.0):
        usage = Usage(session=published.VACUUM_SESSION, sessions=published.VACUUM_SESSIONS, startup=startup_s)
        objective = Objective(billing="provisioned", rate=published.VACUUM_RATE, usage=usage)
        spec = cases()[0].application.spec.model_copy(update={"objective": objective})
        costs = Costs.of(spec, np.array([price]), np.array([False]))
        month, request = float(costs.usd_per_month[0]), float(costs.per_request(np.array([0.01]))[0])
        started = f"with {shown_duration(startup_s)} of start-up" if startup_s else "without start-up"
        rows.append(
            (
                f"20 minutes a week, {started}",
                dollars(published.VACUUM_USD) if startup_s else "-",
                f"{dollars(month * months)}; ${month:.3f} a month, ${1000 * request:.2g} for 1,000 requests",
                "the paper does not say how it counts; five minutes of start-up a session give its figure"
                if startup_s
                else "only the minutes in use",
            )
        )
    always = price * HOURS_PER_MONTH * months
    rows.append(("never turned off", "-", dollars(always), "what `billing: provisioned` costs without `usage`"))
    return Section(
        title="The vacuum robot of the introduction",
        before=f"A robot that cleans 20 minutes a week for six years, on {published.VACUUM_MACHINE} at ${price:g}/h "
        f"({published.REGION}). `objective: {{billing: provisioned, rate: 10/s, usage: {{session: 20min, sessions: 1/week, "
        "startup: 5min}}`.",
        head=("the machine is up", "paper", "ours", "why they differ"),
        rows=rows,
    )
