"""Names of images, digests of trees, and what a lock pins of a measurement."""

import hashlib
from pathlib import Path

import pytest

from fogspec.base.errors import InvalidInput, OutOfDate
from fogspec.base.layout import Layout
from fogspec.spec.lock_io import check_sent, files_sent, lock_drift, lock_text, read_lock, read_pins, snapshot
from fogspec.spec.lockfile import (
    IGNORED,
    CatalogPin,
    ImagePin,
    Lock,
    LockBody,
    Pins,
    changed_pins,
    ignored_patterns,
    image_named,
    image_of,
    is_pinned,
    listed,
    measurement_sends_files,
    pinned,
    pins_of_measurement,
    sends_files,
    sent_files,
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
    with pytest.raises(ValueError, match="not a name of a container image"):
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
            check_sent(application(cloud=cloud), project, measured=False)
    check_sent(application(cloud=[{"cmd": ["./work.py", ".venv/absent", "--flag", "/etc/passwd"]}]), project, False)
    # A path from the root is one on the machine, whatever is there on this host.
    check_sent(application(cloud=[{"cmd": ["./work.py", str(project.spec.parent / ".env")]}]), project, False)


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


def test_the_list_of_what_is_never_sent() -> None:
    """By hand: what is taken from it is sent from then on, and what is added is not."""
    assert set(IGNORED) == {
        ".git", ".hg", ".svn", ".fogspec", ".skyignore", ".env", ".env.*", ".venv", ".venv-*", "__pycache__", "*.pyc",
        ".pytest_cache", ".mypy_cache", ".ruff_cache", ".DS_Store",
    }  # fmt: skip
    app = application(cloud=[{"cmd": ["./a"]}], ros={"workspace": "ws/"}, ignore=["*.bag"])
    assert ignored_patterns(app, True)[len(IGNORED) :] == (
        "/compiled", "/results", "/fogspec.lock", "/ws/build", "/ws/install", "/ws/log", "*.bag"
    )  # fmt: skip
    assert ignored_patterns(app, False)[len(IGNORED) :] == ("/ws/build", "/ws/install", "/ws/log", "*.bag")


def test_what_a_manifest_says_of_the_files() -> None:
    app = application(cloud=[{"cmd": ["./a"]}])
    pins = Pins(catalog=CATALOG, files={"b": "sha256:2", "a": "sha256:1"})
    found = sent_files(app, "../../specs", pins, False)
    assert found is not None
    listed_by_hand = b'{"a":"sha256:1","b":"sha256:2"}'
    assert (found.folder, found.files, found.ignored) == ("../../specs", 2, list(IGNORED))
    assert found.digest == f"sha256:{hashlib.sha256(listed_by_hand).hexdigest()}"
    bare = sent_files(app, "x", None, False)
    assert bare is not None
    assert (bare.files, bare.digest) == (None, None)
    assert sent_files(application(cloud=[{"package": "p", "executable": "e"}]), "x", pins, False) is None


NODE = {"package": "p", "executable": "e"}


@pytest.mark.parametrize(
    ("parts", "measured", "sent"),
    [
        ({"cloud": [NODE]}, False, False),
        ({"cloud": [NODE], "deployment": {"ready": ["./ready"]}}, False, True),
        ({"cloud": [NODE], "ros": {"distro": "jazzy"}}, False, False),
        ({"cloud": [NODE], "ros": {"workspace": "ws"}}, True, True),
        ({"cloud": [{**NODE, "parameter_files": ["p.yaml"]}]}, True, True),
        ({"cloud": [NODE, {"cmd": ["./a"]}]}, True, True),
        ({"cloud": [NODE], "benchmark": {"workload": {"bag": "run.bag"}}}, True, True),
        ({"cloud": [NODE], "benchmark": {"workload": {"node": {"cmd": ["./client"]}}}}, True, True),
    ],
)
def test_who_needs_files_on_a_machine(parts: dict[str, object], measured: bool, sent: bool) -> None:
    app = application(**parts)
    pins = Pins(catalog=CATALOG, files={"a": "sha256:1"})
    assert (measurement_sends_files(app.spec), sends_files(app)) == (measured, sent)
    assert pins_of_measurement(app, pins) == ({"a": "sha256:1"} if measured else {})
    assert pins_of_measurement(app, None) == {}


def test_images_without_pins_stay_as_they_are_named() -> None:
    app = application(ros={"image": "ros:jazzy"})
    assert pinned(app, Pins(catalog=CATALOG)) == app
    assert image_named(application(cloud=[NODE])) is None
    assert pinned(application(cloud=[NODE]), Pins(catalog=CATALOG)) == application(cloud=[NODE])
    assert (is_pinned(f"ros@{DIGEST}"), is_pinned("ros:jazzy"), is_pinned(DIGEST)) == (True, False, False)
    imageless = application(ros={"distro": "jazzy"})
    assert pinned(imageless, Pins(catalog=CATALOG, image=ImagePin(image="ros:jazzy", digest=DIGEST))) == imageless


def test_a_lock_is_written_in_one_order_and_read_back(tmp_path: Path) -> None:
    layout = Layout.of(tmp_path / "specs/b.yaml", "b")
    applications = {name: Pins(catalog=CATALOG, files={"x": name}) for name in ("c", "a", "b")}
    text = lock_text(Lock(spec=LockBody(applications=applications)))
    assert [line for line in text.splitlines() if line in ("    a:", "    b:", "    c:")] == [
        "    a:",
        "    b:",
        "    c:",
    ]
    assert "apiVersion: fogspec.dev/v1alpha1\n" in text
    assert read_pins(layout) is None
    layout.lock.write_text(text)
    lock = read_lock(layout.lock)
    assert lock is not None
    assert lock.spec.applications == applications
    found = read_pins(layout)
    assert found is not None
    assert found.files == {"x": "b"}
    assert read_pins(Layout.of(tmp_path / "specs/z.yaml", "z")) is None


def test_drift_is_what_differs_from_the_lock_and_nothing_without_one() -> None:
    pins = Pins(catalog=CATALOG, files={"a": "1", "b": "2", "gone": "3"})
    assert lock_drift(pins, {"a": "1", "b": "9", "new": "4"}) == ["b", "gone", "new"]
    assert lock_drift(pins, dict(pins.files)) == []
    assert lock_drift(None, {"a": "1"}) == []
    assert some(["a", "b"]) == "a, b"


def test_a_list_of_names_ends_after_six() -> None:
    assert some("abcdef") == "a, b, c, d, e, f"
    assert some("abcdefg") == "a, b, c, d, e, f and 1 more"
