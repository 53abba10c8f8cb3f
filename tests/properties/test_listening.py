"""What a listener hears of a pipeline is measured within a tenth of its period, or refused: the law, without ROS.

The real matcher, writer, reader and record; requests are matched by stamp, and a player sends the next one after a response.
"""

import json
import random
from dataclasses import dataclass
from pathlib import Path

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from fogspec.agent.matching import Matcher
from fogspec.agent.records import Writer
from fogspec.backends.protocol import SampleStatus
from fogspec.bench.record import make_record
from fogspec.catalog.machine import Machine
from fogspec.plan.schema import Sample
from fogspec.results.requests import RecordRules
from fogspec.results.schema import Measured

MACHINE = Machine(infra="local", instance="1cpu-1gib", cpus=1.0, memory=1.0, price=0.0)
SAMPLE = Sample.model_construct(id="one", machine=MACHINE, reason="", task=None)
STAMPS = ("unique", "constant", "whole seconds")


@dataclass(frozen=True, kw_only=True)
class Pipeline:
    """Requests every `period_s` with latencies of `delay` periods, and what becomes of some of them."""

    period_s: float
    delay: float
    jitter: float
    joined: float
    lost: float
    unheard: float
    twice: float
    stamps: str
    seed: int

    def heard(self, count: int = 150) -> tuple[list[tuple[float, str, tuple[int, int]]], list[float]]:
        """What a listener hears that joins after `joined` periods, by time; and the latencies of what is answered."""
        chance, events, truth = random.Random(self.seed), [], []
        for n in range(count):
            sent_s = n * self.period_s
            latency_s = self.period_s * max(0.01, self.delay + self.jitter * chance.uniform(-1, 1))
            stamp = {"unique": (n, 7), "constant": (0, 0), "whole seconds": (int(sent_s), 0)}[self.stamps]
            if chance.random() >= self.unheard:
                events.append((sent_s, ">", stamp))
            if chance.random() >= self.lost:
                truth.append(latency_s)
                events += [(sent_s + latency_s, "<", stamp)] * (1 + (chance.random() < self.twice))
        from_s = self.joined * self.period_s
        return sorted(one for one in events if one[0] >= from_s), truth


def measured(folder: Path, pipeline: Pipeline, timeout_s: float | None) -> tuple[Measured, float]:
    """The record of what a listener heard, and the true mean latency."""
    path = folder / "timings.jsonl"
    path.write_bytes(b"")
    matcher, writer = Matcher("stamp", timeout_s), Writer("/pose", str(path))
    events, truth = pipeline.heard()
    for now_s, what, stamp in events:
        if what == ">":
            for one in matcher.take_request(stamp, now_s):
                writer.request(one)
        elif (done := matcher.take_response(stamp, now_s)) is not None:
            writer.request(done)
        elif not matcher.was_sent_before(stamp):
            writer.unmatched(now_s)
    rules = RecordRules(warmup=1, valid=0.95, statistic="mean", callback="/pose", timeout_s=timeout_s)
    made = make_record(SAMPLE, SampleStatus(running=False, timings=path), rules, 60.0, 0.0)
    assert all(json.loads(line) for line in path.read_text().splitlines())
    return made, sum(truth) / len(truth) if truth else 0.0


pipelines = st.builds(
    Pipeline,
    period_s=st.sampled_from([0.05, 0.1, 1.0]),
    delay=st.floats(0.01, 10),
    jitter=st.floats(0, 2),
    joined=st.floats(0, 20),
    lost=st.sampled_from([0.0, 0.02, 0.3]),
    unheard=st.sampled_from([0.0, 0.02, 0.3]),
    twice=st.sampled_from([0.0, 0.05, 1.0]),
    stamps=st.sampled_from(STAMPS),
    seed=st.integers(0, 10**6),
)


@pytest.mark.slow
@given(pipelines, st.sampled_from([None, 20.0]))
@settings(deadline=None, max_examples=300)
def test_by_stamp_a_pipeline_is_measured_within_a_tenth_of_its_period_or_refused(
    tmp_path_factory: pytest.TempPathFactory, pipeline: Pipeline, timeout_periods: float | None
) -> None:
    timeout_s = None if timeout_periods is None else timeout_periods * pipeline.period_s
    made, true_s = measured(tmp_path_factory.mktemp("law"), pipeline, timeout_s)
    if made.state == "ok":
        assert made.latency is not None
        # The mean of the requests that were heard differs by the jitter's own chance.
        chance_s = 4 * pipeline.jitter * pipeline.period_s / made.requests**0.5
        assert made.latency.mean == pytest.approx(true_s, abs=0.1 * pipeline.period_s + chance_s)
    elif pipeline.stamps == "unique":
        assume(made.state != "timeout")
        assert pipeline.lost or pipeline.unheard or pipeline.twice, made.detail
