"""Names of images, digests of trees, and what a lock pins of a measurement."""

import os
from pathlib import Path

import pytest

from fogspec.base.layout import Layout
from fogspec.spec.fingerprints import changed_pins
from fogspec.spec.lock_io import files_beside, tree_digest
from fogspec.spec.lockfile import CatalogPin, ImagePin, Pins, image_of, pinned, pins_of_measurement
from tests.unit.compile.test_tasks import application

DIGEST = f"sha256:{'a' * 64}"
CATALOG = CatalogPin(origin="snapshot", source="s", revision="", date="", digest=DIGEST)


@pytest.mark.parametrize(
    ("text", "registry", "repository", "tag", "name"),
    [
        ("ros:jazzy", "docker.io", "library/ros", "jazzy", "ros"),
        ("ros", "docker.io", "library/ros", "latest", "ros"),
        ("docker.io/library/ros:jazzy", "docker.io", "library/ros", "jazzy", "docker.io/library/ros"),
        ("someone/robot:v1", "docker.io", "someone/robot", "v1", "someone/robot"),
        ("ghcr.io/a/b/c:v1", "ghcr.io", "a/b/c", "v1", "ghcr.io/a/b/c"),
        ("localhost:5000/a", "localhost:5000", "a", "latest", "localhost:5000/a"),
        ("localhost/a:1", "localhost", "a", "1", "localhost/a"),
        (f"ros:jazzy@{DIGEST}", "docker.io", "library/ros", "jazzy", "ros"),
    ],
)
def test_names_are_read_as_docker_reads_them(text: str, registry: str, repository: str, tag: str, name: str) -> None:
    image = image_of(text)
    assert (image.registry, image.repository, image.tag, image.name) == (registry, repository, tag, name)
    assert image.digest == (DIGEST if "@" in text else None)


@pytest.mark.parametrize("text", ["", "ROS:jazzy", "ros:jaz zy", "ros@sha256:12", "a//b", "../../etc:x", "a:b?c=d"])
def test_what_is_no_name_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="no name of a container image"):
        image_of(text)


def test_only_the_image_that_was_locked_is_pinned() -> None:
    app = application(ros={"image": "ros:jazzy"})
    pins = Pins(catalog=CATALOG, image=ImagePin(image="ros:jazzy", digest=DIGEST))
    assert pinned(app, pins).spec.ros.image == f"ros@{DIGEST}"
    assert pins_of_measurement(app, pins) == {"image": DIGEST}
    other = application(ros={"image": "ros:humble"})
    assert pinned(other, pins) == other
    assert pins_of_measurement(other, pins) == {}
    assert pinned(app, None) == app
    exact = application(ros={"image": f"ros@{DIGEST}"})
    assert pinned(exact, pins) == exact


def test_what_was_not_pinned_is_not_known_to_differ() -> None:
    assert changed_pins(None, {"a": "1"}) == []
    assert changed_pins({"a": "1", "b": "2", "c": "3"}, {"a": "1", "b": "9"}) == ["b"]


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    root = tmp_path / "ws"
    for name, text in (("src/a.py", "a"), ("src/b/c.py", "c")):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    return root


def test_a_tree_is_its_names_and_contents_and_nothing_else(tree: Path) -> None:
    before = tree_digest(tree)
    for left in ("build/x", "install/setup.bash", "log/latest", "src/__pycache__/a.pyc", ".git/HEAD"):
        (tree / left).parent.mkdir(parents=True, exist_ok=True)
        (tree / left).write_text("left behind")
    os.utime(tree / "src/a.py", (1, 1))
    assert tree_digest(tree) == before
    changes = [
        lambda: (tree / "src/a.py").write_text("other"),
        lambda: (tree / "src/a.py").rename(tree / "src/d.py"),
        lambda: (tree / "src/b/c.py").chmod(0o755),
        lambda: (tree / "src/build").mkdir() or (tree / "src/build/x.py").write_text("inside a package"),
        lambda: (tree / "src/link").symlink_to("b"),
    ]
    seen = {before}
    for change in changes:
        change()
        seen.add(tree_digest(tree))
    assert len(seen) == len(changes) + 1


def test_files_that_a_spec_names_are_found_beside_it(tree: Path) -> None:
    spec = tree.parent / "specs" / "x.yaml"
    spec.parent.mkdir()
    (spec.parent / "work.py").write_text("work")
    (spec.parent / "p.yaml").write_text("p")
    app = application(
        cloud=[{"cmd": ["python3", "./work.py", "absent.py", "/etc/passwd", "."]},
               {"package": "p", "executable": "e", "parameter_files": ["p.yaml"]}],
        ros={"workspace": "../ws"},
    )  # fmt: skip
    assert set(files_beside(app, Layout.of(spec, "x"))) == {"../ws", "work.py", "p.yaml"}
