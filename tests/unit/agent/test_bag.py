"""Bags read offline, without ROS: db3 and mcap, whole, cut off, damaged, and with a clock that was set back."""

import json
import sqlite3
import struct
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import zstandard
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from fogspec.agent import bag, player, stamps

STORE = get_typestore(Stores.ROS2_JAZZY)
IMU, POSE = "sensor_msgs/msg/Imu", "geometry_msgs/msg/PoseStamped"
ANY_ORDER = "std_msgs/msg/Float64"


def header(stamp_s: float) -> Any:
    time = STORE.types["builtin_interfaces/msg/Time"](sec=int(stamp_s), nanosec=round(stamp_s % 1 * 1e9))
    return STORE.types["std_msgs/msg/Header"](stamp=time, frame_id="")


def imu(stamp_s: float) -> bytes:
    point = STORE.types["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
    turn = STORE.types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
    import numpy as np

    zeros = np.zeros(9)
    message = STORE.types[IMU](
        header=header(stamp_s), orientation=turn, orientation_covariance=zeros, angular_velocity=point,
        angular_velocity_covariance=zeros, linear_acceleration=point, linear_acceleration_covariance=zeros,
    )  # fmt: skip
    return bytes(STORE.serialize_cdr(message, IMU))


def pose(stamp_s: float, x: float) -> bytes:
    point = STORE.types["geometry_msgs/msg/Point"](x=x, y=0.0, z=0.0)
    turn = STORE.types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
    whole = STORE.types["geometry_msgs/msg/Pose"](position=point, orientation=turn)
    return bytes(STORE.serialize_cdr(STORE.types[POSE](header=header(stamp_s), pose=whole), POSE))


class Packed(Writer):
    """Writes messages that are compressed one by one, if `mode` says so."""

    mode = CompressionMode.NONE

    def open(self) -> None:
        if self.mode is not CompressionMode.NONE:
            self.set_compression(self.mode, CompressionFormat.ZSTD)
        super().open()


def record(path: Path, plugin: StoragePlugin, count: int = 20, jump_at: int | None = None) -> Path:
    """Requests every 125 ms, each answered after 20 ms; x is the number of the answer. Clock set back an hour at `jump_at`."""
    with Packed(path, version=9, storage_plugin=plugin) as writer:
        asked = writer.add_connection("/imu", IMU, typestore=STORE)
        answered = writer.add_connection("/pose", POSE, typestore=STORE)
        for i in range(count):
            back_s = 3600 if jump_at is not None and i >= jump_at else 0
            at_s = 1e9 + i * 0.125 - back_s
            writer.write(asked, round(at_s * 1e9), imu(at_s))
            if i == 7:
                continue  # nobody answers this one
            answered_s = at_s + 0.02 - (3600 if jump_at == i + 1 else 0)
            writer.write(answered, round(answered_s * 1e9), pose(at_s, float(i)))
    return path


def read(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *more: str
) -> tuple[list[dict[str, Any]], str | None]:
    """The records, and what the command ended with."""
    timings = tmp_path / "timings.jsonl"
    monkeypatch.setenv("FOGSPEC_TIMINGS", str(timings))
    said = None
    try:
        bag.main(["--bag", str(path), "--request", "/imu", "--response", "/pose", *more])
    except SystemExit as end:
        said = str(end.code)
    text = timings.read_text() if timings.exists() else ""
    return [json.loads(line) for line in text.splitlines()], said


BOTH = pytest.mark.parametrize("plugin", list(StoragePlugin))


@BOTH
def test_latencies_and_what_was_lost(tmp_path, monkeypatch, plugin):
    records, said = read(record(tmp_path / "run", plugin), tmp_path, monkeypatch, "--timeout", "0.5")
    assert said is None
    good = [one for one in records if one["ok"]]
    assert len(good) == 19
    assert all(abs(one["latency_s"] - 0.02) < 1e-6 and abs(one["service_s"] - 0.02) < 1e-6 for one in good)
    (lost,) = [one for one in records if not one["ok"]]
    assert (lost["lost"], lost["stamp"]) == (True, [1000000000, 875000000])


@BOTH
def test_conditions_and_metrics_without_ros(tmp_path, monkeypatch, plugin):
    more = ["--success", "pose.position.x < 5", "--metric", "far=/pose:pose.position.x"]
    records, said = read(record(tmp_path / "run", plugin), tmp_path, monkeypatch, *more)
    assert said is None
    answered = [one for one in records if one.get("ok") is not None and not one.get("lost")]
    assert [one["ok"] for one in answered] == [True] * 5 + [False] * 14
    assert answered[5]["reason"] == "pose.position.x < 5 does not hold: it is 5.0"
    assert [one["metric"]["far"] for one in records if "metric" in one] == [float(i) for i in range(20) if i != 7]


@BOTH
def test_the_paper_s_heuristic_warns_offline_too(tmp_path, monkeypatch, plugin):
    records, _ = read(record(tmp_path / "run", plugin), tmp_path, monkeypatch, "--match", "last_response")
    assert "found the node idle" in records[-1]["warning"]


@pytest.mark.slow
@BOTH
def test_a_bag_that_is_cut_off_gives_what_is_before_the_cut(tmp_path, monkeypatch, plugin):
    path = record(tmp_path / "run", plugin, count=9000)
    (file,) = [file for file in path.iterdir() if file.suffix in (".db3", ".mcap")]
    content = file.read_bytes()
    file.write_bytes(content[: len(content) * 6 // 10])
    (path / "metadata.yaml").unlink()
    records, said = read(path, tmp_path, monkeypatch)
    assert f"{file} is damaged or cut off after " in said
    assert records[-1] == {"warning": said}
    assert plugin is StoragePlugin.SQLITE3 or sum(one.get("ok", False) for one in records) > 100


@pytest.mark.parametrize("name", ["run.mcap", "run.db3"])
@pytest.mark.parametrize("content", [b"", b"\x89MCAP0\r\n", b"SQLite format 3\0" + b"\0" * 500, b"nonsense" * 99])
def test_files_that_are_no_bags(tmp_path, monkeypatch, name, content):
    (tmp_path / name).write_bytes(content)
    records, said = read(tmp_path / name, tmp_path, monkeypatch)
    assert said
    assert "Traceback" not in said
    assert not [one for one in records if "ok" in one]


def test_what_is_not_there_or_empty_or_compressed(tmp_path, monkeypatch):
    assert "is not there" in read(tmp_path / "none", tmp_path, monkeypatch)[1]
    (tmp_path / "empty").mkdir()
    assert "holds no .db3 or .mcap file" in read(tmp_path / "empty", tmp_path, monkeypatch)[1]
    (tmp_path / "empty" / "run_0.db3.zstd").write_bytes(b"x")
    assert "run zstd -d --rm" in read(tmp_path / "empty", tmp_path, monkeypatch)[1]
    (tmp_path / "text.txt").write_bytes(b"x")
    assert "must be a folder that rosbag2 wrote" in read(tmp_path / "text.txt", tmp_path, monkeypatch)[1]


@BOTH
def test_messages_that_are_compressed_one_by_one_are_unpacked(tmp_path, monkeypatch, plugin):
    """As rosbag2 compresses them: whatever the metadata say, a message never begins like a frame of zstd."""
    plain = [*bag.messages(record(tmp_path / "plain", plugin))]
    monkeypatch.setattr(Packed, "mode", CompressionMode.MESSAGE)
    record(tmp_path / "packed", plugin)
    assert [*bag.messages(tmp_path / "packed")] == plain
    stored = b"".join(path.read_bytes() for path in bag.storage_files(tmp_path / "packed"))
    assert bag.ZSTD in stored, "it is compressed"
    (tmp_path / "packed" / "metadata.yaml").unlink()
    records, end = read(tmp_path / "packed", tmp_path, monkeypatch)
    assert (end, len([one for one in records if one.get("ok")])) == (None, 19)


@pytest.mark.parametrize(("data", "why"), [
    (bag.ZSTD + b"\x20\x05" + b"\xff" * 20, "damaged"), (bag.ZSTD, "damaged"), (b"(\xb5/\xfd\x00X", "does not say its size"),
    (zstandard.compress(b"\0" * 99)[:-5], "damaged"),
])  # fmt: skip
def test_a_damaged_compressed_message_is_told(data, why):
    with pytest.raises(bag.BagError, match=why):
        bag._unpacked(data, Path("run.db3"))


OLD = "- history: 3\n  depth: 0\n  reliability: {}\n  durability: {}\n"
NEW = "- history: unknown\n  depth: 0\n  reliability: {}\n  durability: {}\n  liveliness: automatic\n"


@pytest.mark.parametrize(("recorded", "offered"), [
    ("", (True, False)), ("[]", (True, False)),
    (OLD.format(1, 2), (True, False)), (OLD.format(2, 2), (False, False)), (OLD.format(1, 1), (True, True)),
    (NEW.format("reliable", "volatile"), (True, False)), (NEW.format("best_effort", "volatile"), (False, False)),
    (NEW.format("reliable", "transient_local") * 2, (True, True)),
    (NEW.format("reliable", "volatile") + NEW.format("best_effort", "volatile"), (True, False)),
    (NEW.format("reliable", "volatile") + NEW.format("reliable", "transient_local"), (True, False)),
])  # fmt: skip
def test_qualities_are_offered_as_rosbag2_offers_them(recorded, offered):
    """rosbag2_transport: one offer is offered again; where several differ, the default one, reliable and volatile."""
    assert bag.offers(recorded) == offered


@BOTH
def test_the_offers_are_in_the_bag(tmp_path, plugin):
    best = Qos(
        QosHistory.KEEP_LAST, 5, QosReliability.BEST_EFFORT, QosDurability.TRANSIENT_LOCAL, QosTime(0, 0), QosTime(0, 0),
        QosLiveliness.AUTOMATIC, QosTime(0, 0), False,
    )  # fmt: skip
    with Writer(tmp_path / "run", version=9, storage_plugin=plugin) as writer:
        one = writer.add_connection("/imu", IMU, typestore=STORE, offered_qos_profiles=[best])
        writer.write(one, 1, imu(1))
    (message,) = bag.messages(tmp_path / "run")
    assert bag.offers(message.offered) == (False, True)


class Fields:
    """A type as rclpy shows it."""

    def __init__(self, **fields: str) -> None:
        self.fields = fields

    def get_fields_and_field_types(self) -> dict[str, str]:
        return self.fields


def test_headers_are_moved_wherever_they_are(monkeypatch):
    """As in tf2_msgs/msg/TFMessage, nav_msgs/msg/Path and a type without any."""
    types = {
        "geometry_msgs/msg/TransformStamped": Fields(header="std_msgs/Header", child_frame_id="string"),
        "geometry_msgs/msg/Pose": Fields(x="double", list="sequence<double, 5>"),
        "geometry_msgs/msg/PoseStamped": Fields(header="std_msgs/Header", pose="geometry_msgs/Pose"),
    }
    monkeypatch.setattr(stamps, "type_of", types.__getitem__)
    tf = stamps.headers(Fields(transforms="sequence<geometry_msgs/TransformStamped>"))
    assert tf == {"transforms": {"header": None}}
    path = stamps.headers(
        Fields(header="std_msgs/Header", poses="geometry_msgs/PoseStamped[3]", x="geometry_msgs/Pose")
    )
    assert path == {"header": None, "poses": {"header": None}}
    assert stamps.headers(Fields(data="sequence<uint8>", pose="geometry_msgs/Pose")) == {}
    transforms = [SimpleNamespace(header=header(at_s)) for at_s in (1.5, 0, 2.25)]
    stamps.shift(SimpleNamespace(transforms=transforms), tf, -250_000_000)
    said = [(one.header.stamp.sec, one.header.stamp.nanosec) for one in transforms]
    assert said == [(1, 250_000_000), (0, 0), (2, 0)]


def test_a_moved_stamp_stays_one_that_a_message_can_say():
    assert stamps.shifted((5, 0), -10 * 10**9) == (0, 0)
    assert stamps.shifted((-5, 0), 10 * 10**9) == (5, 0)
    assert stamps.shifted((2**31 - 1, 0), 10**9) == (2**31 - 1, 0)
    assert stamps.shifted((0, 0), 10**9) is None


@BOTH
def test_topics_that_the_bag_does_not_have_and_fields_that_the_type_does_not_have(tmp_path, monkeypatch, plugin):
    path = record(tmp_path / "run", plugin)
    assert "has no message of /other" in read(path, tmp_path, monkeypatch, "--response", "/other")[1]
    assert "has no field" in read(path, tmp_path, monkeypatch, "--success", "nothing == 1")[1]


@BOTH
def test_a_clock_that_is_set_back_spoils_only_the_requests_that_were_open(tmp_path, monkeypatch, plugin):
    records, said = read(record(tmp_path / "run", plugin, jump_at=12), tmp_path, monkeypatch)
    assert said is None
    assert all(0 <= one["latency_s"] < 0.03 for one in records if one.get("ok"))
    assert [one["reason"] for one in records if one.get("ok") is False] == ["the recorder's clock was set back"] * 2
    assert sum(one.get("ok", False) for one in records) == 18


def test_a_bag_of_another_sample_is_not_read(tmp_path, monkeypatch):
    path = record(tmp_path / "run", StoragePlugin.MCAP)
    monkeypatch.setenv("FOGSPEC_BEGUN", str(time.time() + 60))
    records, said = read(path, tmp_path, monkeypatch)
    assert said == f"{path} was recorded before this sample began"
    assert records == [{"warning": said}]


def test_stamps_need_a_header(tmp_path, monkeypatch):
    path = tmp_path / "run"
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/imu", ANY_ORDER, typestore=STORE)
        writer.write(connection, 1, b"\0\1\0\0" + struct.pack("<d", 3.0))
    said = read(path, tmp_path, monkeypatch)[1]
    assert (
        said == "/imu carries std_msgs/msg/Float64, which does not begin with a std_msgs/Header: match by order instead"
    )


def test_files_of_a_split_bag_are_read_in_their_order(tmp_path):
    for i in (10, 9, 1):
        (tmp_path / f"run_{i}.mcap").touch()
    assert [file.name for file in bag.storage_files(tmp_path)] == ["run_1.mcap", "run_9.mcap", "run_10.mcap"]


def test_older_bags_without_definitions_are_read(tmp_path, monkeypatch):
    path = record(tmp_path / "run", StoragePlugin.SQLITE3)
    (file,) = path.glob("*.db3")
    with sqlite3.connect(file) as base:
        base.execute("DROP TABLE message_definitions")
    records, said = read(path, tmp_path, monkeypatch, "--success", "pose.position.x >= 0")
    assert (said, sum(one["ok"] for one in records)) == (None, 19)


def test_the_bag_is_cut_into_turns_that_end_with_a_request(tmp_path):
    path = record(tmp_path / "run", StoragePlugin.MCAP, count=3)
    found = player.turns(path, "/imu", others=True)
    assert [[message.topic for message in turn.before] for turn in found] == [[], ["/pose"], ["/pose"]]
    with pytest.raises(bag.BagError, match="has no message of /nothing"):
        player.turns(path, "/nothing", others=True)


def test_it_is_played_there_and_back():
    order = player.there_and_back(4)
    assert [next(order) for _ in range(13)] == [0, 1, 2, 3, 2, 1, 0, 1, 2, 3, 2, 1, 0]
    alone = player.there_and_back(1)
    assert [next(alone) for _ in range(3)] == [0, 0, 0]
