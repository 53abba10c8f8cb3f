"""The client of the worker process: calls that do not block, with a future for each result."""

import contextlib
import importlib.metadata
import itertools
import json
import subprocess
import tempfile
import threading
from collections.abc import Mapping
from concurrent.futures import Future
from typing import IO, TYPE_CHECKING, Any

from fogspec.backends.protocol import Unreachable
from fogspec.backends.skypilot.errors import CloudProblem, plain
from fogspec.base import child
from fogspec.base.errors import CloudError, NotInstalled

if TYPE_CHECKING:
    from packaging.specifiers import SpecifierSet

WORKER = "fogspec.backends.skypilot.worker"
START_S = 240.0
TAIL_BYTES = 2000


def supported_versions() -> "SpecifierSet":
    """Return the versions of SkyPilot that fogspec's requirements allow. SkyPilot, which must be here, brings `packaging`."""
    from packaging.requirements import Requirement

    wanted = map(Requirement, importlib.metadata.requires("fogspec") or ())
    return next(one.specifier for one in wanted if one.name == "skypilot")


class Client:
    """SkyPilot in a worker process, which is started by the first call and restarted after it ended.

    The worker ends with this process; machines and API server do not.
    """

    def __init__(self) -> None:
        self._numbers = itertools.count(1)
        self._lock = threading.Lock()
        self._calls: dict[int, tuple[subprocess.Popen[str], Future[Any]]] = {}
        self._process: subprocess.Popen[str] | None = None

    @property
    def version(self) -> str:
        """SkyPilot's version; raise NotInstalled if it is not installed."""
        try:
            return importlib.metadata.version("skypilot")
        except importlib.metadata.PackageNotFoundError:
            raise NotInstalled("SkyPilot is not installed here", "pip install 'fogspec[sky]'") from None

    def __enter__(self) -> "Client":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def ready(self, timeout_s: float = START_S) -> str:
        """Wait until SkyPilot answers, and return its version; raise CloudError if it does not."""
        try:
            return str(self.call("hello", timeout_s)["version"])
        except (CloudProblem, Unreachable) as problem:
            raise CloudError(f"SkyPilot does not answer: {problem}", "what it says itself: sky api status") from None

    def begin(self, op: str, **arguments: Any) -> Future[Any]:
        """Begin an operation of `fogspec.backends.skypilot.api`.

        The future raises CloudProblem if the operation failed, Unreachable if its outcome is unknown.
        """
        call, number = Future[Any](), next(self._numbers)
        _ = self.version
        with self._lock:
            process = self._started()
            self._calls[number] = (process, call)
            # A worker that has ended takes no request: its listener, which waits for the lock, then fails the call with the
            # reason that the worker printed.
            with contextlib.suppress(OSError):
                print(json.dumps({"id": number, "op": op, "arguments": arguments}), file=process.stdin, flush=True)
        return call

    def call(self, op: str, timeout_s: float, **arguments: Any) -> Any:
        """Begin an operation and wait for its result; raise Unreachable after `timeout_s`, else as the future does."""
        return result(self.begin(op, **arguments), timeout_s, op)

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
            errors = tempfile.TemporaryFile()  # noqa: SIM115 - the listener reads it when the worker has ended
            # In a session of its own: Ctrl-C on the terminal is for this process to handle.
            self._process = subprocess.Popen(
                child.python(WORKER),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
                start_new_session=True,
                cwd=child.ELSEWHERE,
                env=child.environment(),
            )
            threading.Thread(target=self._listen, args=(self._process, errors), daemon=True).start()
        return self._process

    def _listen(self, process: "subprocess.Popen[str]", errors: IO[bytes]) -> None:
        """Resolve the worker's calls, and when it has ended those that it left."""
        missing = None
        for line in process.stdout or ():
            answer = json.loads(line)
            missing = answer.get("missing", missing)
            begun = self._calls.pop(answer["id"], None)
            if begun is not None:
                _resolve(begun[1], answer)
        code = process.wait()
        with self._lock:
            left = [number for number, (worker, _) in self._calls.items() if worker is process]
            calls = [self._calls.pop(number)[1] for number in left]
        why = f"{missing}: pip install 'fogspec[sky]'" if missing else f"SkyPilot's worker ended{_cause(code, errors)}"
        for call in calls:
            call.set_exception(Unreachable(why))


def result(call: Future[Any], timeout_s: float, op: str) -> Any:
    """Wait for the result of a call; raise Unreachable after `timeout_s`, else as the future does."""
    try:
        return call.result(timeout_s)
    except TimeoutError:
        raise Unreachable(f"SkyPilot has not answered within {timeout_s:g} s: {op}") from None


def _resolve(call: Future[Any], answer: Mapping[str, Any]) -> None:
    if "problem" not in answer:
        call.set_result(answer.get("value"))
        return
    problem = CloudProblem.from_dict(answer["problem"])
    call.set_exception(Unreachable(problem.detail) if problem.contact else problem)


def _cause(code: int, errors: IO[bytes]) -> str:
    """Return the signal that ended the worker, or its last line."""
    if code < 0:
        return f" by signal {-code}"
    errors.seek(max(0, errors.seek(0, 2) - TAIL_BYTES))
    lines = [line for line in plain(errors.read().decode("utf-8", "replace")).splitlines() if line.strip()]
    return f": {lines[-1].strip()}" if lines else ""
