"""Implement `fogspec-lab replay`: the campaign of `fogspec bench` on recorded results, without a machine."""

import inspect
from typing import TYPE_CHECKING, Any

import click

from fogspec.cli import bench

if TYPE_CHECKING:
    from fogspec.backends.protocol import SampleBackend
    from fogspec.bench.prepare import Prepared

OWN = [
    click.Option(
        ["--from", "recorded"],
        type=click.Path(path_type=str),
        metavar="FILE",
        required=True,
        help="recording: results (YAML) or a sweep (CSV with instance_type, latency_s)",
    ),
    click.Option(
        ["--pace"], type=click.FloatRange(0), default=0.0, metavar="SECONDS", help="wait for each recorded second"
    ),
]


def replay(recorded: str, pace: float, **options: Any) -> None:
    """Rehearse `fogspec bench APP` with recorded results: free of charge, and no machine is started.

    APP is a name or a spec. Results are written as by a bench; those of another runner are not mixed with them.
    """

    def backend_of(prepared: "Prepared") -> "SampleBackend":
        from fogspec.base.clock import SystemClock
        from fogspec_lab.recordings import replayable
        from fogspec_lab.replay import ReplaySamples

        found, source = replayable(recorded, prepared.plan.spec.duration)
        return ReplaySamples(found, source, SystemClock().now_s, pace)

    bench.measure(backend_of, files=False, **options)


# All of bench's options but where to measure.
command = click.Command(
    "replay",
    callback=replay,
    help=inspect.cleandoc(replay.__doc__ or ""),
    params=[*OWN, *(one for one in bench.command.params if one.name != "runner_name")],
)
