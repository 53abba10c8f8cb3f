"""Finding and reading the manifest on the robot: standard library and PyYAML, because nothing else is there for sure."""

import hashlib
import os
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True, kw_only=True)
class Pinned:
    """What a manifest says to the robot: the machine behind it, the nodes there, and how to reach them."""

    name: str
    path: Path
    machine: str
    cloud: Sequence[dict[str, Any]]
    environment: dict[str, str]
    link: Path | None

    def line(self) -> str:
        """Return what is not started here, and what deploys it; a robot does not know whether that was done."""
        nodes = ", ".join(str(node.get("executable") or " ".join(node.get("cmd", []))) for node in self.cloud)
        return (
            f"{self.name}: not started here: {nodes}; {self.path} pins {self.machine} for it. This launch deploys nothing: "
            f"fogspec apply does, and fogspec status {self.name} says whether it runs"
        )


def pinned_for(nodes: Sequence[Any], path: str | os.PathLike[str] | None, caller: Path) -> Pinned:
    """Return the named manifest, or the one whose cloud nodes are these; raise ValueError."""
    wanted = Counter(_kinds(nodes))
    given = path or os.environ.get("FOGSPEC_MANIFEST")
    if given:
        pinned = read(Path(given))
        if wanted != _deployed(pinned):
            raise ValueError(f"{given} deploys {_words(_deployed(pinned))}, the launch file says {_words(wanted)}")
        return pinned
    found = [read(one) for one in _nearby(caller)]
    fitting = [one for one in found if _deployed(one) == wanted]
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        names = ", ".join(str(one.path) for one in fitting)
        raise ValueError(f"several manifests deploy {_words(wanted)}: {names}: say which with manifest=...")
    others = ", ".join(f"{one.path} deploys {_words(_deployed(one))}" for one in found)
    where = others or f"no compiled/NAME/manifest.yaml beside or above {caller}"
    raise ValueError(f"no manifest deploys {_words(wanted)}: {where}; `fogspec compile` writes it once it is measured")


def read(path: Path) -> Pinned:
    """One manifest; raises ValueError for a file that is none, or whose link is not what the manifest says."""
    import yaml

    try:
        document = yaml.safe_load(path.read_text("utf-8"))
        spec = document["spec"]
        if document["kind"] != "DeploymentManifest":
            raise KeyError("kind")
        digests = {one["path"]: one["digest"] for one in document["pins"]["files"]}
        link = path.parent / "link" / "link.sh" if "link/link.sh" in digests else None
        folder = str(path.resolve().parent / "link")
        environment = {
            str(key): str(value).replace("@LINK@", folder) for key, value in spec.get("robot_environment", {}).items()
        }
        pinned = Pinned(
            name=document["metadata"]["name"],
            path=path,
            machine=f"{spec['instance']} in {spec['infra']}",
            cloud=spec["cloud"],
            environment=environment,
            link=link,
        )
    except (OSError, KeyError, TypeError, UnicodeDecodeError, yaml.YAMLError) as problem:
        raise ValueError(f"{path} is not a manifest of fogspec: {problem}") from None
    if link is not None:
        for name in (one for one in digests if one.startswith("link/")):
            _check(path.parent / name, digests[name])
    return pinned


def _check(path: Path, digest: str) -> None:
    """Raise ValueError if the robot's nodes are not those that were approved."""
    content = path.read_bytes() if path.is_file() else b""
    if f"sha256:{hashlib.sha256(content).hexdigest()}" != digest:
        raise ValueError(f"{path} is not what the manifest says: fogspec compile, or check out what was approved")


def _nearby(caller: Path) -> list[Path]:
    for folder in caller.resolve().parents:
        found = sorted(folder.glob("compiled/*/manifest.yaml"))
        if found:
            return found
    return []


def _kinds(nodes: Iterable[Any]) -> Iterable[tuple[str, str]]:
    """Package and executable of each node, as far as they are plain texts; a process by its command."""
    for node in nodes:
        package, executable = getattr(node, "node_package", None), getattr(node, "node_executable", None)
        if package is None and executable is None:
            yield ("", " ".join(_text(one) for one in getattr(node, "cmd", ())))
        else:
            yield (_text(package), _text(executable))


def _text(value: Any) -> str:
    """Return a string, or a list of substitutions as one; `?` for each that only a launch resolves."""
    if isinstance(value, str):
        return value
    if isinstance(value, (list, tuple)):
        return "".join(_text(one) for one in value)
    return str(getattr(value, "text", "?"))


def _deployed(pinned: Pinned) -> "Counter[tuple[str, str]]":
    return Counter(
        (str(node["package"]), str(node["executable"]))
        if "package" in node
        else ("", " ".join([*node.get("cmd", []), *node.get("arguments", [])]))
        for node in pinned.cloud
    )


def _words(kinds: "Counter[tuple[str, str]]") -> str:
    return ", ".join(sorted(f"{package} {executable}".strip() for package, executable in kinds.elements())) or "nothing"
