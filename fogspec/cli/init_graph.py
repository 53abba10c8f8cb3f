"""The part of `fogspec init` that looks at a robot that runs: start the agent's watcher, read what it saw, record a bag."""

import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fogspec.base import child
from fogspec.base.console import note, say
from fogspec.base.errors import CloudError, InvalidInput, UsageError

if TYPE_CHECKING:
    from fogspec.base.project_files import ProjectFiles
    from fogspec.importers.graph.observed import Observed
    from fogspec.importers.graph.proposal import Proposal

MOST_S = 600.0
PATIENCE_S = 60.0  # discovery, parameters, and the start of Python
MOST_BAG_BYTES = 512 << 20


def seconds_of(text: str | None, option: str) -> float | None:
    """Return a duration such as `30s`, None without one; raise UsageError."""
    from fogspec.base.units import parse_duration_s
    from fogspec.cli.options import quantity

    if text is None:
        return None
    seconds = quantity(option, text, parse_duration_s)
    if not 1 <= seconds <= MOST_S:
        raise UsageError(f"{option} must be between 1 s and {MOST_S / 60:g} min, and is {text}")
    return seconds


def observe(seconds: float) -> "Observed":
    """Watch the robot on this computer's ROS graph; raise InvalidInput without ROS 2 or nodes, CloudError if it failed."""
    from fogspec.importers.graph.observed import read_observed

    with tempfile.TemporaryDirectory(prefix="fogspec-watch-") as folder:
        out = Path(folder) / "robot.json"
        with watcher(folder, "--for", str(seconds), "--out", str(out), seconds=seconds):
            return read_observed(out)


def record(topics: list[str], seconds: float, folder: Path, files: "ProjectFiles") -> None:
    """Record topics into a new folder; raise InvalidInput if nothing came. A bag that did not become whole is removed."""
    part = folder.with_name(f".{folder.name}.part")
    files.make_folder(folder.parent)
    files.remove_tree(part)
    words = [word for topic in topics for word in ("--topic", topic)]
    try:
        with tempfile.TemporaryDirectory(prefix="fogspec-watch-") as temporary:
            whole = ["--bag", str(part.absolute() / folder.name), "--bytes", str(MOST_BAG_BYTES), *words]
            with watcher(temporary, "--for", str(seconds), *whole, seconds=seconds):
                files.move(part / folder.name, folder)
    finally:
        files.remove_tree(part)


@contextmanager
def watcher(folder: str, *words: str, seconds: float) -> Iterator[None]:
    """Run the agent's watcher to its end, in a Python that has rclpy; raise InvalidInput or CloudError with its reason."""
    from fogspec.compile.agent_archive import agent_archive

    archive = Path(folder) / "agent.pyz"
    archive.write_bytes(agent_archive())
    try:
        ended = subprocess.run(
            [sys.executable, str(archive), "watch", *words],
            cwd=child.ELSEWHERE,
            env=child.environment(),
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=seconds + PATIENCE_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise CloudError(
            f"the watcher did not end within {seconds + PATIENCE_S:g} s: the robot may be overloaded"
        ) from None
    if ended.returncode != 0:
        said = ended.stderr.decode("utf-8", "replace").strip().splitlines() or ["it ended without a reason"]
        raise InvalidInput(
            f"the robot was not watched: {said[-1]}",
            "run it on the robot, or on a computer in its network, with ROS 2 sourced: . /opt/ros/jazzy/setup.sh",
            "or on the robot without fogspec: python3 agent.pyz watch --out robot.json; here: --observed robot.json",
        )
    yield


def first_of(name: str, proposal: "Proposal") -> dict[str, Any]:
    """Return the values of a first spec, with what the robot showed in place of what `init` makes up."""
    from fogspec.importers.scaffold import first_data, with_image

    data = first_data(name)
    spec, found = data["spec"], dict(proposal.spec)
    del spec["benchmark"]["workload"]
    limits, transfer = found.pop("limits", {}), found.pop("transfer", None)
    order = ("cloud", "robot", "ros", "probe")
    left_out = order if "robot" in found else (*order, "connectivity")
    rest = {key: value for key, value in spec.items() if key not in left_out}
    probe = {"probe": found.get("probe", spec["probe"])}
    data["spec"] = {**{key: found[key] for key in order[:-1] if key in found}, **probe, **rest}
    data["spec"]["ros"] = with_image(data["spec"]["ros"], data["spec"]["infra"])
    data["spec"]["constraints"] |= limits
    if transfer:
        data["spec"]["objective"]["transfer"] = transfer
    return data


def check_options(launch: str | None, graph: bool, record: str | None, observed: Path | None) -> None:
    """Raise UsageError for options that exclude each other."""
    if sum(map(bool, (launch, graph, observed))) > 1:
        raise UsageError("--from-launch, --from-graph and --observed are three sources, and a spec has one")
    if record is not None and not graph:
        raise UsageError("--record needs a robot that runs", "add --from-graph")


def from_graph(
    name: str,
    folder: Path,
    files: "ProjectFiles",
    watch: str,
    record_for: str | None,
    observed: Path | None,
) -> tuple[dict[str, Any], list[str]]:
    """Return the values of the spec and the lines of its head; the bag of the workload is below `folder`.

    Raise UsageError, InvalidInput and CloudError. Only the bag is written.
    """
    from fogspec.importers.graph.observed import read_observed
    from fogspec.importers.graph.proposal import propose
    from fogspec.importers.scaffold import workspace_of

    seconds, record_s = seconds_of(watch, "--watch"), seconds_of(record_for, "--record")
    bag = Path("data") / name
    if record_s and (folder / bag).exists():
        raise UsageError(f"{folder / bag} is there already", "name another application, or remove it")
    if observed is None:
        note(f"watching the robot for {watch}: nothing on it is changed")
    seen = read_observed(observed) if observed else observe(seconds or 0.0)
    proposal = propose(seen)
    data = first_of(name, proposal)
    for line in proposal.lines:
        say(line)
    note(f"watching took {seen.overhead.cpu:.1%} of a core and {seen.overhead.bytes / 1e6:.3g} MB")
    if record_s and proposal.record:
        record(proposal.record, record_s, folder / bag, files)
        say(f"{folder / bag}: {', '.join(proposal.record)}, recorded as the workload")
        data["spec"]["benchmark"]["workload"] = {"bag": bag.as_posix()}
    elif record_s:
        proposal.warnings.append("nothing was recorded: the probe has no request topic")
    if "workspace" in data["spec"]["ros"]:
        data["spec"]["ros"]["workspace"], copied = workspace_of(proposal.programs, folder)
        proposal.warnings += copied
    proposal.warnings += without_invalid(data)
    if guessed := guess(data, seen, proposal):
        proposal.lines.append(guessed)
        say(guessed)
    for warning in proposal.warnings:
        note(f"note: {warning}")
    return data, ["From a robot that ran:", *proposal.lines]


def guess(data: dict[str, Any], seen: "Observed", proposal: "Proposal") -> str | None:
    """Return a first machine by the machine library, as a line of text; None if too little is known of robot or machines."""
    from fogspec.catalog.sources import default_origin, load_catalog
    from fogspec.importers.scaffold import first_text
    from fogspec.language.loader import check_text
    from fogspec.model.first_guess import Robot, first_guess
    from fogspec.model.library import built_in

    loaded, machine = check_text(first_text(data, "", []).encode(), "spec")[0], seen.machine
    if not loaded or proposal.latency_s is None or machine.vcpus is None or machine.memory_gib is None:
        return None
    spec = loaded[0].application.spec
    robot = Robot(
        vcpus=machine.vcpus,
        memory_gib=machine.memory_gib,
        arch=machine.arch or "",
        cpu=machine.cpu or "",
        latency_s=proposal.latency_s,
        used_gib=proposal.memory_gib or 0.0,
    )
    clouds = sorted({entry.partition("/")[0] for entry in spec.infra})
    found = first_guess(built_in(), spec, robot, load_catalog(default_origin(clouds), clouds))
    return found.line() if found else None


def without_invalid(data: dict[str, Any]) -> list[str]:
    """Remove what a spec refuses, such as a password among parameters, node by node; return what was removed."""
    from fogspec.importers.scaffold import first_text
    from fogspec.language.loader import check_text

    def wrong() -> list[str]:
        found = check_text(first_text(data, "", []).encode(), "spec")[1]
        return [one.message for one in found if one.severity == "error"]

    removed: list[str] = []
    for role in ("cloud", "robot"):
        for node in list(data["spec"].get(role, [])):
            name = node.get("name") or node.get("executable") or node["cmd"][0]
            named = wrong()
            for key in list(node.get("parameters", {})):
                if said := [one for one in named if f".parameters.{key} " in one]:
                    del node["parameters"][key]
                    removed.append(f"parameter {key} of {name} is left for you: {said[0]}")
            for part in ("parameters", "remappings", "arguments"):
                before = wrong()
                if before and (kept := node.pop(part, None)):
                    if len(wrong()) < len(before):
                        removed.append(f"{part} of {name} are left for you: {before[0]}")
                    else:
                        node[part] = kept
            if role == "robot" and (before := wrong()):
                data["spec"]["robot"].remove(node)
                if len(wrong()) < len(before):
                    removed.append(f"{name} is left for you: {before[0]}")
                else:
                    data["spec"]["robot"].append(node)
    if not data["spec"].get("robot", [None]):
        del data["spec"]["robot"]
    return removed
