"""The managers that the documentation gives to Renovate find the images of real specs and locks, and nothing else."""

import json
import re
from pathlib import Path

import pytest

from fogspec.base.yaml.writer import yaml_text
from fogspec.language.loader import load
from fogspec.language.lock_io import lock_text
from fogspec.language.lockfile import CatalogPin, ImagePin, Pins, image_of

ROOT = Path(__file__).resolve().parents[2]
DIGEST = f"sha256:{'0123456789abcdef' * 4}"
NAMES = (
    "ros:jazzy",
    "docker.io/library/ros:jazzy-perception",
    "ghcr.io/team/arm_planner:v1.2.3",
    "localhost:5000/a/b:2024-01",
)


def managers() -> list[dict[str, object]]:
    page = (ROOT / "docs/howto/editor-and-ci.md").read_text("utf-8")
    text = re.search(r'```json title="renovate.json"\n(.*?)```', page, re.DOTALL)
    assert text is not None
    found: list[dict[str, object]] = json.loads(text[1])["customManagers"]
    return found


def matches(manager: dict[str, object], path: str, text: str) -> list[dict[str, str | None]]:
    """What Renovate would extract from a file: its named groups, written in JavaScript's way, in RE2's syntax."""
    (pattern,), (regex,) = manager["managerFilePatterns"], manager["matchStrings"]  # type: ignore[misc]
    assert pattern[0] == pattern[-1] == "/"
    assert not re.search(r"\(\?[=!]|\(\?<[=!]|\\[1-9]", regex), "RE2 has no look-around and no back-references"
    if not re.search(pattern[1:-1], path):
        return []
    return [found.groupdict() for found in re.finditer(regex.replace("(?<", "(?P<"), text)]


def test_images_of_all_specs_are_found() -> None:
    specs, _ = managers()
    tagged = 0
    for path in sorted((ROOT / "specs").glob("*.yaml")):
        images = {ros.image for one in load([str(path)]) if (ros := one.application.spec.ros) is not None and ros.image}
        wanted = {(parts.name, parts.tag) for parts in map(image_of, images) if f":{parts.tag}" in "".join(images)}
        found = matches(specs, f"specs/{path.name}", path.read_text("utf-8"))
        assert {(one["depName"], one["currentValue"]) for one in found} == wanted, path
        tagged += len(wanted)
    assert tagged >= 3


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("digest", ["", f"@{DIGEST}"])
def test_parts_of_a_name_in_a_spec_and_in_a_lock(name: str, digest: str) -> None:
    specs, locks = managers()
    parts = image_of(name)
    for text in (f"  ros: {{distro: jazzy, image: {name}{digest}}}", f"    image: '{name}{digest}' # why"):
        (found,) = matches(specs, "robots/specs/arm/grasp.yml", text)
        assert (found["depName"], found["currentValue"]) == (parts.name, parts.tag)
        assert found["currentDigest"] == (DIGEST if digest else None)
    pins = Pins(
        catalog=CatalogPin(origin="snapshot", source="s", revision="1", date="2025-01-01", digest=DIGEST),
        image=ImagePin(image=f"{name}{digest}", digest=DIGEST),
    )
    text = lock_text(pins)
    (found,) = matches(locks, "robots/specs/arm/arm.lock", text)
    assert found == {"depName": parts.name, "currentValue": parts.tag, "currentDigest": DIGEST}
    assert matches(locks, "robots/poetry.lock", text) == []
    assert matches(specs, "compiled/arm/manifest.yaml", yaml_text({"image": name}, "fogspec compile")) == []
