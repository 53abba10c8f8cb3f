"""Implement `fogspec-lab evaluate`: replay sampling and choosing against full measurements."""

import json
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fogspec.base.console import columns, say, say_json
from fogspec.base.errors import UsageError
from fogspec.base.text import blocks
from fogspec.cli.options import CATALOG, OUTPUT, applications_of

if TYPE_CHECKING:
    from fogspec_lab.evaluation.campaign import Campaign

SAMPLERS = ("adaptive", "grid", "random", "cherrypick", "full", "best")
METHODS = ("model", "verified", "paper", "measured")
ROWS = (
    ("paper: grid, best R², relaxed", "grid", "paper"),
    ("grid, ours", "grid", None),
    ("random 9, ours", "random", None),
    ("CherryPick-like", "cherrypick", None),
    ("adaptive", "adaptive", None),
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
@click.option(
    "--library",
    metavar="DIR|FILE",
    help="machine library: a suite, a file, or built-in for fogspec's own; a problem's own suite is left out  [default: none]",
)
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
@click.option(
    "--seed",
    "seeds",
    type=click.IntRange(min=0),
    multiple=True,
    default=(0,),
    show_default=True,
    help="seed of the random numbers; repeatable",
)
@click.option(
    "--choices", type=click.Path(path_type=Path), metavar="FILE", help="file for a line per choice, as it is made"
)
@click.option("--all", "every", is_flag=True, help="print a table of every sampler and method")
@click.option("--workers", type=click.IntRange(1, 64), default=2, show_default=True, help="processes")
@CATALOG
@OUTPUT
def command(
    spec: str | None,
    sweep: Path | None,
    suite: Path | None,
    library: str | None,
    kinds: tuple[str, ...],
    sampler: str,
    method: str | None,
    noise: str,
    seeds: tuple[int, ...],
    choices: Path | None,
    every: bool,
    workers: int,
    catalog_path: str | None,
    output: str,
) -> None:
    """Score choices from few samples, where every machine was measured.

    Either SPEC with its --sweep, or a --suite of problems.
    """
    from fogspec_lab.evaluation.campaign import Campaign

    rows = ROWS if every else [("", sampler, ALIASES.get(method, method) if method else None)]
    campaigns = [(name, [Campaign(s, m, noise, seed) for seed in seeds]) for name, s, m in rows]
    if spec and sweep and not (suite or kinds or choices or len(seeds) > 1):
        _of_sweep(
            spec=spec,
            sweep=sweep,
            catalog_path=catalog_path,
            library=library,
            campaigns=[(name, one) for name, (one,) in campaigns],
            output=output,
        )
    elif suite and not (spec or sweep):
        _of_suite(
            suite=suite,
            library=library,
            kinds=kinds,
            campaigns=campaigns,
            choices=choices,
            workers=workers,
            output=output,
        )
    else:
        raise UsageError(
            "evaluate needs SPEC --sweep FILE, or --suite DIR",
            "fogspec-lab evaluate specs/NAME.yaml --sweep sweep.csv",
            "fogspec-lab evaluate --suite DIR --library DIR -o json",
        )


def _of_suite(
    suite: Path,
    library: str | None,
    kinds: tuple[str, ...],
    campaigns: "list[tuple[str, list[Campaign]]]",
    choices: Path | None,
    workers: int,
    output: str,
) -> None:
    from fogspec_lab.evaluation.campaign import Result, by_kind, evaluate
    from fogspec_lab.libraries import library_named

    _check_kinds(kinds)
    known = library_named(library)
    about = {"library": known.digest if known else None}
    found: dict[Campaign, list[Result]] = {one: [] for _, some in campaigns for one in some}
    with choices.open("w", encoding="utf-8") if choices else nullcontext() as file:
        for ended in evaluate(suite, library, kinds, list(found), workers=workers):
            found[ended[0].campaign] += ended
            if file is not None:
                file.writelines(json.dumps(one.as_dict() | about, ensure_ascii=False) + "\n" for one in ended)
                file.flush()
    reports = []
    for title, some in campaigns:
        rows, calibrations = by_kind(result for one in some for result in found[one])
        seeds = {"seed": [one.seed for one in some]}
        reports.append(
            {"title": title, **some[0].as_dict(), **seeds, **about, "by_kind": rows, "calibration": calibrations}
        )
    if output == "json":
        say_json(reports[0] if len(reports) == 1 else reports)
        return
    texts = [row_texts(one["title"], row) for one in reports for row in one["by_kind"]]
    say(*blocks([HEAD, *texts], columns(), keys=2))


def _check_kinds(kinds: tuple[str, ...]) -> None:
    from fogspec_lab.evaluation.suites import KINDS

    if unknown := set(kinds) - set(KINDS):
        raise UsageError(f"--kind is one of {', '.join(KINDS)}, got {min(unknown)!r}")


def _of_sweep(
    spec: str,
    sweep: Path,
    catalog_path: str | None,
    library: str | None,
    campaigns: "list[tuple[str, Campaign]]",
    output: str,
) -> None:
    from fogspec.compile.inputs import catalogs_for
    from fogspec_lab.evaluation.campaign import replay_sweep, replays
    from fogspec_lab.evaluation.sweeps import read_sweep
    from fogspec_lab.libraries import library_named

    loaded = applications_of(spec)
    if len(loaded) != 1:
        raise UsageError(f"{spec} has {len(loaded)} applications, a sweep is of one")
    application = loaded[0].application
    read = read_sweep(sweep, application, catalogs_for(loaded, catalog_path)[0])
    known = library_named(library)
    many = len(campaigns) > 1
    if many:
        campaigns = [one for one in campaigns if replays(read, one[1].sampler)]
    done = [(title, replay_sweep(read, known, campaign)) for title, campaign in campaigns]
    reports = []
    for title, one in done:
        about = one.campaign.as_dict() | {"noise": "none" if one.campaign.noise == "none" else read.noise}
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


def _shown(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, list):
        return ", ".join(value) or "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


HEAD = ["", "kind", "problems", "ok5", "±", "ok1", "ok10", "off 20", "bench", "±", "usd", "hours", "samples", "broken", "no",
        "regret", "p90", "mdape", "cover"]  # fmt: skip


def row_texts(title: str, row: dict[str, Any]) -> list[str]:
    """Format the scores of a kind of problem, fractions as percentages, in the columns of HEAD."""

    def percent(value: float | None, digits: int = 1) -> str:
        return "-" if value is None else f"{100 * value:.{digits}f}"

    error, regret = row["error"], row["regret"]
    rest = [row[name] for name in ("mdape", "coverage90")]
    return [title, row["kind"], f"{row['problems']:,}", percent(row["ok5"]), percent(error["ok5"]),
            *(percent(value) for value in (row["ok1"], row["ok10"], 1 - row["ok20"])), percent(row["bench"], 2),
            percent(error["bench"], 2), f"{row['usd']:.2f}", f"{row['hours']:.2f}", f"{row['samples']:.1f}",
            *(percent(row[name], 2) for name in ("violation5", "false_infeasible")),
            *(percent(value) for value in (regret["mean"], regret["p90"], *rest))]  # fmt: skip
