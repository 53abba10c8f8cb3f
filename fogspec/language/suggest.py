"""Did you mean: the known word closest to an unknown one."""

import difflib
import re
from collections.abc import Iterable

SYNONYMS = {
    "cpu": "cpus", "vcpus": "cpus", "cores": "cpus", "ram": "memory", "mem": "memory", "gpu": "gpus", "accelerators": "gpus",
    "instancetypes": "machines", "instances": "machines", "instance": "machines", "region": "infra", "regions": "infra",
    "cloudprovider": "infra", "params": "parameters", "remap": "remappings", "args": "arguments", "environment": "env",
    "paramsfile": "parameter_files", "exec": "executable", "pkg": "package", "ns": "namespace", "maxlatency": "latency",
    "maxcost": "cost", "timeout": "duration", "limit": "constraints", "limits": "constraints", "command": "cmd",
    "usage": "load", "throughput": "load", "topics": "expose", "services": "expose", "actions": "expose", "maxspend": "budget",
    "docker": "image", "container": "image", "weight": "alpha", "hardwares": "hardware", "bench": "benchmark",
    "machines": "allow", "node": "executable", "k8s": "kubernetes",
}  # fmt: skip
EITHER = {"timeout"}  # of one request, or of the sample: which is meant only the author knows


def closest(word: str, known: Iterable[str], alike: float = 0.6) -> str | None:
    """Return the known word that was most likely meant, or None; `alike` is the least ratio of `difflib`."""
    plain = {_plain(one): one for one in known}
    meant = _plain(word)
    if meant in plain:
        return plain[meant]
    if SYNONYMS.get(meant) in plain.values():
        return SYNONYMS[meant]
    if near := difflib.get_close_matches(meant, plain, n=1, cutoff=alike):
        return plain[near[0]]
    starts = [one for one in plain if len(meant) >= 3 and (one.startswith(meant) or meant.startswith(one))]
    return plain[starts[0]] if len(starts) == 1 else None


def is_synonym(word: str, known: str) -> bool:
    """Return whether an unknown word is listed as another one for a known word."""
    return SYNONYMS.get(_plain(word)) == known


def did_you_mean(word: str, known: Iterable[str]) -> list[str]:
    """Return `did you mean X?` if a known word is near, as a list of hints."""
    near = closest(word, known)
    return [f"did you mean {near}?"] if near else []


def _plain(word: str) -> str:
    return re.sub(r"[-_\s]", "", word).lower()
