"""The constraints of the paper's launch interface (FogROS2-Config, Listing 1), as fields of the spec.

A constraint that is not understood leaves its field empty, which `validate` rejects: never a default in its place.
"""

import re
import sys
from collections.abc import Sequence
from typing import Any

from fogspec.base.units import format_duration
from fogspec.importers.launch.found import Started


class Unread:
    """A value that only a launch would determine."""


UNREAD = Unread()
UNREADABLE = "the constraints cannot be read: latency and cost are left empty, write them into the spec"
# FogROS2's latency analyser names what the spec's probe times.
PROBE = {"request_topic_name": "request", "response_topic_name": "response", "heuristic_mode": "match"}
BOUND = re.compile(r"(min|max)(imum)?(num)?v?(cpus?|memory|mem|ram)(gib|gb)?")
RATIO = re.compile(r"(min|max)(imum)?(memory|mem|ram)(per|to)?v?cpu(ratio)?")
GPUS = ("gpu", "gpus", "gputype", "gputypes", "accelerators")
MACHINES = ("machine", "machines", "machinetype", "machinetypes", "instancetype", "instancetypes")
# What a constraint of another name may be about.
ABOUT = {
    r"lat|time|delay|deadline|second": ("constraints", "latency"),
    r"cost|price|budget|usd|dollar|cent": ("constraints", "cost"),
    r"cpu|core": ("hardware", "cpus"),
    r"mem|ram|gib|gb": ("hardware", "memory"),
    r"gpu|accel|cuda": ("hardware", "gpus"),
    r"machine|instance": ("hardware", "allow"),
}
LIMITS = [("constraints", "latency"), ("constraints", "cost")]


def is_constraint(key: str) -> bool:
    """Return whether a keyword of SkyLaunchDescription is a constraint: they may be written without a dictionary."""
    return _field_of(_plain(key)) is not None


def may_be_constraint(key: str) -> bool:
    """Return whether a keyword of an unknown name may be meant as a constraint."""
    return any(re.search(words, _plain(key)) for words in ABOUT)


def take_constraint(found: Started, key: str, value: Any) -> str | None:
    """Import one constraint; return what to report of it, None if it was read without loss.

    Numbers have the paper's units: seconds, GiB, and cents per request.
    """
    name = _plain(key)
    where = _field_of(name)
    if where is None:
        about = [field for words, field in ABOUT.items() if re.search(words, name)] or LIMITS
        for part, field in about:
            getattr(found, part).setdefault(field)
        names = " and ".join(field for _, field in about)
        return f"constraint {key} is not known to fogspec: {names}, where nothing else says it, is left empty: write it there"
    part, field = where
    words = _words(value) if field in ("gpus", "allow") else None
    if words is None and (field in ("gpus", "allow") or not _is_plain(value)):
        getattr(found, part)[field] = None
        return f"constraint {key} cannot be read: its field {field} is left empty, write it into the spec"
    match field:
        case "latency":
            found.constraints[field] = value if isinstance(value, str) else format_duration(float(value))
        case "cost" if isinstance(value, str):
            found.constraints[field] = value
        case "cost":
            found.constraints[field] = f"{value:g} cent/request"
            return (
                f"constraint {key} has no currency: read as {value:g} cent/request, the unit of the paper's listing; "
                f"its text says ${value:g}, which is 100 times as much: write ${value:g}/request if you mean that"
            )
        case "gpus":
            found.hardware[field] = [word.partition(":")[0] for word in words or ()]
        case "allow":
            found.hardware[field] = words
        case "alpha" | "requests":
            getattr(found, part)[field] = value
        case _:
            _bound(found, field, "min" if name.startswith("min") else "max", value)
    return None


def _plain(key: str) -> str:
    return re.sub(r"[^a-z]", "", key.lower())


def _field_of(name: str) -> tuple[str, str] | None:
    """Return the part of the spec and its field that a constraint is about; None if it is none."""
    if name in ("latency", "maxlatency", "latencymax", "maxtime", "time"):
        return "constraints", "latency"
    if name in ("cost", "maxcost", "costmax", "maxcostperrequest", "costperrequest"):
        return "constraints", "cost"
    if name == "alpha":
        return "objective", "alpha"
    if name in ("step", "steps", "numsteps", "benchmarksteps", "numberofsteps"):
        return "stop", "requests"
    if RATIO.fullmatch(name):
        return "hardware", "memory_per_cpu"
    if bound := BOUND.fullmatch(name):
        return "hardware", "cpus" if "cpu" in bound[4] else "memory"
    if name in GPUS:
        return "hardware", "gpus"
    return ("hardware", "allow") if name in MACHINES else None


def _is_plain(value: Any) -> bool:
    if isinstance(value, str):
        return True
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def _words(value: Any) -> list[str] | None:
    if isinstance(value, str):
        return [value]
    if isinstance(value, Sequence) and value and all(isinstance(one, str) for one in value):
        return list(value)
    return None


def _bound(found: Started, field: str, end: str, value: Any) -> None:
    unit = "" if field == "cpus" or isinstance(value, str) else "GiB"
    low, _, high = str(found.hardware.get(field) or "..").partition("..")
    written = f"{value}{unit}"
    found.hardware[field] = f"{written}..{high}" if end == "min" else f"{low}..{written}"
