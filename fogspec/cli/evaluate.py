"""Implement `fogspec evaluate`: replay sampling and choosing against full measurements."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fogspec.base.console import columns, say, say_json
from fogspec.base.errors import UsageError
from fogspec.base.text import blocks
from fogspec.cli.options import CATALOG, OUTPUT, applications_of

if TYPE_CHECKING:
    from fogspec.evaluation.campaign import Campaign

SAMPLERS = ("adaptive", "nested", "grid", "random", "cherrypick", "full", "best")
METHODS = ("model", "verified", "r2", "paper", "measured")
ROWS = (
    ("paper: grid, best R², relaxed", "grid", "paper"),
    ("grid, best R², exact price", "grid", "r2"),
    ("grid, ours", "grid", None),
    ("random 9, ours", "random", None),
    ("CherryPick-like", "cherrypick", None),
    ("adaptive", "adaptive", None),
    ("adaptive, nested shapes", "nested", None),
    ("full sweep, ours", "full", "verified"),
    ("full sweep, measured values", "full", None),
    ("the best machine alone", "best", None),
)
ALIASES = {"ours": None}


@click.command()
@click.argument("spec", required=False, type=click.Path(path_type=str))
@click.option(
    "--sweep",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="full measurements of SPEC: a CSV file, or results of bench (.yaml)",
)
@click.option("--suite", type=click.Path(path_type=Path), metavar="DIR", help="machines, latencies and problems")
@click.option("--priors", type=click.Path(path_type=Path), metavar="DIR|FILE", help="machine library  [default: none]")
@click.option("--kind", "kinds", multiple=True, metavar="KIND", help="only problems of this kind; repeatable")
@click.option(
    "--sampler", type=click.Choice(SAMPLERS), default="adaptive", show_default=True, help="how samples are chosen"
)
@click.option(
    "--method",
    type=click.Choice([*ALIASES, *METHODS]),
    help="how samples are read; ours: the sampler's own  [default: ours]",
)
@click.option(
    "--noise",
    type=click.Choice(["realistic", "none"]),
    default="realistic",
    show_default=True,
    help="noise of each measurement",
)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="seed of the random numbers")
@click.option("--choices", type=click.Path(path_type=Path), metavar="FILE", help="file for a line per choice")
@click.option(
    "--chart", type=click.Path(path_type=Path), metavar="FILE", help="file for a chart of the --sweep, as SVG"
)
@click.option("--all", "every", is_flag=True, help="print a table of every sampler and method")
@click.option("--volumes", is_flag=True, help="print the total cost of benchmark and regret, for volumes of requests")
@click.option("--workers", type=click.IntRange(1, 64), default=2, show_default=True, help="processes")
@CATALOG
@OUTPUT
def command(
    spec: str | None,
    sweep: Path | None,
    suite: Path | None,
    priors: Path | None,
    kinds: tuple[str, ...],
    sampler: str,
    method: str | None,
    noise: str,
    seed: int,
    choices: Path | None,
    chart: Path | None,
    every: bool,
    volumes: bool,
    workers: int,
    catalog_path: str | None,
    output: str,
) -> None:
    """Score choices from few samples, where every machine was measured.

    Either SPEC with its --sweep, or a --suite of problems.
    """
    from fogspec.evaluation.campaign import Campaign

    campaign = Campaign(sampler, ALIASES.get(method, method) if method else None, noise, seed)
    campaigns = [(name, Campaign(s, m, noise, seed)) for name, s, m in ROWS] if every else [("", campaign)]
    if spec and sweep and not (suite or volumes or kinds or choices):
        _of_sweep(
            spec=spec,
            sweep=sweep,
            catalog_path=catalog_path,
            priors=priors,
            campaigns=campaigns,
            chart=chart,
            output=output,
        )
    elif suite and volumes and not (spec or sweep or every or chart):
        _of_volumes(suite=suite, priors=priors, kinds=kinds, campaign=campaign, workers=workers, output=output)
    elif suite and not (spec or sweep or volumes or chart):
        _of_suite(
            suite=suite,
            priors=priors,
            kinds=kinds,
            campaigns=[one for _, one in campaigns],
            choices=choices,
            workers=workers,
            output=output,
        )
    else:
        raise UsageError(
            "evaluate needs SPEC --sweep FILE, or --suite DIR",
            "fogspec evaluate specs/NAME.yaml --sweep sweep.csv",
            "fogspec evaluate --suite DIR --priors DIR -o json",
        )


def _of_suite(
    suite: Path,
    priors: Path | None,
    kinds: tuple[str, ...],
    campaigns: "list[Campaign]",
    choices: Path | None,
    workers: int,
    output: str,
) -> None:
    from fogspec.base.project_files import write_output
    from fogspec.evaluation.campaign import by_kind, evaluate

    _check_kinds(kinds)
    done, digest = evaluate(suite, priors, kinds, campaigns, workers=workers)
    if choices:
        lines = [json.dumps(one.as_dict(), ensure_ascii=False) + "\n" for ended in done for one in ended]
        write_output(choices, "".join(lines).encode())
    reports = []
    for campaign, ended in zip(campaigns, done, strict=True):
        rows, calibrations = by_kind(ended)
        reports.append({**_about(campaign, digest), "by_kind": rows, "calibration": calibrations})
    if output == "json":
        say_json(reports[0] if len(reports) == 1 else reports)
        return
    titles = [name for name, _, _ in ROWS] if len(reports) > 1 else [""]
    texts = [row_texts(title, row) for title, one in zip(titles, reports, strict=True) for row in one["by_kind"]]
    say(*blocks([HEAD, *texts], columns(), keys=2))


def _of_volumes(
    suite: Path, priors: Path | None, kinds: tuple[str, ...], campaign: "Campaign", workers: int, output: str
) -> None:
    from fogspec.evaluation.campaign import evaluate_volumes
    from fogspec.evaluation.volumes import SIZES

    _check_kinds(kinds)
    rows = evaluate_volumes(suite, priors, kinds, campaign.seed, campaign.noise, workers=workers)
    if output == "json":
        say_json(rows)
        return
    shown = [["kind", "requests", "own rule", "relative", *(f"{size} samples" for size in SIZES), "own/best"]]
    for row in rows:
        fixed = [f"{usd:.4g}" for usd in row["fixed_usd"].values()]
        own = [f"{row['requests']:.0e}", f"{row['own_usd']:.4g}", f"{row['relative_usd']:.4g}"]
        shown.append([row["kind"], *own, *fixed, f"{row['over_best']:.3f}"])
    say(*blocks(shown, columns()))


def _check_kinds(kinds: tuple[str, ...]) -> None:
    from fogspec.evaluation.suites import KINDS

    if unknown := set(kinds) - set(KINDS):
        raise UsageError(f"--kind is one of {', '.join(KINDS)}, got {min(unknown)!r}")


def _of_sweep(
    spec: str,
    sweep: Path,
    catalog_path: str | None,
    priors: Path | None,
    campaigns: "list[tuple[str, Campaign]]",
    chart: Path | None,
    output: str,
) -> None:
    from fogspec.base.project_files import write_output
    from fogspec.compile.inputs import catalogs_for
    from fogspec.evaluation.campaign import replay_sweep, replays
    from fogspec.evaluation.sweeps import read_sweep
    from fogspec.model.priors import read_priors

    loaded = applications_of(spec)
    if len(loaded) != 1:
        raise UsageError(f"{spec} has {len(loaded)} applications, a sweep is of one")
    application = loaded[0].application
    read = read_sweep(sweep, application, catalogs_for(loaded, catalog_path)[0])
    library = read_priors(priors) if priors else None
    window_s, many = application.spec.benchmark.stop.duration, len(campaigns) > 1
    if many:
        campaigns = [one for one in campaigns if replays(read, one[1].sampler)]
    done = [(title, replay_sweep(read, library, window_s, campaign)) for title, campaign in campaigns]
    if chart:
        from fogspec.report.sweep_svg import draw

        shown = next((one for _, one in done if one.campaign.sampler == "adaptive"), done[0][1])
        named = [(title or one.campaign.sampler, one) for title, one in done]
        write_output(chart, draw(read, shown, named).encode())
    reports = []
    for title, one in done:
        about = {**_about(one.campaign, ""), "noise": "none" if one.campaign.noise == "none" else read.noise}
        reports.append({"application": application.metadata.name, "title": title or None, **about, **one.report})
    if output == "json":
        say_json(reports if many else reports[0])
    elif many:
        say(f"{application.metadata.name}: {len(read.names)} machines, noise {reports[0]['noise']}")
        say(*blocks([HEAD, *(row_texts(title, one.row) for title, one in done)], columns(), keys=2))
    else:
        report = {name: value for name, value in reports[0].items() if name not in ("metrics", "title")}
        say(*(f"{name:18} {_shown(value)}" for name, value in report.items()))
        for metric, scores in reports[0]["metrics"].items():
            say(*(f"{metric} {name:18} {_shown(value)}" for name, value in scores.items()))


def _about(campaign: "Campaign", digest: str) -> dict[str, Any]:
    return {
        "sampler": campaign.sampler,
        "method": campaign.reads_with,
        "noise": campaign.noise,
        "seed": campaign.seed,
        "priors": digest or None,
    }


def _shown(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, list):
        return ", ".join(value) or "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


HEAD = ["", "kind", "problems", "ok1", "ok5", "ok10", "bench", "samples", "broken", "no", "regret p90", "mdape", "cover",
        "volume"]  # fmt: skip


def row_texts(title: str, row: dict[str, Any]) -> list[str]:
    """Format the scores of a kind of problem, fractions as percentages, in the columns of HEAD."""
    shares = [row["regret"]["p90"], row["mdape"], row["coverage90"], row["hypervolume"]]
    known = ["-" if value is None else f"{100 * value:.1f}" for value in shares]
    ok = [f"{100 * row[name]:.1f}" for name in ("ok1", "ok5", "ok10")]
    return [title, row["kind"], f"{row['problems']:,}", *ok, f"{100 * row['bench']:.2f}", f"{row['samples']:.1f}",
            f"{100 * row['violation5']:.2f}", f"{100 * row['false_infeasible']:.2f}", *known]  # fmt: skip
