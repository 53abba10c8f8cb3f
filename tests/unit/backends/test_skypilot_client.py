"""Our side of SkyPilot's worker, with workers that misbehave."""

from concurrent import futures
from pathlib import Path

import pytest

from fogspec.backends.protocol import Unreachable
from fogspec.backends.skypilot import client as module
from fogspec.backends.skypilot.client import Client
from fogspec.base import child
from fogspec.base.errors import CloudError

PATIENCE_S = 1200.0  # it only bounds hangs
WORKERS = {
    "echoes": "import sys, json\nfor line in sys.stdin:\n    q = json.loads(line)\n"
              "    print(json.dumps({'id': q['id'], 'value': q['arguments']}), flush=True)\n",
    "dies": "import sys\nsys.stdin.readline()\nprint('out of luck', file=sys.stderr)\nsys.exit(3)\n",
    "is_silent": "import time\ntime.sleep(3600)\n",
    "has_no_sky": "print('{\"id\": 0, \"missing\": \"No module named sky\"}', flush=True)\n",
    "refuses": "import sys, json\nfor line in sys.stdin:\n    q = json.loads(line)\n"
               "    print(json.dumps({'id': q['id'], 'problem': {'reason': 'quota', 'detail': 'no'}}), flush=True)\n",
}  # fmt: skip


@pytest.fixture
def worker(request, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Client:
    (tmp_path / f"{request.param}.py").write_text(WORKERS[request.param])
    monkeypatch.setattr(child, "_own_folders", lambda: [str(tmp_path)])
    monkeypatch.setattr(module, "WORKER", request.param)
    with Client() as client:
        yield client


@pytest.mark.parametrize("worker", ["echoes"], indirect=True)
def test_many_questions_at_once_get_their_own_answers(worker: Client) -> None:
    calls = [worker.begin("any", number=number) for number in range(50)]
    assert not futures.wait(calls, PATIENCE_S).not_done
    assert [call.result() for call in calls] == [{"number": number} for number in range(50)]


@pytest.mark.parametrize("worker", ["dies"], indirect=True)
def test_a_worker_that_dies_is_said_and_replaced(worker: Client) -> None:
    for _ in range(2):
        with pytest.raises(Unreachable, match="out of luck"):
            worker.call("any", PATIENCE_S)


@pytest.mark.slow
@pytest.mark.parametrize("worker", ["is_silent"], indirect=True)
def test_a_silent_worker_holds_nobody_up(worker: Client) -> None:
    call = worker.begin("any")
    assert not call.done()
    with pytest.raises(Unreachable, match=r"within 0\.2 s: any"):
        worker.call("any", 0.2)
    worker.close()  # which does not wait for its end: that is an hour away


@pytest.mark.parametrize("worker", ["has_no_sky"], indirect=True)
def test_what_is_missing_is_said_with_the_command(worker: Client) -> None:
    with pytest.raises(CloudError, match=r"pip install 'fogspec\[sky\]'"):
        worker.ready(PATIENCE_S)


@pytest.mark.parametrize("worker", ["refuses"], indirect=True)
def test_a_refusal_keeps_its_reason(worker: Client) -> None:
    from fogspec.backends.skypilot.errors import CloudProblem

    with pytest.raises(CloudProblem) as no:
        worker.call("any", PATIENCE_S)
    assert (no.value.reason, no.value.detail) == ("quota", "no")


def test_without_skypilot_it_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(_name: str) -> str:
        raise module.importlib.metadata.PackageNotFoundError

    monkeypatch.setattr(module.importlib.metadata, "version", absent)
    with pytest.raises(CloudError, match="not installed"):
        Client().begin("hello")
