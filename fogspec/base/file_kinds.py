"""What a path may lead to besides a file: reading a pipe or a device may wait for ever, or never end."""

import stat

KINDS = (
    (stat.S_ISDIR, "it is a folder"), (stat.S_ISFIFO, "it is a pipe"), (stat.S_ISSOCK, "it is a socket"),
    (stat.S_ISCHR, "it is a device"), (stat.S_ISBLK, "it is a device"),
)  # fmt: skip


def not_a_file(mode: int) -> str | None:
    """Why nothing can be read from what has this `st_mode`, or written over it; None for a file."""
    return next((f"{what}, not a file" for is_one, what in KINDS if is_one(mode)), None)
