"""The process that has SkyPilot in it: `python -m fogspec.backends.skypilot.worker`.

A line of JSON in is a question, `{"id": 1, "op": "jobs", "words": {...}}`; a line out is its answer, `{"id": 1, "value": ...}`
or `{"id": 1, "problem": {...}}`. Questions are worked on at the same time. The worker ends when its standard input does.
"""

import json
import os
import queue
import sys
import threading
import traceback
from typing import Any, TextIO


def main() -> None:
    """Answer until nobody asks any more."""
    # What SkyPilot prints goes elsewhere, so that answers are alone on what was standard output.
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    lock = threading.Lock()
    questions: queue.SimpleQueue[str] = queue.SimpleQueue()
    # Whoever asks while SkyPilot is being imported does not wait for it.
    threading.Thread(target=hear, args=(questions,), daemon=True).start()
    try:
        from fogspec.backends.skypilot import api
    except ImportError as problem:
        say(answers, lock, {"id": 0, "missing": str(problem)})
        return
    # An API server that is started here outlives us, and must not be left in a folder that may be removed.
    os.chdir(os.path.expanduser("~"))
    while True:
        question = json.loads(questions.get())
        operation = api.OPERATIONS[question["op"]]
        words = (answers, lock, question["id"], operation, question["words"])
        threading.Thread(target=answer, args=words, daemon=True).start()


def hear(questions: "queue.SimpleQueue[str]") -> None:
    """Take down what is asked, and end this process with whoever asks."""
    for line in sys.stdin:
        questions.put(line)
    # A launch that is being prepared must not go out after whoever wanted it is gone.
    os._exit(0)


def answer(answers: TextIO, lock: threading.Lock, number: int, operation: Any, words: dict[str, Any]) -> None:
    """Work on one question."""
    from fogspec.backends.skypilot.errors import classify

    try:
        told = {"id": number, "value": operation(**words)}
    except (Exception, SystemExit) as problem:  # SkyPilot ends processes where others raise
        traceback.print_exc()
        told = {"id": number, "problem": classify(problem).told()}
    say(answers, lock, told)


def say(answers: TextIO, lock: threading.Lock, told: dict[str, Any]) -> None:
    """One line, whole."""
    with lock:
        answers.write(json.dumps(told, default=str) + "\n")
        answers.flush()


if __name__ == "__main__":
    main()
