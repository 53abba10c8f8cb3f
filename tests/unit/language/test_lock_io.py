"""Names of images, digests of trees, and what a lock pins of a measurement."""

import hashlib
from pathlib import Path

import pytest

from fogspec.base.errors import OutOfDate
from fogspec.base.layout import Layout
from fogspec.language.files_there import files_used, missing_files, shared_folder
from fogspec.language.fingerprints import files_of_record, measured_record
from fogspec.language.lock_io import files_sent, lock_files, lock_text, read_pins, snapshot
from fogspec.language.lockfile import (
    IGNORED,
    CatalogPin,
    ImagePin,
    Pins,
    ignored_patterns,
    image_named,
    image_of,
    is_pinned,
    pinned,
    sent_files,
    some,
)
from fogspec.language.named_files import measurement_sends_files, sends_files
from fogspec.language.tree import sent_tree
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
    assert measured_record(app, pins)["image"] == DIGEST
    other = application(ros={"image": "ros:humble"})
    assert pinned(other, pins) == other
    assert "image" not in measured_record(other, pins)
    assert pinned(app, None) == app
    exact = application(ros={"image": f"ros@{DIGEST}"})
    assert pinned(exact, pins) == exact


def test_a_file_cannot_take_the_name_of_the_image() -> None:
    app = application(ros={"image": "ros:jazzy"}, cloud=[{"cmd": ["./image"]}])
    pins = Pins(catalog=CATALOG, image=ImagePin(image="ros:jazzy", digest=DIGEST))
    record = measured_record(app, pins, {"image": "sha256:b"})
    assert (record["image"], record["./image"]) == (DIGEST, "sha256:b")
    assert files_of_record(record) == {"image": "sha256:b"}


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
    for name in ("compiled/x/plan.yaml", "results/x.yaml", ".fogspec/x/journal.jsonl", "lib/results/a"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(name)
    for name in ("x.lock", "neighbour.lock"):
        (tmp_path / name).write_text(lock_text(Pins(catalog=CATALOG)))
    (tmp_path / "uv.lock").write_text("version = 1\n")
    app = application(cloud=[{"cmd": ["./work.py"]}])
    assert {name for name in files_sent(app, flat) if not name.startswith("specs/")} == {"lib/results/a", "uv.lock"}


def test_a_named_file_that_is_not_sent_is_an_error_before_a_machine_is_paid(project: Layout) -> None:
    def wrong(**spec: object) -> list[str]:
        app = application(**spec)
        tree = sent_tree(app, project)
        return [one.message for one in missing_files(app, project.spec.parent, tree, measured=False)]

    for cloud in ([{"cmd": ["sh", ".env"]}], [{"cmd": ["./work.py", ".git/HEAD"]}]):
        assert ["which is not sent to machines" in one for one in wrong(cloud=cloud)] == [True]
    assert wrong(cloud=[{"cmd": ["./work.py", ".venv/absent", "--flag", "/etc/passwd"]}]) == []
    # A path from the root is one on the machine, whatever is there on this host.
    assert wrong(cloud=[{"cmd": ["./work.py", str(project.spec.parent / ".env")]}]) == []
    assert wrong(cloud=[{"cmd": ["./work.py"]}], files=["./work.py"]) == []
    assert wrong(cloud=[{"cmd": ["./work.py", "helper.py"]}], files=["work.py"]) == [
        "spec.cloud[0].cmd[1] names helper.py, which is not sent to machines"
    ]
    assert wrong(cloud=[{"cmd": ["./work.py"]}], files=["work.py", "no.py"]) == [
        "spec.files[1] names no.py, which is not there"
    ]


def test_only_listed_files_are_sent_and_none_of_a_directory_with_a_spec(project: Layout) -> None:
    folder = project.spec.parent
    (folder / "two").mkdir()
    (folder / "two" / "two.yaml").write_text("apiVersion: fogspec.dev/v1alpha1\nkind: Application\n")
    (folder / "two" / "work.py").write_text("of another application")
    app = application(cloud=[{"cmd": ["./work.py"]}])
    assert not [name for name in files_sent(app, project) if name.startswith("two/")]
    some_of_it = application(cloud=[{"cmd": ["./work.py"]}], files=["work.py", "ros2_ws/src/", "two"])
    assert set(files_sent(some_of_it, project)) == {"work.py", "ros2_ws/src/a.py"}
    assert files_sent(application(cloud=[{"cmd": ["./work.py"]}], files=[]), project) == {}


def test_the_list_to_paste_has_what_programs_import(project: Layout) -> None:
    folder = project.spec.parent
    (folder / "work.py").write_text("import helper\nfrom lib.inner import x\nimport numpy\n")
    (folder / "helper.py").write_text("import deep\n")
    (folder / "deep.py").write_text("import work\n")
    (folder / "lib").mkdir()
    (folder / "config.json").write_text("{}")
    app = application(cloud=[{"cmd": ["python3", "./work.py", "config.json"]}])
    assert files_used(app.spec, folder) == ["work.py", "config.json", "helper.py", "lib", "deep.py"]
    assert [one.code for one in shared_folder(app, folder, ["other.yaml"])] == ["FS567"]
    assert list(shared_folder(app, folder, [])) == []
    assert list(shared_folder(application(cloud=[NODE]), folder, ["other.yaml"])) == []


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


def test_the_list_of_what_is_never_sent() -> None:
    """By hand: what is taken from it is sent from then on, and what is added is not."""
    assert set(IGNORED) == {
        ".git", ".hg", ".svn", ".fogspec", ".skyignore", ".env", ".env.*", ".venv", ".venv-*", "__pycache__", "*.pyc",
        ".pytest_cache", ".mypy_cache", ".ruff_cache", ".DS_Store",
    }  # fmt: skip
    app = application(cloud=[{"cmd": ["./a"]}], ros={"workspace": "ws/"}, files=["a"])
    assert ignored_patterns(app, True)[len(IGNORED) :] == (
        "/compiled", "/results", "/ws/build", "/ws/install", "/ws/log"
    )  # fmt: skip
    assert ignored_patterns(app, False)[len(IGNORED) :] == ("/ws/build", "/ws/install", "/ws/log")


def test_what_a_manifest_says_of_the_files() -> None:
    found = sent_files(application(cloud=[{"cmd": ["./a"]}]), {"b": "sha256:2", "a": "sha256:1"})
    assert found is not None
    listed_by_hand = b'{"a":"sha256:1","b":"sha256:2"}'
    assert found.files == 2
    assert found.digest == f"sha256:{hashlib.sha256(listed_by_hand).hexdigest()}"
    assert sent_files(application(cloud=[{"package": "p", "executable": "e"}]), {}) is None


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
        ({"cloud": [{"cmd": ["./a"]}], "files": []}, False, False),
        ({"cloud": [NODE], "files": ["config"]}, True, True),
    ],
)
def test_who_needs_files_on_a_machine(parts: dict[str, object], measured: bool, sent: bool) -> None:
    app = application(**parts)
    assert (measurement_sends_files(app.spec), sends_files(app.spec)) == (measured, sent)
    assert measured_record(app, None, {"a": "sha256:1"}).get("a") == ("sha256:1" if measured else None)


def test_images_without_pins_stay_as_they_are_named() -> None:
    app = application(ros={"image": "ros:jazzy"})
    assert pinned(app, Pins(catalog=CATALOG)) == app
    assert image_named(application(cloud=[NODE])) is None
    assert pinned(application(cloud=[NODE]), Pins(catalog=CATALOG)) == application(cloud=[NODE])
    assert (is_pinned(f"ros@{DIGEST}"), is_pinned("ros:jazzy"), is_pinned(DIGEST)) == (True, False, False)
    imageless = application(ros={"distro": "jazzy"})
    assert pinned(imageless, Pins(catalog=CATALOG, image=ImagePin(image="ros:jazzy", digest=DIGEST))) == imageless


def test_a_lock_is_beside_its_spec_and_found_also_without_it(tmp_path: Path) -> None:
    layout = Layout.of(tmp_path / "specs/arm/pair.yaml", "b@prod")
    layout.spec.parent.mkdir(parents=True)
    assert read_pins(layout) is None
    pins = Pins(catalog=CATALOG.model_copy(update={"origin": "b"}))
    (tmp_path / "specs/arm/b.lock").write_text(lock_text(pins))
    assert read_pins(layout) == pins
    assert read_pins(Layout.of(tmp_path / "specs/arm/pair.yaml", "a")) is None
    for name, text in (
        ("uv.lock", "version = 1\n"), (".venv/c.lock", lock_text(pins)), ("plan.lock", "apiVersion: fogspec.dev/v1\n")
    ):  # fmt: skip
        (tmp_path / "specs" / name).parent.mkdir(exist_ok=True)
        (tmp_path / "specs" / name).write_text(text)
    (tmp_path / "specs/link.lock").symlink_to("arm/b.lock")
    assert lock_files(tmp_path) == [tmp_path / "specs/arm/b.lock"]


def test_a_list_of_names_ends_after_six() -> None:
    assert some("abcdef") == "a, b, c, d, e, f"
    assert some("abcdefg") == "a, b, c, d, e, f and 1 more"
