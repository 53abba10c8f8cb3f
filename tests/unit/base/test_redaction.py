"""Secrets out of what is printed: whole, in pieces, in JSON, and by a process that is ended."""

import json
import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogspec.agent.redaction import Output, Secrets, Stream
from tests.support.agent import AGENT

VALUES = st.dictionaries(st.text("abc", min_size=2, max_size=5), st.sampled_from(["$X", "$Y", "$Z"]), max_size=3)
PIECES = st.lists(st.text("abc", max_size=6).map(str.encode), max_size=8)


@given(VALUES, PIECES)
def test_pieces_say_what_the_whole_says(values: dict[str, str], pieces: list[bytes]) -> None:
    secrets = Secrets(values)
    stream = Stream(secrets)
    said = b"".join([*(stream.feed(piece) for piece in pieces), stream.rest()])
    assert said == secrets.redact_bytes(b"".join(pieces))


@given(VALUES, PIECES)
def test_nothing_is_held_back_that_cannot_be_a_secret(values: dict[str, str], pieces: list[bytes]) -> None:
    stream = Stream(Secrets(values))
    assert stream.feed(b"".join(pieces) + b"\n").endswith(b"\n")


@pytest.mark.parametrize("value", ['quoted "twice" \\ here', "naïve-pässword", "-----BEGIN-----\nabc\n-----END-----\n"])
def test_as_json_writes_it(value: str) -> None:
    secrets = Secrets({value: "$KEY"})
    for ascii in (True, False):
        assert (
            secrets.redact(json.dumps({"reason": f"refused {value}"}, ensure_ascii=ascii))
            == '{"reason": "refused $KEY"}'
        )
    assert secrets.redact(value) == "$KEY"


def test_short_values_are_words_like_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ON", "yes")
    assert not Secrets.of(["ON", "NOT_SET_AT_ALL"])
    assert Secrets.of(["ON"]).redact("yes") == "yes"


def test_what_a_process_prints_last_is_there(monkeypatch: pytest.MonkeyPatch, tmp_path) -> None:
    monkeypatch.setenv("KEY", "hunter2-hunter2")
    words = "import os, sys; print(os.environ['KEY'] * 9999); sys.exit('lost ' + os.environ['KEY'][:-1])"
    output = Output(["KEY"])
    with open(tmp_path / "log", "wb") as log:
        process = output.start([sys.executable, "-c", words], log, stdin=subprocess.DEVNULL)
    assert process.wait() == 1
    output.settle(process)
    said = (tmp_path / "log").read_bytes()
    assert sorted(said.splitlines()) == [b"$KEY" * 9999, b"lost hunter2-hunter"], "what only begins like one is none"


def test_records_keep_their_figures_and_what_is_too_long_for_one_loses_its_secrets_too() -> None:
    environment = {"PIN": "1234", "KEY": "hunter2-hunter2"}
    lines = [b'{"latency_s": 0.1234, "reason": "1234 hunter2-hunter2"}', b"no json 1234", b"\xff\0hunter2-hunter2"]
    long = b"x" * (2**20 - 5) + b"hunter2-hunter2" + b"y" * 2**20
    said = subprocess.run([sys.executable, AGENT, "redaction", "PIN", "KEY"], env=environment, capture_output=True,
                          input=b"\n".join([*lines, long, lines[0], b"torn hunter2-hunter2"])).stdout  # fmt: skip
    clean = b'{"latency_s": 0.1234, "reason": "$PIN $KEY"}'
    assert said.split(b"\n") == [
        clean, b"no json $PIN", b"\xff\0$KEY", long.replace(b"hunter2-hunter2", b"$KEY"), clean, b"torn $KEY"
    ]  # fmt: skip
