"""Write messages into a bag of rosbag2, with the standard library alone."""

import os
import sqlite3
from pathlib import Path


class Bag:
    """A bag of rosbag2 in one sqlite3 file; complete once it has its metadata."""

    def __init__(self, folder: Path, most_bytes: int) -> None:
        self.folder, self.most_bytes = folder, most_bytes
        folder.mkdir(parents=True)
        self.file = folder / f"{folder.name}_0.db3"
        self.base = sqlite3.connect(self.file)
        self.base.executescript(
            "CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL);"
            "CREATE TABLE metadata(id INTEGER PRIMARY KEY, metadata_version INTEGER NOT NULL, metadata TEXT NOT NULL);"
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,"
            " serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL, type_description_hash TEXT NOT NULL);"
            "CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT NOT NULL, encoding TEXT NOT NULL,"
            " encoded_message_definition TEXT NOT NULL, type_description_hash TEXT NOT NULL);"
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL,"
            " data BLOB NOT NULL);"
            "CREATE INDEX timestamp_idx ON messages (timestamp ASC);"
        )
        self.base.execute("INSERT INTO schema VALUES (4, ?)", (os.environ.get("ROS_DISTRO") or "jazzy",))
        self.topics: dict[str, tuple[int, str]] = {}
        self.counts: dict[str, int] = {}
        self.bytes, self.first_ns, self.last_ns = 0, 0, 0

    def add(self, topic: str, kind: str) -> int:
        """Add a topic; return its number."""
        number = len(self.topics) + 1
        self.topics[topic], self.counts[topic] = (number, kind), 0
        self.base.execute("INSERT INTO topics VALUES (?, ?, ?, 'cdr', '', '')", (number, topic, kind))
        return number

    def write(self, topic: str, _has_header: bool, data: bytes, at_ns: int) -> None:
        """Add a message, unless the bag is full."""
        if self.full(len(data)):
            self.bytes = self.most_bytes
            return
        self.bytes += len(data)
        self.first_ns = min(self.first_ns or at_ns, at_ns)
        self.last_ns = max(self.last_ns, at_ns)
        self.counts[topic] += 1
        self.base.execute(
            "INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", (self.topics[topic][0], at_ns, data)
        )

    def full(self, more: int = 0) -> bool:
        """Return whether there is no room."""
        return self.bytes + more >= self.most_bytes

    def close(self) -> None:
        """Write what rosbag2 wants to know first."""
        self.base.commit()
        self.base.close()
        kept = [
            f"    - topic_metadata: {{name: {name}, type: {kind}, serialization_format: cdr, offered_qos_profiles: ''}}\n"
            f"      message_count: {self.counts[name]}\n"
            for name, (_, kind) in self.topics.items()
        ]
        (self.folder / "metadata.yaml").write_text(
            "rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: sqlite3\n"
            f"  relative_file_paths: [{self.file.name}]\n  duration: {{nanoseconds: {self.last_ns - self.first_ns}}}\n"
            f"  starting_time: {{nanoseconds_since_epoch: {self.first_ns}}}\n"
            f"  message_count: {sum(self.counts.values())}\n  topics_with_message_count:\n{''.join(kept)}"
            "  compression_format: ''\n  compression_mode: ''\n"
        )
