"""A bench of nodes whose machine is busy for longer, or for shorter, than their latency."""

from pathlib import Path

from fogspec.base.units import parse_duration_s
from tests.support.scenes import SPEC, Scene

AFTER = """\
import time
import fogspec_probe
while True:
    fogspec_probe.start("work")
    fogspec_probe.stop("work")
    end = time.thread_time() + 0.05
    while time.thread_time() < end:
        pass
"""
FOUR = """\
import threading, time
import fogspec_probe
def ask():
    while True:
        fogspec_probe.start("work")
        time.sleep(0.2)
        fogspec_probe.stop("work")
for _ in range(4):
    threading.Thread(target=ask).start()
"""


def busy_s(record: dict[str, object]) -> float:
    return parse_duration_s(str(record["busy"]))


def test_work_after_the_answer_is_said_and_paid(tmp_path: Path) -> None:
    scene = Scene.made(tmp_path / "scene", AFTER)
    ended = scene.bench()
    assert ended.returncode == 0, ended.stderr
    for record in scene.records().values():
        assert "of CPU time a request, at least, was used while none was open: no latency has it" in record["detail"]
        assert busy_s(record) > 0.02 > parse_duration_s(str(record["latency"]["mean"]))
    assert scene.run("compile").returncode == 0
    assert "for each request that succeeds: so long is the machine busy" in " ".join(
        scene.run("explain").stdout.split()
    )


def test_requests_at_the_same_time_cost_less_each(tmp_path: Path) -> None:
    scene = Scene.made(tmp_path / "scene", FOUR, SPEC.replace("requests: 10", "requests: 40"))
    ended = scene.bench()
    assert ended.returncode == 0, ended.stderr
    for record in scene.records().values():
        mean_s = parse_duration_s(str(record["latency"]["mean"]))
        assert mean_s / 5 < busy_s(record) < mean_s / 2
