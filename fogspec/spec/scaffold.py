"""A first spec: valid, commented from the language's own field pages, with a line for the editor."""

import re
from typing import Any

from fogspec.base.text import line as one_line
from fogspec.base.yaml.writer import block, flow
from fogspec.spec.field_docs import FieldPage, pages
from fogspec.spec.launch_import.found import LaunchImport
from fogspec.spec.rules.benchmark import PLACEHOLDER_PACKAGE, PLACEHOLDER_TOPICS
from fogspec.spec.schema import API_VERSION, Application

HINTED = ("metrics", "secrets")
COLUMN = 48


def first_data(name: str, found: LaunchImport | None = None) -> dict[str, Any]:
    """Return the values of a first spec, taken from a launch file if there is one."""
    cloud: list[dict[str, Any]] = [{"package": PLACEHOLDER_PACKAGE, "executable": "my_node"}]
    robot: list[dict[str, Any]] = [{"package": PLACEHOLDER_PACKAGE, "executable": "my_client"}]
    if found is not None:
        cloud, robot = (found.cloud, found.robot) if found.cloud else (found.robot, [])
    spec: dict[str, Any] = {"cloud": cloud}
    if robot:
        spec["robot"] = robot
    if any("package" in node for node in cloud):
        spec["ros"] = {
            "distro": "jazzy",
            "workspace": "ros2_ws",
            **({"setup": found.setup} if found and found.setup else {}),
        }
    spec["probe"] = dict(zip(("request", "response"), PLACEHOLDER_TOPICS, strict=True))
    spec["constraints"] = {"latency": "1s", "cost": "$0.001/request"}
    spec["objective"] = {"alpha": 0.5}
    spec["hardware"] = {"cpus": "2..64", "memory": "4GiB..512GiB", "memory_per_cpu": "2GiB..8GiB", "gpus": ["none"]}
    spec["infra"] = ["aws/us-east-1"]
    spec["benchmark"] = {"budget": "$2.50", "sampler": "adaptive", "stop": {"requests": 200, "duration": "5min"}}
    if found is not None:
        _over(spec, found)
    return {"apiVersion": API_VERSION, "kind": "Application", "metadata": {"name": name}, "spec": spec}


def _over(spec: dict[str, Any], found: LaunchImport) -> None:
    """Replace what a first spec proposes by what the launch file has."""
    if found.constraints:
        spec["constraints"] = found.constraints
    spec["objective"] |= found.objective
    spec["hardware"] |= found.hardware
    spec["benchmark"]["stop"] |= found.stop


def first_text(data: dict[str, Any], schema: str, notes: list[str]) -> str:
    """Return the spec as text: each field's meaning after its first line, omitted fields as hints at the end."""
    book = {page.path: page for page in pages(Application)}
    lines = [f"# yaml-language-server: $schema={one_line(schema)}", *(f"# {one_line(note)}" for note in notes)]
    said: set[str] = set()
    for written, path in block(data):
        # A field without a value is an error, where null means no limit.
        line = written.removesuffix(" null") if written.endswith(": null") else written
        page = _page(book, path)
        meaning = page.meaning if page and page.path not in said else ""
        if page:
            said.add(page.path)
        lines.append(f"{line:<{COLUMN}} # {meaning}" if meaning else line)
    hints = [book[f"spec.{name}"] for name in HINTED if name not in data["spec"]]
    lines += [f"{_hint(page):<{COLUMN}} # {page.meaning}" for page in hints]
    return "\n".join(line.rstrip() for line in lines) + "\n"


def _page(book: dict[str, FieldPage], path: tuple[str | int, ...]) -> FieldPage | None:
    text = "".join("[]" if isinstance(step, int) else f".{step}" for step in path).lstrip(".")
    return book.get(text)


def _hint(page: FieldPage) -> str:
    return f"  # {page.path.rpartition('.')[2]}: {flow(page.example)}"


def name_from(text: str) -> str:
    """Return an application's name made from the name of a file or directory."""
    stem = re.sub(r"(\.launch)?(\.sky)?\.(py|xml|ya?ml|launch)$", "", text.lower())
    return re.sub(r"[^a-z0-9]+", "-", stem).strip("-")[:63].strip("-") or "my-application"
