"""Secrets out of what is printed: whole, in pieces, in JSON, and by a process that is ended."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fogspec.agent.redaction import LONGEST_LINE, Marked, Output, Secrets, Stream
from fogspec.base.errors import UsageError
from fogspec.base.project_files import ProjectFiles
from fogspec.base.redaction import check_set, redact_files, redacted, register
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
    whole, begun = "print(os.environ['KEY'] * 9999)", "sys.exit('lost ' + os.environ['KEY'][:-1])"
    for words, last in ((whole, b"$KEY" * 9999), (begun, b"lost hunter2-hunter")):  # what only begins like one is none
        output = Output(["KEY"])
        with open(tmp_path / "log", "wb") as log:
            process = output.start([sys.executable, "-c", f"import os, sys; {words}"], log, stdin=subprocess.DEVNULL)
        process.wait()
        output.settle(process)
        assert (tmp_path / "log").read_bytes() == last + b"\n"


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


def test_a_list_in_a_record_and_a_key_lose_their_secrets_too() -> None:
    secrets = Secrets({"hunter2": "$KEY"})
    said = secrets.redact_record(b'{"all": ["hunter2", {"hunter2": [1, "x hunter2"]}], "n": 7}')
    assert json.loads(said) == {"all": ["$KEY", {"$KEY": [1, "x $KEY"]}], "n": 7}
    assert secrets.redact_record(b'{"n":  7}') == b'{"n":  7}', "what has none stays as it is, byte for byte"
    assert bool(secrets) is True


def test_values_are_hidden_wherever_they_stand_in_a_document(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("KEY", "hunter2-hunter2")
    register(["KEY"])
    found = redacted({"a": ["x hunter2-hunter2", ("hunter2-hunter2", 3)], "password": "p", "n": None})
    assert found == {"a": ["x $KEY", ["$KEY", 3]], "password": "(redacted)", "n": None}
    assert redacted("words", "api_key") == "(redacted)"
    assert redacted("", "api_key") == ""
    assert redacted({"psk": "abc", "auth": "abc", "author": "abc"}) == {
        "psk": "(redacted)",
        "auth": "(redacted)",
        "author": "abc",
    }
    assert redacted(["p"], "token") == ["(redacted)"], "a list under such a key too"


def test_secrets_that_are_not_set_are_named_with_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HERE", "x")
    check_set(["HERE"])
    with pytest.raises(UsageError, match="does not have A, B, so nothing was started") as missing:
        check_set(["B", "HERE", "A"])
    assert missing.value.hints == ("export A=… B=…",)


def test_files_of_a_sample_are_written_again_only_where_they_have_a_secret(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    register(["KEY"])
    monkeypatch.delenv("KEY", raising=False)
    (tmp_path / "below").mkdir()
    (tmp_path / "below/log").write_bytes(b"\xffhunter2\n")
    (tmp_path / "clean").write_bytes(b"nothing")
    (tmp_path / "link").symlink_to("below/log")
    before = (tmp_path / "clean").stat()
    redact_files(tmp_path)
    assert (tmp_path / "below/log").read_bytes() == b"\xffhunter2\n"
    monkeypatch.setenv("KEY", "hunter2")
    redact_files(tmp_path)
    assert (tmp_path / "below/log").read_bytes() == b"\xff$KEY\n"
    assert (tmp_path / "clean").stat() == before, "it was not written"
    assert (tmp_path / "link").is_symlink()


def test_standard_output_is_redacted_where_no_file_is_given(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("KEY", "hunter2-hunter2")
    words = [
        sys.executable,
        "-c",
        "import os, sys; print(os.environ['KEY']); print(os.environ['KEY'], file=sys.stderr)",
    ]
    for names, said in ((["KEY"], "$KEY\n"), ([], "hunter2-hunter2\n")):
        output = Output(names)
        process = output.start(words)
        assert process.wait() == 0
        output.settle()
        assert output.copying == {}
        found = capfd.readouterr()
        assert sorted([found.out, found.err]) == sorted([said, said] if not names else [said * 2, ""])


def test_both_outputs_are_in_one_file(tmp_path: Path) -> None:
    words = [sys.executable, "-c", "import sys; print('out', flush=True); print('err', file=sys.stderr)"]
    with open(tmp_path / "log", "wb") as log:
        assert Output([]).start(words, log).wait() == 0
    assert (tmp_path / "log").read_bytes() == b"out\nerr\n"


def test_a_line_after_a_torn_one_is_no_record() -> None:
    # The first piece ends in the middle of a secret: what follows on the same line is plain text, not JSON.
    line = b"x" * (2**20 - 4) + b"hunt" + b'er2 {"a": 1}\n'
    said = subprocess.run(
        [sys.executable, AGENT, "redaction", "KEY"], env={"KEY": "hunter2"}, capture_output=True, input=line
    ).stdout
    assert said == b"x" * (2**20 - 4) + b'$KEY {"a": 1}\n'


def test_a_secret_that_begins_another_one_waits_for_it() -> None:
    for pieces, said in (
        ((b"x abc", b"d y"), b"x $LONG y"),
        ((b"x abc", b" y"), b"x $SHORT y"),
        ((b"abc",), b"$SHORT"),
    ):
        stream = Stream(Secrets({"abc": "$SHORT", "abcd": "$LONG"}))
        assert b"".join([*map(stream.feed, pieces), stream.rest()]) == said


def test_a_file_that_cannot_be_read_keeps_no_other_from_its_redaction(tmp_path: Path) -> None:
    for name in ("a", "b", "c"):
        (tmp_path / name).write_bytes(b"hunter2\n")
    real = ProjectFiles.head

    def read(self: ProjectFiles, path: Path, *rest: int) -> bytes:
        if path.name == "b":
            raise OSError(5, "I/O error")
        return real(self, path, *rest)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ProjectFiles, "head", read)
        patch.setenv("KEY", "hunter2")
        register(["KEY"])
        redact_files(tmp_path)
    assert [(tmp_path / name).read_bytes() for name in "abc"] == [b"$KEY\n", b"hunter2\n", b"$KEY\n"]


@pytest.mark.parametrize("names", [[], ["KEY"]])
def test_a_process_starts_where_it_should_and_leaves_no_handle(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, names: list[str]
) -> None:
    monkeypatch.setenv("KEY", "hunter2-hunter2")
    before = len(os.listdir("/proc/self/fd"))
    with open(tmp_path / "out", "wb") as file:
        output = Output(names)
        process = output.start([sys.executable, "-c", "import os; print(os.getcwd())"], file, cwd=tmp_path)
        process.wait()
        output.settle(process)
    assert (tmp_path / "out").read_text() == f"{tmp_path}\n"
    assert len(os.listdir("/proc/self/fd")) == before


def test_each_line_is_marked_with_its_node_and_a_very_long_one_is_broken() -> None:
    marked = Marked("planner")
    assert marked.feed(b"one\ntw") == b"[planner] one\n"
    assert marked.feed(b"o\r\nthree") == b"[planner] two\n"
    assert marked.rest() == b"[planner] three\n"
    assert marked.rest() == b""
    long = b"a" * LONGEST_LINE
    assert marked.feed(long) == b""
    assert marked.feed(long + b"b") == 2 * (b"[planner] " + long + b"\n")
    assert marked.rest() == b"[planner] b\n"
