"""Our side of the worker: questions that do not block, and their answers."""

import contextlib
import importlib.metadata
import itertools
import json
import subprocess
import sys
import tempfile
import threading
import time
from typing import IO, Any

from fogspec.backends.protocol import Unreachable
from fogspec.backends.skypilot.errors import CloudProblem, from_dict, plain
from fogspec.base.errors import CloudError

WORKER = "fogspec.backends.skypilot.worker"
START_S = 240.0
TAIL_BYTES = 2000


class Call:
    """A question that was asked at `asked_s` of the monotonic clock."""

    def __init__(self) -> None:
        self.asked_s = time.monotonic()
        self._answered = threading.Event()
        self._told: dict[str, Any] = {}

    @property
    def done(self) -> bool:
        """Whether there is an answer."""
        return self._answered.is_set()

    def wait(self, timeout_s: float) -> bool:
        """Wait for the answer; whether there is one."""
        return self._answered.wait(timeout_s)

    def value(self) -> Any:
        """The answer; raises CloudProblem for one that is a no, Unreachable where nothing is known."""
        if "problem" not in self._told:
            return self._told.get("value")
        problem = from_dict(self._told["problem"])
        if problem.contact:
            raise Unreachable(problem.detail)
        raise problem

    def tell(self, told: dict[str, Any]) -> None:
        """The answer is here."""
        self._told = told
        self._answered.set()


class Client:
    """SkyPilot as a worker process, started when first asked and again when it ended.

    Its own sessions end with it; machines and API server do not. Raises CloudError where SkyPilot is not installed.
    """

    def __init__(self) -> None:
        try:
            self.version = importlib.metadata.version("skypilot")
        except importlib.metadata.PackageNotFoundError:
            raise CloudError("SkyPilot is not installed here", "pip install 'fogspec[sky]'") from None
        self._numbers = itertools.count(1)
        self._lock = threading.Lock()
        self._calls: dict[int, tuple[subprocess.Popen[str], Call]] = {}
        self._process: subprocess.Popen[str] | None = None

    def __enter__(self) -> "Client":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def ready(self, timeout_s: float = START_S) -> str:
        """Wait until SkyPilot answers, and return its version; raises CloudError when it does not."""
        try:
            return str(self.ask("hello", timeout_s)["version"])
        except (CloudProblem, Unreachable) as problem:
            raise CloudError(f"SkyPilot does not answer: {problem}", "what it says itself: sky api status") from None

    def begin(self, op: str, **words: Any) -> Call:
        """Ask; see `fogspec.backends.skypilot.api` for what can be asked."""
        call, number = Call(), next(self._numbers)
        with self._lock:
            process = self._started()
            self._calls[number] = (process, call)
            try:
                assert process.stdin is not None
                process.stdin.write(json.dumps({"id": number, "op": op, "words": words}) + "\n")
                process.stdin.flush()
            except OSError:
                del self._calls[number]
                call.tell(_silence("SkyPilot's worker has ended"))
        return call

    def ask(self, op: str, timeout_s: float, **words: Any) -> Any:
        """Ask and wait; raises Unreachable when there is no answer in time, else as `Call.value` does."""
        call = self.begin(op, **words)
        if not call.wait(timeout_s):
            raise Unreachable(f"SkyPilot has not answered within {timeout_s:g} s: {op}")
        return call.value()

    def close(self) -> None:
        """End the worker."""
        with self._lock:
            process, self._process = self._process, None
        if process is not None:
            with contextlib.suppress(OSError):
                if process.stdin is not None:
                    process.stdin.close()
            try:
                process.wait(2)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def _started(self) -> "subprocess.Popen[str]":
        if self._process is None or self._process.poll() is not None:
            said = tempfile.TemporaryFile()  # noqa: SIM115 - whoever listens reads it when the worker has ended
            # In a session of its own: Ctrl-C on the terminal is for us to answer.
            self._process = subprocess.Popen(
                [sys.executable, "-m", WORKER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=said, text=True,
                start_new_session=True,
            )  # fmt: skip
            threading.Thread(target=self._listen, args=(self._process, said), daemon=True).start()
        return self._process

    def _listen(self, process: "subprocess.Popen[str]", said: IO[bytes]) -> None:
        missing = None
        assert process.stdout is not None
        for line in process.stdout:
            told = json.loads(line)
            missing = told.get("missing", missing)
            asked = self._calls.pop(told["id"], None)
            if asked is not None:
                asked[1].tell(told)
        code = process.wait()
        with self._lock:
            left = [number for number, (asked_of, _) in self._calls.items() if asked_of is process]
            calls = [self._calls.pop(number)[1] for number in left]
        why = f"{missing}: pip install 'fogspec[sky]'" if missing else f"SkyPilot's worker ended{_how(code, said)}"
        for call in calls:
            call.tell(_silence(why))


def _silence(why: str) -> dict[str, Any]:
    return {"problem": CloudProblem("setup", why, again=True, contact=True).told()}


def _how(code: int, said: IO[bytes]) -> str:
    """By which signal, or what it said last."""
    if code < 0:
        return f" by signal {-code}"
    said.seek(max(0, said.seek(0, 2) - TAIL_BYTES))
    lines = [line for line in plain(said.read().decode("utf-8", "replace")).splitlines() if line.strip()]
    return f": {lines[-1].strip()}" if lines else ""
