"""The process that imports SkyPilot. `fogspec.base.child` starts it, isolated and outside of the working folder.

There, SkyPilot reads no `.sky.yaml` of a checkout, which may name code to run, and an API server that it starts, which outlives
this process, stays in no folder that may be removed.

A line of JSON on standard input is a call, `{"id": 1, "op": "jobs", "arguments": {...}}`; a line on standard output is its
result, `{"id": 1, "value": ...}` or `{"id": 1, "problem": {...}}`. Calls run concurrently. The worker ends with its input.
"""

import json
import os
import queue
import sys
import threading
import traceback
from typing import Any, TextIO


def main() -> None:
    """Serve calls until standard input ends."""
    # SkyPilot prints: results alone go to what was standard output.
    results = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    lock = threading.Lock()
    calls: queue.SimpleQueue[str] = queue.SimpleQueue()
    # A thread of its own: the client must not wait while SkyPilot is being imported.
    threading.Thread(target=read_calls, args=(calls,), daemon=True).start()
    try:
        from fogspec.backends.skypilot import api
    except ImportError as problem:
        write(results, lock, {"id": 0, "missing": str(problem)})
        return
    while True:
        call = json.loads(calls.get())
        operation = api.OPERATIONS[call["op"]]
        arguments = (results, lock, call["id"], operation, call["arguments"])
        threading.Thread(target=run, args=arguments, daemon=True).start()


def read_calls(calls: "queue.SimpleQueue[str]") -> None:
    """Queue the calls, and end this process with its client."""
    for line in sys.stdin:
        calls.put(line)
    # A launch that is being prepared must not go out after its client has ended.
    os._exit(0)


def run(results: TextIO, lock: threading.Lock, number: int, operation: Any, arguments: dict[str, Any]) -> None:
    """Run one call and write its result."""
    from fogspec.backends.skypilot.errors import classify

    try:
        result = {"id": number, "value": operation(**arguments)}
    except (Exception, SystemExit) as problem:  # SkyPilot ends processes where others raise
        traceback.print_exc()
        result = {"id": number, "problem": classify(problem).to_dict()}
    write(results, lock, result)


def write(results: TextIO, lock: threading.Lock, result: dict[str, Any]) -> None:
    """Write one whole line."""
    with lock:
        results.write(json.dumps(result, default=str) + "\n")
        results.flush()


if __name__ == "__main__":
    main()
