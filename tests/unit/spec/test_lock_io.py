"""Names of images, digests of trees, and what a lock pins of a measurement."""

from pathlib import Path

import pytest

from fogspec.base.errors import InvalidInput, OutOfDate
from fogspec.base.layout import Layout
from fogspec.spec.lock_io import check_files, files_sent, snapshot
from fogspec.spec.lockfile import (
    CatalogPin,
    ImagePin,
    Pins,
    changed_pins,
    image_of,
    listed,
    pinned,
    pins_of_measurement,
    some,
)
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
    assert changed_pins({"a": "1"}, {}) == []
    assert changed_pins({"a": "1", "b": "2", "c": "3"}, {"a": "1", "b": "9", "d": "4"}) == ["b", "c", "d"]


def test_a_file_cannot_take_the_name_of_the_image() -> None:
    app = application(ros={"image": "ros:jazzy"}, cloud=[{"cmd": ["./image"]}])
    pins = Pins(catalog=CATALOG, image=ImagePin(image="ros:jazzy", digest=DIGEST), files={"image": "sha256:b"})
    assert pins_of_measurement(app, pins) == {"image": DIGEST, "./image": "sha256:b"}


@pytest.fixture
def project(tmp_path: Path) -> Layout:
    for name in ("work.py", "helper.py", "ros2_ws/src/a.py", "ros2_ws/build/x", "src/build/y", ".env", ".git/HEAD"):
        (tmp_path / "specs" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "specs" / name).write_text(name)
    return Layout.of(tmp_path / "specs/x.yaml", "x")


def test_all_that_a_node_may_import_is_sent(project: Layout) -> None:
    app = application(cloud=[{"cmd": ["python3", "./work.py"]}])
    assert set(files_sent(app, project)) == {
        "helper.py", "work.py", "ros2_ws/src/a.py", "ros2_ws/build/x", "src/build/y"
    }  # fmt: skip
    built = application(cloud=[{"package": "p", "executable": "e"}], ros={"workspace": "./ros2_ws/"})
    assert "ros2_ws/build/x" not in files_sent(built, project)
    assert files_sent(application(cloud=[{"package": "p", "executable": "e"}]), project) == {}


def test_compiled_files_beside_a_spec_are_not_sent(project: Layout, tmp_path: Path) -> None:
    flat = Layout.of(tmp_path / "x.yaml", "x")
    for name in ("compiled/x/plan.yaml", "results/x.yaml", "fogspec.lock", ".fogspec/x/journal.jsonl", "lib/results/a"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(name)
    app = application(cloud=[{"cmd": ["./work.py"]}])
    assert {name for name in files_sent(app, flat) if not name.startswith("specs/")} == {"lib/results/a"}


def test_a_named_file_that_is_not_sent_is_said_before_a_machine_is_paid(project: Layout) -> None:
    for cloud in ([{"cmd": ["sh", ".env"]}], [{"cmd": ["./work.py", ".git/HEAD"]}]):
        with pytest.raises(InvalidInput, match="which is not sent to machines"):
            check_files(application(cloud=cloud), project, measured=False)
    check_files(application(cloud=[{"cmd": ["./work.py", ".venv/absent", "--flag", "/etc/passwd"]}]), project, False)
    named = application(cloud=[{"cmd": ["./work.py"], "parameter_files": ["absent.yaml"]}])
    with pytest.raises(InvalidInput, match="which is not there"):
        check_files(named, project, measured=False)


def test_a_snapshot_that_is_not_what_was_expected_names_the_file(project: Layout, tmp_path: Path) -> None:
    app = application(cloud=[{"cmd": ["./work.py"]}])
    before = files_sent(app, project)
    assert snapshot(app, project, tmp_path / "one", before) == tmp_path / "one"
    (project.spec.parent / "helper.py").write_text("changed")
    with pytest.raises(OutOfDate, match=r"^helper\.py: changed since this command began"):
        snapshot(app, project, tmp_path / "two", before)
    assert not (tmp_path / "two").exists()
    assert snapshot(application(cloud=[{"package": "p", "executable": "e"}]), project, tmp_path / "no", {}) is None
    assert not (tmp_path / "no").exists()


def test_a_long_list_says_how_long_it_is() -> None:
    names = [f"{number}.py" for number in range(9)]
    assert some(names, 8).endswith("7.py and 1 more")
    assert listed(names, "{} changed", 2) == ["0.py changed", "1.py changed", "and 7 more files"]
    assert listed(names[:2], "{}", 2) == names[:2]
