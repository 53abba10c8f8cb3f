from pathlib import Path

from tests.tools import size


def test_what_is_counted(tmp_path: Path) -> None:
    room = tmp_path / "fogspec" / "room"
    room.mkdir(parents=True)
    (room / "one.py").write_text("import os\n\nif os:\n    x = 1\n")
    assert size.rooms(tmp_path / "fogspec") == {"room": (1, 4, 3)}
    schema = {
        "properties": {"a": {"$ref": "#/$defs/B"}},
        "$defs": {"B": {"properties": {"properties": {"type": "string"}}}},
    }
    assert size.keys(schema) == {"a", "properties"}


def test_each_command_has_the_two_options_of_verbosity() -> None:
    assert all(count >= 2 for count in size.options().values())
