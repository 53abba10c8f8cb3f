"""Bags read offline, without ROS: db3 and mcap, whole, cut off, damaged, and with a clock that was set back."""

import json
import sqlite3
import struct
import time
from pathlib import Path
from typing import Any

import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from fogspec.agent import bag, player

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


def record(path: Path, plugin: StoragePlugin, count: int = 20, jump_at: int | None = None) -> Path:
    """Requests every 125 ms, each answered after 20 ms; x is the number of the answer. Clock set back an hour at `jump_at`."""
    with Writer(path, version=9, storage_plugin=plugin) as writer:
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
    assert "ros2 bag convert" in read(tmp_path / "empty", tmp_path, monkeypatch)[1]
    (tmp_path / "text.txt").write_bytes(b"x")
    assert "must be a folder that rosbag2 wrote" in read(tmp_path / "text.txt", tmp_path, monkeypatch)[1]


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
