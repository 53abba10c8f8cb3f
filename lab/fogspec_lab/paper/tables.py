"""The sections of the page: each a table of the paper's figures, ours, and why they differ."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from fogspec.base.units import HOURS_PER_MONTH, dollars, rounded, shown_duration
from fogspec.catalog.cost import Costs
from fogspec.catalog.table import Floats
from fogspec.choice.choose import Choice, choose
from fogspec.choice.relaxed import Relaxed
from fogspec.language.schema import Constraints, Deployment, Load, Objective
from fogspec.model.fit import Observation
from fogspec.model.predict import predict_from
from fogspec.numerics import families, relaxation
from fogspec.numerics.families import Fit, fit_all
from fogspec.numerics.pareto import pareto
from fogspec.plan.design import design
from fogspec.plan.schema import Sample
from fogspec_lab.paper.cases import Case, cases, own_runs, price_usd_per_hour, snapshot
from fogspec_lab.paper.claims import APPLICATIONS, REGION, Claim, claims, inferred

ALPHAS = (0.0, 0.5, 1.0)
MINUTES_PER_HOUR = 60.0
CENTS = 100.0
HALF_A_CENT = 0.005
WEEK_S = 7 * 86400.0
VSLAM_REGION = "us-west-1"  # where the machine of vSLAM has the paper's price
VACUUM_RATE = 10.0  # requests per second, ours: the paper names none


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
        _r2(),
        _prices(),
        _frontiers(),
        _path_length(),
        _choices(),
        _said(),
        _listing_1(),
        _vacuum(),
    ]


def _paper(*names: str) -> str:
    """Return the cell of the paper's figures of these names."""
    return "; ".join(claims()[name].shown for name in names)


def _samples(case: Case) -> tuple[Sample, ...]:
    return design(case.application.spec, snapshot(), case.admissible).samples


def _cents(usd_per_hour: float) -> float:
    return CENTS * usd_per_hour * float(claims()["window"].values["minutes"]) / MINUTES_PER_HOUR


def _percent(fraction: float | None) -> str:
    if fraction is None or not np.isfinite(fraction):
        return "-"
    return f"{CENTS * fraction:,.0f}%" if fraction >= 1 else f"{CENTS * fraction:.3g}%"


def _table_1() -> Section:
    titles: dict[tuple[str, str, str], list[str]] = {}
    for case in cases():
        machines = [one.machine for one in _samples(case)]
        cpu = [one for one in machines if one.gpu is None]
        counts = ({one.cpus for one in cpu}, {one.memory / one.cpus for one in cpu})
        vcpus, per_cpu = (", ".join(f"{value:g}" for value in sorted(some)) for some in counts)
        with_gpu = [one.instance for one in machines if one.gpu is not None]
        beside = f"; with a T4: {', '.join(with_gpu)}" if with_gpu else ""
        why = "the authors' data have the same T4 machines" if with_gpu else SAME
        ours = f"{vcpus} vCPUs with {per_cpu} GiB each{beside}"
        titles.setdefault((_paper("grid.2", "grid.16", "grid.64"), ours, why), []).append(case.title)
    return Section(
        title="Table I: the machines to sample",
        before="Minimum, average and maximum vCPUs, each with minimum, average and maximum memory (step 2.A).",
        head=("application", "paper", "ours (`compile`)", "why they differ"),
        rows=[(", ".join(of), *cells) for cells, of in titles.items()],
    )


def _ours_cents(case: Case, what: str) -> float:
    if what == "sampled":
        return _cents(sum(one.machine.price for one in _samples(case)))
    return _cents(float(case.admissible.offers.price_usd_per_hour.sum()))


SAME = "same"
UNKNOWN = "machines not published; several lists fit"
WHY = {
    ("sampled", "SLAM"): "c4.large ($0.10/h) for r6i.large ($0.126/h); rounded down",
    ("sampled", "Dex-Net"): "two T4 machines at us-west-1 prices; compile plans three in us-east-1",
    ("sampled", "Cubicles"): "without r6i.large, whose latency is not published",
    ("sampled", "Apartment"): SAME,
    ("full", "SLAM"): UNKNOWN,
    ("full", "Dex-Net"): UNKNOWN,
    ("full", "Cubicles"): "one list of c6i, m6i, r6i",
    ("full", "Apartment"): "one such list",
}


def _rederived(claim: Claim) -> str:
    """Return the cents of the machines behind a cell of Table II at catalog prices, and how sure the machines are."""
    usd = [price_usd_per_hour(name, region) for region, names in claim.machines.items() for name in names]
    return f"{_cents(sum(usd)):.3f}{claim.mark}" if usd else "-"


def _table_2() -> Section:
    by_title = {case.title: case for case in cases()}
    rows = []
    for what, title in ((what, title) for what in ("sampled", "full") for title in APPLICATIONS):
        claim = claims()[f"{what}.{title}"]
        ours = f"{_ours_cents(by_title[title], what):.3f}"
        rows.append((title, what, claim.shown, _rederived(claim), ours, WHY[what, title]))
    for case in cases():
        factor, why = _ours_cents(case, "full") / _ours_cents(case, "sampled"), "more machines swept"
        rows.append((case.title, "reduction", _paper(f"reduction.{case.title}"), "-", f"{factor:.2f}x", why))
    return Section(
        title="Table II: what a benchmark costs",
        before="US cents, and how much cheaper the samples are. *Rederived* is the sum of catalog prices of "
        f"{_paper('window')} on the machines that the figure gives away. *Ours* is what `compile` plans for the spec "
        "in this repository, and, as a full sweep, every machine that the spec admits: the seven sizes of c6i, m6i and r6i, "
        "and three T4 machines for Dex-Net.",
        head=("application", "cell", "paper", "rederived", "ours", "why they differ"),
        rows=rows,
    )


def _fits(case: Case, gpu: str | None) -> tuple[list[Observation], tuple[Fit, ...]]:
    known = [one for one in case.models.observations if one.machine.gpu_key == gpu]
    vcpus, memory = [one.machine.cpus for one in known], [one.machine.memory for one in known]
    return known, fit_all(vcpus, memory, [one.values["latency"] for one in known])


def _r2() -> Section:
    rows = []
    for case in cases():
        for model in case.models.curves:
            known, fits = _fits(case, model.gpu)
            best, name = families.select(fits, "r2"), f"{case.title}{f', {model.gpu}' if model.gpu else ''}"
            rule = f"`{best.shape.formula()}`: {best.r2:.4f}"
            ours = f"`{model.formula}`: worst error {_percent(model.loo_max_error)}"
            rows.append((name, str(len(known)), rule, _percent(best.loo_max), ours))
    return Section(
        title="R² of the latency models",
        before="*The paper's rule* is the largest R² of every pair of its six families (step 2.C): what `objective.method: "
        "relaxed` uses. *Ours* is chosen by the leave-one-out error. Errors are the worst of predicting each sample "
        "from the others.",
        head=("model", "samples", "the paper's rule", "worst error", "ours"),
        rows=rows,
        after="In Apartment the rule, taken literally over two variables, finds a curve in memory that bends around one "
        "outlier. Three samples with a T4 determine no curve: [what R² hides](uncertainty.md#what-r2-hides).",
        charts=(("paper-latency.svg", "Latency against vCPUs of the four applications"),),
    )


def _prices() -> Section:
    offers = cases()[0].admissible.offers
    cpu = np.flatnonzero(offers.gpu == "")
    vcpus, memory, price = (x[cpu] for x in (offers.vcpus, offers.memory_gib, offers.price_usd_per_hour))
    plane = relaxation.price_surface(vcpus, memory, price)(vcpus, memory)
    r2 = 1 - ((price - plane) ** 2).sum() / ((price - price.mean()) ** 2).sum()
    return Section(
        title="The cost model",
        before="Price per hour over 3600 times the seconds of a request (step 2.D). The relaxation needs a price between "
        "machines: a plane in vCPUs and GiB. The choice uses the exact price.",
        head=("machines", "R² of the plane", "off by at most, relaxed"),
        rows=[("c6i, m6i, r6i", f"{r2:.5f}", _percent(float(np.abs(plane / price - 1).max())))],
    )


def _left_out(case: Case) -> tuple[list[Observation], Floats, Floats]:
    """Return the measured machines, and their latencies as the paper's curve and we predict them, each from the others."""
    known = list(case.models.observations)
    curve, ours = (np.full(len(known), np.nan) for _ in range(2))
    for gpu in {one.machine.gpu_key for one in known}:
        mine, fits = _fits(case, gpu)
        best = families.select(fits, "r2")
        at = [known.index(one) for one in mine]
        truth = np.array([one.values["latency"] for one in mine])
        curve[at] = truth * (1 + np.array(best.loo))
    offers = case.admissible.offers
    for i, one in enumerate(known):
        rest = [other for other in known if other is not one]
        found = predict_from(
            known=rest, unusable=case.models.rejected, offers=offers, targets=["latency"], catalog=snapshot()
        )
        row = int(np.flatnonzero(offers.instance == one.machine.instance)[0])
        ours[i] = found.targets["latency"].value[row]
    return known, curve, ours


def _frontiers() -> Section:
    rows = []
    for case in cases():
        known, *predicted = _left_out(case)
        truth, price = np.array([(one.values["latency"], one.machine.price) for one in known]).T
        errors = [_percent(float(np.median(np.abs(one / truth - 1)))) for one in predicted]
        names = ", ".join(known[row].machine.instance for row in pareto(price, truth))
        rows.append((case.title, str(len(known)), names, *errors))
    return Section(
        title="Pareto frontiers, and leave-one-out errors of predictions",
        before="Latency against price per hour over the machines that the authors measured, and the median error of predicting "
        "each of them from the others, by the curve of the paper's rule and by ours. The frontiers in the paper's Figures 3 "
        "to 5 are not published as numbers.",
        head=("application", "machines", "true frontier", "error, paper's rule", "error, ours"),
        rows=rows,
        charts=(("paper-frontiers.svg", "Latency against price per hour: measured and predicted frontiers"),),
    )


def _path_length() -> Section:
    rows = [
        (run.name, machine, f"{vcpus:g}", shown_duration(rounded(latency_s, 3)), f"{length:.4g} {run.unit}".strip())
        for run in own_runs()
        for machine, vcpus, latency_s, length in sorted(run.samples, key=lambda one: one[1:])
    ]
    places = ", ".join(dict.fromkeys(run.where for run in own_runs()))
    return Section(
        title="Path length, the third objective",
        before="The paper optimizes the length of a motion plan against cost too; its lengths are not published as numbers. "
        f"These are our own runs, on {places}: not the paper's planner, scenes or machines.",
        head=("application", "machine", "vCPUs", "latency", "path length"),
        rows=rows,
        charts=(("paper-path-length.svg", "Latency and path length against vCPUs, from our own runs"),),
    )


def _choices() -> Section:
    return Section(
        title="The choices, with alpha at 0, 0.5 and 1",
        before="Without limits. `method: relaxed` follows the paper: the curve by its rule, the continuous optimum, the "
        "nearest machines. `alpha` weighs the latency, as in the paper's formula; its text has it the other way: "
        f"{_paper('alpha')}.",
        head=("application", "alpha", "relaxed: optimum", "relaxed: machine", "ours", "why they differ"),
        rows=list(_choice_rows()),
    )


def _choice_rows() -> Iterator[tuple[str, ...]]:
    for case in cases():
        alphas: dict[tuple[str, ...], list[str]] = {}
        for alpha in ALPHAS:
            alphas.setdefault(_choice_cells(*case.with_alpha(alpha)), []).append(f"{alpha:g}")
        for cells, same in alphas.items():
            yield case.title, ", ".join(same), *cells


def _choice_cells(choice: Choice, relaxed: Relaxed | None) -> tuple[str, ...]:
    if relaxed is None or relaxed.row is None or choice.best is None:
        return "-", "-", "-", "no machine"
    return (
        f"{relaxed.vcpus:.1f} vCPUs, {relaxed.memory_gib:.1f} GiB",
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
        return SAME
    latency_s = float(choice.latency.value[row])
    how = "measured" if choice.latency.measured[row] else "predicted"
    more = float(choice.objective[row] / choice.objective[best] - 1)
    return f"{choice.offers.instance[row]} {how} {shown_duration(rounded(latency_s, 3))}: objective {_percent(more)} larger"


def _said() -> Section:
    """Return the figures of the paper's text that are in no table of it."""
    by_title = {case.title: case for case in cases()}
    r2 = {
        (case.title, model.gpu): f"{families.select(_fits(case, model.gpu)[1], 'r2').r2:.4f}"
        for case in cases()
        for model in case.models.curves
    }
    selected = {title: ", ".join(_selected(by_title[title])) for title in ("SLAM", "Dex-Net")}
    unpublished = "not published as numbers"
    machine = claims()["saving.SLAM"].values["machine"]
    vslam = price_usd_per_hour(machine, VSLAM_REGION)
    return Section(
        title="Figures in the text",
        before="*Selected* are the machines at alpha 0, 0.5 and 1, without limits.",
        head=("what", "paper", "ours", "why they differ"),
        rows=[
            ("options on offer", _paper("options"), f"{len(snapshot()):,}", "AWS on demand only"),
            ("R² of SLAM", _paper("r2.SLAM"), r2["SLAM", None], "no T4 samples are published"),
            ("R² of Dex-Net", _paper("r2.Dex-Net"), f"{r2['Dex-Net', 'T4:1']}, {r2['Dex-Net', None]}",
             "three T4 samples determine no curve"),
            ("frontiers of SLAM differ by", _paper("frontier.SLAM"), "-", unpublished),
            ("frontiers of Dex-Net differ by", _paper("frontier.Dex-Net"), "-", unpublished),
            ("selected for SLAM", _paper("selected.SLAM"), selected["SLAM"], "the sizes are not named"),
            ("selected for Dex-Net", _paper("selected.Dex-Net"), selected["Dex-Net"],
             "the cheapest T4 machine is the fastest"),
            ("saving of SLAM", _paper("saving.SLAM", "price.SLAM"), f"{machine} is at ${vslam:g}/h in {VSLAM_REGION}",
             "machine not named; c4.8xlarge not sampled"),
            ("saving of motion planning", _paper("saving.planning"), *_saving(by_title["Cubicles"])),
        ],
    )  # fmt: skip


def _selected(case: Case) -> list[str]:
    choices = (case.with_alpha(alpha)[0] for alpha in ALPHAS)
    return list(dict.fromkeys(str(one.offers.instance[one.best]) for one in choices if one.best is not None))


def _saving(case: Case) -> tuple[str, str]:
    """Return what the paper's curve predicts of the machine at the cheaper price, and where it comes from."""
    model = next(one for one in case.models.curves if one.gpu is None)
    curve, offers = model.paper or model, case.admissible.offers
    paper = claims()["saving.planning"].values
    row = int(np.argmin(np.abs(offers.price_usd_per_hour - paper["cheaper_usd_per_hour"])))
    price, at = float(offers.price_usd_per_hour[row]), (offers.vcpus[row], offers.memory_gib[row])
    latency_s = float(families.predict(curve.shape, list(curve.coefficients.values()), *at))
    every = snapshot()
    same = (np.abs(every.price_usd_per_hour - paper["cheaper_usd_per_hour"]) < HALF_A_CENT) & (every.region == REGION)
    among = inferred(len(set(every.instance[same & ~every.spot])))
    return (
        f"{paper['usd_per_hour'] / price:.1f}x: {latency_s:.1f} s at ${price:g}/h",
        f"{offers.instance[row]}, from its price {among}; by the paper's curve of {case.title}",
    )


def _listing_1() -> Section:
    case = next(one for one in cases() if one.title == "Dex-Net")
    latency_s, cents = claims()["limit.latency"].values["latency_s"], claims()["limit.cost"].values["cents"]
    limits = Constraints(latency=latency_s, cost=cents / CENTS)
    spec = case.application.spec.model_copy(update={"constraints": limits})
    choice = choose(case.application.model_copy(update={"spec": spec}), case.predicted)
    rows = [
        (
            one.limit,
            _paper(f"limit.{one.limit}"),
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
        "4. The paper gives no outcome. The listing says 0.01 cent in a comment, its caption "
        f"{_paper('limit.caption')}; with the latter, only the latency is out of reach.",
        head=("limit", "paper", "ours", "why they differ"),
        rows=rows,
    )


def _vacuum() -> Section:
    paper = claims()["vacuum"].values
    price, months = price_usd_per_hour(paper["machine"], REGION), paper["years"] * 12
    load = Load(rate=VACUUM_RATE, session=paper["minutes"] * 60, sessions=1 / WEEK_S)
    rows = []
    for startup_s in (0.0, 300.0):
        spec = cases()[0].application.spec
        hardware = spec.hardware.model_copy(update={"startup": startup_s})
        spec = spec.model_copy(
            update={"objective": Objective(load=load), "hardware": hardware, "deployment": Deployment(until="20min")}
        )
        costs = Costs.of(spec, np.array([price]), np.array([False]))
        month, request = price * HOURS_PER_MONTH * costs.up, float(costs.per_request(np.array([0.01]))[0])
        started = f"with {shown_duration(startup_s)} of start-up" if startup_s else "without start-up"
        rows.append(
            (
                f"20 minutes a week, {started}",
                _paper("vacuum") if startup_s else "-",
                f"{dollars(month * months)}; ${month:.3f} a month, ${1000 * request:.2g} for 1,000 requests",
                "the paper does not say how it counts; five minutes of start-up a session give its figure"
                if startup_s
                else "only the minutes in use",
            )
        )
    always = price * HOURS_PER_MONTH * months
    rows.append(("never turned off", "-", dollars(always), "what `load` costs without sessions"))
    return Section(
        title="The vacuum robot of the introduction",
        before=f"A robot that cleans 20 minutes a week for six years, on {paper['machine']} at ${price:g}/h "
        f"({REGION}). `load: {{rate: 10/s, session: 20min, sessions: 1/week}}`, `startup: 5min`, `until: 20min`.",
        head=("the machine is up", "paper", "ours", "why they differ"),
        rows=rows,
    )
