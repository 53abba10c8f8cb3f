"""Read recorded bags (rosbag2: db3 and mcap) without ROS, and time the requests in them.

    python3 agent.pyz bag --bag data/run --request /camera/color/image --response /RGBD/pose --match stamp

Times are those of the recorder. db3 needs the standard library, mcap the PyPI package `mcap`, and conditions and metrics
on fields of messages the PyPI package `rosbags`. A truncated bag is read up to its end.
"""

import argparse
import contextlib
import os
import re
import sqlite3
import sys
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from .matching import Matcher, stamp_of
from .records import Condition, Done, Writer, field_of

# Set-up installs the packages of this module here; last on the path, so that the machine's own packages win.
INSTALLED = os.path.expanduser("~/.fogspec/python")
sys.path.append(INSTALLED)
MOST_BYTES = 2**30  # of a message
HEADER_FIRST = re.compile(r"(?:\s*(?:#.*)?\n)*\s*(?:std_msgs/(?:msg/)?)?Header\s+\w+")
COMPRESSED = (".zstd", ".zst", ".lz4")
ZSTD = b"\x28\xb5\x2f\xfd"  # what a frame begins with (RFC 8878); a message begins with 0, whatever the metadata say
PROFILE = re.compile(r"(reliability|durability): *(\w+)")  # of recorded qualities: numbers before Jazzy, words since
BEST_EFFORT, TRANSIENT_LOCAL = ("2", "best_effort"), ("1", "transient_local")


class BagError(Exception):
    """A bag that cannot be read, or not to its end."""


@dataclass(frozen=True)
class Message:
    """One recorded message.

    `kind` is `package/msg/Name`, `at_s` the time of recording, `data` the CDR, `definition` the text of the type if the
    bag contains it, and `offered` the qualities of those that published the topic, as YAML.
    """

    topic: str
    kind: str
    at_s: float
    data: bytes
    definition: str = ""
    offered: str = ""


def offers(recorded: str) -> tuple[bool, bool]:
    """Return whether a topic was offered reliably and latched, or as `ros2 bag play` has it where offers differ."""
    found = PROFILE.findall(recorded)
    reliable = {value not in BEST_EFFORT for what, value in found if what == "reliability"}
    latched = {value in TRANSIENT_LOCAL for what, value in found if what == "durability"}
    same = len(reliable) == len(latched) == 1
    return (reliable.pop(), latched.pop()) if same else (True, False)


def messages(path: Path, topics: Collection[str] | None = None) -> Iterator[Message]:
    """Yield the messages of the bag, or of some of its topics, in the order of recording.

    Raise BagError: immediately for something that is not a bag, after the last readable message for a truncated one.
    """
    for file in storage_files(path):
        read = _read_db3 if file.suffix == ".db3" else _read_mcap
        for message in read(file, topics):
            yield replace(message, data=_unpacked(message.data, file)) if message.data[:4] == ZSTD else message


def _unpacked(data: bytes, file: Path) -> bytes:
    try:
        import zstandard
    except ImportError as problem:
        raise BagError(f"{file} is compressed: it needs the PyPI package zstandard") from problem
    try:
        if not 0 <= zstandard.frame_content_size(data) <= MOST_BYTES:
            raise BagError(f"{file} has a compressed message that does not say its size")
        return zstandard.ZstdDecompressor().decompress(data)
    except zstandard.ZstdError as problem:
        raise BagError(f"{file} has a compressed message that is damaged: {problem}") from problem


def storage_files(path: Path) -> list[Path]:
    """Return the files that contain the messages, in order; raise BagError if there are none."""
    if not path.exists():
        raise BagError(f"the bag {path} is not there")
    found = [path] if path.is_file() else [file for file in path.iterdir() if file.suffix in (".db3", ".mcap")]
    if not found and any(file.suffix in COMPRESSED for file in path.iterdir()):
        raise BagError(f"{path} is compressed file by file: run zstd -d --rm {path}/*.zst*")
    if not found:
        raise BagError(f"{path} holds no .db3 or .mcap file")
    if found[0].suffix not in (".db3", ".mcap"):
        raise BagError(f"{path} must be a folder that rosbag2 wrote, or its .db3 or .mcap file")
    return sorted(
        found, key=lambda file: [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", file.name)]
    )


def recorded_since(path: Path, started_s: float) -> None:
    """Raise BagError for a bag that is older than this sample, and so has another sample's times."""
    if all(file.stat().st_mtime < started_s for file in storage_files(path)):
        raise BagError(f"{path} was recorded before this sample began")


def _read_db3(file: Path, topics: Collection[str] | None) -> Iterator[Message]:
    count = 0
    try:
        with contextlib.closing(sqlite3.connect(f"file:{file}?mode=ro", uri=True)) as base:
            listed = "SELECT id, name, type, '' FROM topics"  # before Foxy
            if "offered_qos_profiles" in [row[1] for row in base.execute("PRAGMA table_info(topics)")]:
                listed = "SELECT id, name, type, offered_qos_profiles FROM topics"
            kinds = {row[0]: row[1:] for row in base.execute(listed)}
            definitions: dict[str, str] = {}
            with contextlib.suppress(sqlite3.OperationalError):  # not before Iron
                definitions = dict(
                    base.execute("SELECT topic_type, encoded_message_definition FROM message_definitions")
                )
            for topic, at_ns, data in base.execute("SELECT topic_id, timestamp, data FROM messages ORDER BY id"):
                name, kind, offered = kinds[topic]
                count += 1
                if topics is None or name in topics:
                    yield Message(name, kind, at_ns / 1e9, data, definitions.get(kind, ""), offered or "")
    except (sqlite3.Error, KeyError, TypeError) as problem:
        raise BagError(f"{file} is damaged or cut off after {count} messages: {problem}") from problem


def _read_mcap(file: Path, topics: Collection[str] | None) -> Iterator[Message]:
    try:
        from mcap.exceptions import McapError
        from mcap.records import Channel, Schema
        from mcap.records import Message as Record
        from mcap.stream_reader import StreamReader
    except ImportError as problem:
        raise BagError(f"{file} needs the PyPI package mcap: pip install mcap") from problem
    schemas: dict[int, Any] = {}
    channels: dict[int, Any] = {}
    count = 0
    try:
        with open(file, "rb") as stream:
            for record in StreamReader(stream, record_size_limit=MOST_BYTES).records:
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    channels[record.id] = record
                elif isinstance(record, Record):
                    count += 1
                    channel = channels[record.channel_id]
                    if topics is None or channel.topic in topics:
                        schema = schemas[channel.schema_id]
                        definition = schema.data.decode("utf-8", "replace") if schema.encoding == "ros2msg" else ""
                        offered = channel.metadata.get("offered_qos_profiles", "")
                        yield Message(
                            channel.topic, schema.name, record.log_time / 1e9, record.data, definition, offered
                        )
    # The library does not wrap the errors of its decompressors.
    except (McapError, OSError, ValueError, KeyError, EOFError, AttributeError, RuntimeError) as problem:
        reason = str(problem) or type(problem).__name__
        raise BagError(f"{file} is damaged or cut off after {count} messages: {reason}") from problem


def has_header(message: Message) -> bool | None:
    """Return whether its type begins with a std_msgs/Header; None if the bag has no definition."""
    return bool(HEADER_FIRST.match(message.definition)) if message.definition else None


class Decoder:
    """Deserialise messages without ROS, of types that the bag or ROS 2 Jazzy define; needs the PyPI package `rosbags`."""

    def __init__(self) -> None:
        try:
            from rosbags.typesys import Stores, get_types_from_msg, get_typestore
        except ImportError as problem:
            raise BagError("looking into messages needs the PyPI package rosbags: pip install rosbags") from problem
        self.store, self.types_from = get_typestore(Stores.ROS2_JAZZY), get_types_from_msg

    def decode(self, message: Message) -> Any:
        """Return the message as an object with fields; raise BagError for an unknown type."""
        if message.kind not in self.store.types and message.definition:
            self.store.register(self.types_from(message.definition, message.kind))
        if message.kind not in self.store.types:
            raise BagError(f"{message.topic}: the bag does not define its type {message.kind}")
        return self.store.deserialize_cdr(message.data, message.kind)


class BagTimer:
    """Time the requests of a bag."""

    def __init__(self, options: argparse.Namespace, writer: Writer) -> None:
        self.options, self.writer = options, writer
        self.matcher = Matcher(options.match, options.timeout)
        self.metrics: dict[str, dict[str, str]] = {}
        for text in options.metric:
            name, _, rest = text.partition("=")
            topic, _, path = rest.partition(":")
            self.metrics.setdefault(topic, {})[name] = path
        self.decoder = Decoder() if options.success or self.metrics else None
        self.now_s = float("-inf")
        self.seen: set[str] = set()

    def run(self) -> None:
        """Write a record for each request; raise BagError after the readable messages, ValueError for a wrong field."""
        topics = {self.options.request, self.options.response, *self.metrics}
        for message in messages(Path(self.options.bag), topics):
            self._clock(message.at_s)
            self._take(message)
        for topic in sorted(topics - self.seen):
            raise BagError(f"{self.options.bag} has no message of {topic}")
        self.writer.warning(self.matcher.warning())

    def _clock(self, at_s: float) -> None:
        # Messages of several topics may be recorded slightly out of order.
        if at_s < self.now_s - 0.5:
            for start_s in self.matcher.open.values():
                self.writer.request(Done(start_s, 0.0), "the recorder's clock was set back")
            self.matcher.open.clear()
            self.matcher.departed_s = float("-inf")
        self.now_s = at_s

    def _take(self, message: Message) -> None:
        options = self.options
        if message.topic not in self.seen:
            self.seen.add(message.topic)
            if options.match == "stamp" and message.topic not in self.metrics and has_header(message) is False:
                what = f"{message.topic} carries {message.kind}, which does not begin with a std_msgs/Header"
                raise BagError(f"{what}: match by order instead")
        stamp = stamp_of(message.data) if options.match == "stamp" else None
        if message.topic == options.request:
            for lost in self.matcher.take_request(stamp, message.at_s):
                self.writer.request(lost)
        if message.topic == options.response:
            done = self.matcher.take_response(stamp, message.at_s)
            if done is not None or not self.matcher.was_sent_before(stamp):
                self._respond(message, done)
        if self.decoder is not None and (paths := self.metrics.get(message.topic)):
            decoded = self.decoder.decode(message)
            values = {name: float(field_of(decoded, path)) for name, path in paths.items()}
            self.writer.metric(values, message.at_s, stamp_of(message.data) if has_header(message) else None)

    def _respond(self, message: Message, done: Done | None) -> None:
        if done is None:
            self.writer.unmatched(message.at_s)
        elif done.latency_s is not None and done.latency_s < 0:
            self.writer.request(Done(done.start_s, 0.0), "recorded before its request")
        else:
            condition = self.options.success
            decoded = self.decoder.decode(message) if condition and self.decoder else None
            self.writer.request(done, condition.failure(decoded) if condition else None)


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the records; exit with the reason if the bag cannot be read, after the readable messages."""
    parser = argparse.ArgumentParser(prog="bag", allow_abbrev=False)
    parser.add_argument("--bag", required=True)
    parser.add_argument("--request", required=True)
    parser.add_argument("--response", required=True)
    parser.add_argument("--match", choices=("stamp", "order", "first_request", "last_response"), default="stamp")
    parser.add_argument("--success", type=Condition.parse)
    parser.add_argument("--timeout", type=float)
    parser.add_argument("--metric", action="append", default=[], help="NAME=TOPIC:FIELD")
    options = parser.parse_args(arguments)
    writer = Writer(options.response)
    try:
        recorded_since(Path(options.bag), float(os.environ.get("FOGSPEC_BEGUN", "-inf")))
        BagTimer(options, writer).run()
    except (BagError, ValueError) as problem:
        writer.warning(str(problem))
        sys.exit(str(problem))


if __name__ == "__main__":
    main()
