"""State what was approved, as an in-toto Statement (v1) with SLSA's provenance predicate (v1), and compare one with the files.

Specifications: in-toto Attestation Framework v1, https://github.com/in-toto/attestation/tree/main/spec/v1, and SLSA
v1.0 Provenance, https://slsa.dev/spec/v1.0/provenance. The statement depends on the files alone: it has no clock, host
or user, so that the same files always give the same bytes. Signing it is the work of other tools.
"""

import contextlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fogspec import __version__
from fogspec.base import digest
from fogspec.base.errors import InvalidInput
from fogspec.base.files import read_bounded
from fogspec.base.layout import MOST_BYTES, Layout
from fogspec.base.text import json_text
from fogspec.compile.bundle import ManifestBundle, references
from fogspec.compile.inputs import Inputs
from fogspec.language.lockfile import image_of, is_pinned
from fogspec.results.io import timings_path

STATEMENT = "https://in-toto.io/Statement/v1"
PREDICATE = "https://slsa.dev/provenance/v1"
# A build type is a URI; a tag URI (RFC 4151) does not require a web page.
BUILD = "tag:fogspec.dev,2026:compile/v1"
BUILDER = "tag:fogspec.dev,2026:fogspec"


@dataclass(frozen=True, slots=True)
class Approved:
    """The files that are approved with an application's manifest, and the inputs that they follow from, as resources."""

    name: str
    spec: str
    subjects: Sequence[Mapping[str, Any]]
    materials: Sequence[Mapping[str, Any]]

    @classmethod
    def of(cls, opened: ManifestBundle) -> "Approved":
        """Return what a fresh manifest approves: itself and each file that it names, which are those that `apply` compares."""
        layout = opened.layout
        found = [(layout.manifest, opened.digest)]
        found += [(layout.compiled / one.path, one.digest) for one in references(opened.manifest)]
        subjects = [{"name": layout.relative(path), "digest": _digest(value)} for path, value in found]
        return cls(layout.name, layout.relative(layout.spec), subjects, materials(opened))


def text(every: Sequence[Approved]) -> str:
    """Return the statement about these applications as JSON with sorted keys."""
    data = {
        "_type": STATEMENT,
        "subject": _each_once(one for approved in every for one in approved.subjects),
        "predicateType": PREDICATE,
        "predicate": {
            "buildDefinition": {
                "buildType": BUILD,
                "externalParameters": {"applications": {one.name: one.spec for one in every}},
                "resolvedDependencies": _each_once(one for approved in every for one in approved.materials),
            },
            "runDetails": {"builder": {"id": BUILDER, "version": {"fogspec": __version__}}},
        },
    }
    return json_text(json.dumps(data, indent=2, sort_keys=True, ensure_ascii=False)) + "\n"


def _each_once(resources: Iterable[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Return resources without those that applications share."""
    return list({json.dumps(one, sort_keys=True): one for one in resources}.values())


def materials(opened: ManifestBundle) -> list[dict[str, Any]]:
    """Return the inputs of the manifest: spec, overlay, lock, plan, results with raw timings, models, catalog, a pinned image.

    Digests are over the files' bytes, which any tool can check; annotations have fogspec's digests over the parsed content.
    """
    layout, pins, inputs = opened.layout, opened.manifest.pins, opened.inputs
    about = inputs.catalog.about
    found = [
        _file("spec", layout, layout.spec, inputs.spec_content),
        *([] if layout.overlay is None else [_file("overlay", layout, layout.overlay, inputs.overlay_content)]),
        *([] if inputs.lock is None else [_file("lock", layout, layout.lock, inputs.lock.content)]),
        _file("plan", layout, layout.plan, inputs.content(layout.plan), pins.plan),
        *(_file("results", layout, Path(one.name), one.content) for one in inputs.results_files),
        *_timings(inputs),
        _file("models", layout, layout.models, inputs.content(layout.models)),
        {
            "name": "catalog",
            "digest": _digest(about.digest),
            "annotations": {"source": about.source, "revision": about.revision, "date": about.date},
        },
    ]
    image = opened.manifest.spec.image
    if image is not None and is_pinned(image):
        parts = image_of(image)
        found.append(_material("image", f"oci://{parts.registry}/{parts.repository}", parts.digest or ""))
    return found


def _timings(inputs: Inputs) -> Iterator[dict[str, Any]]:
    """Yield the files of raw timings; `check` has compared those that a record names with its digest."""
    layout = inputs.layout
    records = inputs.results.spec.samples if inputs.results is not None else []
    known = {timings_path(layout.results, one.id): one.timings for one in records if one.timings}
    for path in (layout.timings / name for name in layout.files.names(layout.timings) if name.endswith(".gz")):
        found = known.get(path) or digest.of_bytes(layout.files.read(path, MOST_BYTES))
        yield _material("timings", layout.relative(path), found)


def _file(name: str, layout: Layout, path: Path, content: bytes | None, read: str | None = None) -> dict[str, Any]:
    found = _material(name, layout.relative(path), digest.of_bytes(content or b""))
    return found if read is None else {**found, "annotations": {"fogspec": read}}


def _material(name: str, path: str, text: str) -> dict[str, Any]:
    return {"name": name, "uri": path, "digest": _digest(text)}


def _digest(text: str) -> dict[str, str]:
    algorithm, _, value = text.partition(":")
    return {algorithm: value}


def differences(path: str, every: Sequence[Approved]) -> list[str]:
    """Return how a statement in a file differs from what these applications approve, as sentences.

    Raise InvalidInput if the file cannot be read.
    """
    try:
        content = read_bounded(path, MOST_BYTES)
    except OSError as problem:
        raise InvalidInput(f"{path}: cannot be read: {problem.strerror}") from None
    data: Any = None
    with contextlib.suppress(ValueError, RecursionError):
        data = json.loads(content)
    if not isinstance(data, dict) or (data.get("_type"), data.get("predicateType")) != (STATEMENT, PREDICATE):
        return [f"{path}: it is not an in-toto Statement v1 with SLSA provenance v1"]
    listed = data.get("subject")
    listed = [one for one in listed if isinstance(one, dict)] if isinstance(listed, list) else []
    stated = {str(one.get("name")): one.get("digest") for one in listed}
    now = {one["name"]: one["digest"] for approved in every for one in approved.subjects}
    found = [
        f"{path}: it does not state {name}" if name not in stated else f"{name} is not what {path} states"
        for name, value in now.items()
        if stated.get(name) != value
    ]
    return found + [f"{path}: it states {name} too, which no manifest names" for name in stated if name not in now]
