"""Build a manifest's provenance as an in-toto Statement (v1) with SLSA's provenance predicate (v1).

Specifications: in-toto Attestation Framework v1, https://github.com/in-toto/attestation/tree/main/spec/v1, and SLSA
v1.0 Provenance, https://slsa.dev/spec/v1.0/provenance. The statement depends on the files alone: it has no clock, host
or user, so that the same files always give the same bytes.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from fogspec import __version__
from fogspec.audit.verify import Check, verify
from fogspec.base import digest
from fogspec.base.errors import OutOfDate
from fogspec.base.layout import Layout
from fogspec.base.text import json_text, shell_command
from fogspec.compile.bundle import ManifestBundle, references
from fogspec.compile.inputs import Inputs
from fogspec.spec.lockfile import image_of, is_pinned

STATEMENT = "https://in-toto.io/Statement/v1"
PREDICATE = "https://slsa.dev/provenance/v1"
# A build type is a URI; a tag URI (RFC 4151) does not require a web page.
BUILD = "tag:fogspec.dev,2026:compile/v1"
BUILDER = "tag:fogspec.dev,2026:fogspec"


def statement(opened: ManifestBundle) -> dict[str, Any]:
    """Return the statement. Raise OutOfDate if the chain behind the manifest is broken, because it must not be attested."""
    links = verify(opened)
    if broken := [link for link in links if link.breaks]:
        raise OutOfDate(
            f"{opened.layout.manifest}: not attested, for the chain breaks at {broken[0].name}",
            *broken[0].breaks,
            f"see: {shell_command('fogspec', 'verify', opened.layout.manifest)}",
        )
    return {
        "_type": STATEMENT,
        "subject": subjects(opened),
        "predicateType": PREDICATE,
        "predicate": {
            "buildDefinition": {
                "buildType": BUILD,
                "externalParameters": {
                    "spec": opened.manifest.provenance.application.path,
                    "application": opened.layout.name,
                },
                "internalParameters": {"links": [link.name for link in links]},
                "resolvedDependencies": materials(opened),
            },
            "runDetails": {"builder": {"id": BUILDER, "version": {"fogspec": __version__}}},
        },
    }


def text(data: dict[str, Any]) -> str:
    """Return the statement as JSON with sorted keys."""
    return json_text(json.dumps(data, indent=2, sort_keys=True, ensure_ascii=False)) + "\n"


def subjects(opened: ManifestBundle) -> list[dict[str, Any]]:
    """Return the attested files: the manifest and all files approved with it, by path relative to the root of the project."""
    layout = opened.layout
    found = [(layout.manifest, opened.digest)]
    found += [(layout.compiled / one.path, one.digest) for one in references(opened.manifest)]
    return [{"name": layout.relative(path), "digest": _digest(value)} for path, value in found]


def materials(opened: ManifestBundle) -> list[dict[str, Any]]:
    """Return the inputs of the manifest: spec, overlay, lock, plan, results with raw timings, models, catalog, a pinned image.

    Digests are over the files' bytes, which any tool can check; annotations have fogspec's digests over the parsed content.
    """
    layout, named, inputs = opened.layout, opened.manifest.provenance, opened.inputs
    found = [
        _file("spec", layout, layout.spec, inputs.spec_content, named.application.digest),
        *([] if layout.overlay is None else [_file("overlay", layout, layout.overlay, inputs.overlay_content)]),
        *([] if inputs.lock is None else [_file("lock", layout, layout.lock, inputs.lock.content)]),
        _file("plan", layout, layout.plan, inputs.content(layout.plan), named.plan.digest),
        _file("results", layout, layout.results, inputs.results_content, named.results.digest),
        *_timings(inputs),
        _file("models", layout, layout.models, inputs.content(layout.models)),
        {
            "name": "catalog",
            "digest": _digest(named.catalog.digest),
            "annotations": {
                "source": named.catalog.source,
                "revision": named.catalog.revision,
                "date": named.catalog.date,
            },
        },
    ]
    image = opened.manifest.spec.image
    if image is not None and is_pinned(image):
        parts = image_of(image)
        found.append(_material("image", f"oci://{parts.registry}/{parts.repository}", parts.digest or ""))
    return found


def _timings(inputs: Inputs) -> Iterator[dict[str, Any]]:
    """Yield the files of raw timings; `verify` has compared those that a record names with its digest."""
    layout = inputs.layout
    records = inputs.results.spec.samples if inputs.results is not None else []
    known = {layout.results.parent / one.timings.path: one.timings.digest for one in records if one.timings}
    for path in (layout.timings / name for name in layout.files.names(layout.timings) if name.endswith(".gz")):
        yield _material("timings", layout.relative(path), known.get(path) or digest.of_bytes(layout.files.read(path)))


def _file(name: str, layout: Layout, path: Path, content: bytes | None, read: str | None = None) -> dict[str, Any]:
    found = _material(name, layout.relative(path), digest.of_bytes(content or b""))
    return found if read is None else {**found, "annotations": {"fogspec": read}}


def _material(name: str, path: str, text: str) -> dict[str, Any]:
    return {"name": name, "uri": path, "digest": _digest(text)}


def _digest(text: str) -> dict[str, str]:
    algorithm, _, value = text.partition(":")
    return {algorithm: value}


def check(opened: ManifestBundle, data: Any) -> Check:
    """Check that a statement attests this manifest in its current state."""
    now = {one["name"]: one["digest"] for one in subjects(opened)}
    if not isinstance(data, dict) or (data.get("_type"), data.get("predicateType")) != (STATEMENT, PREDICATE):
        return Check("attestation", "", ("it is not an in-toto Statement v1 with SLSA provenance v1",))
    listed = data.get("subject")
    attested = (
        {one.get("name"): one.get("digest") for one in listed if isinstance(one, dict)}
        if isinstance(listed, list)
        else {}
    )
    breaks = [
        f"it does not attest {name}" if name not in attested else f"{name} is not what was attested"
        for name, value in now.items()
        if attested.get(name) != value
    ]
    breaks += [
        f"it attests {name} too, which the manifest does not name" for name in map(str, attested) if name not in now
    ]
    return Check("attestation", f"{len(now)} files", tuple(breaks))
