"""What a spec names beside itself and is not there, at its place, by every command that reads the spec."""

from pathlib import Path

import pytest

from fogspec.base.diagnostics import DiagnosticError
from fogspec.language.loader import load
from tests.support.running import Shell, shell  # noqa: F401

SPEC = """\
apiVersion: fogspec.dev/v1alpha1
kind: Application
metadata: { name: arm }
spec:
  cloud:
    - {NODE}
  robot: [{ package: elsewhere, executable: x, parameter_files: [on-the-robot.yaml] }]
  ros: { distro: jazzy, image: 'ros:jazzy', workspace: ws, apt: [ros-jazzy-nav2-planner] }
  probe: { request: /a, response: /b }
  infra: [aws/us-east-1]
  benchmark: { budget: $2.50, workload: { node: { cmd: [play] } } }
"""


def absent(folder: Path, node: str) -> list[str]:
    """Line, message and fix of each error."""
    path = folder / "spec.yaml"
    path.write_text(SPEC.replace("{NODE}", node), "utf-8")
    (folder / "ws" / "src" / "deep" / "arm_planner").mkdir(parents=True, exist_ok=True)
    (folder / "ws/src/deep/arm_planner/package.xml").write_text("<package><name> arm_planner </name></package>")
    (folder / "ws" / "src" / "off").mkdir(exist_ok=True)
    (folder / "ws/src/off/package.xml").write_text("<package><name>left_out</name></package>")
    (folder / "ws/src/off/COLCON_IGNORE").touch()
    found = load([path])[0].absent()
    assert all((one.severity, one.code) == ("error", "FS545") for one in found), found
    return [f"{one.span.line}: {one.message}; {one.fix}" for one in found]


@pytest.mark.parametrize(
    "node",
    [
        "{ cmd: [ros2, launch, gqcnn_ros, planner.launch.py] }",
        "{ cmd: [python3, -m, http.server] }",
        "{ cmd: [python3, -c, print()] }",
        "{ cmd: [python3, /opt/arm/plan.py] }",
        "{ cmd: [plan] }",
        "{ package: arm_planner, executable: x }",
        "{ package: nav2_planner, executable: x }",
        "{ package: arm_planner, executable: x, parameter_files: ['$(find-pkg-share a)/p.yaml'] }",
    ],
)
def test_what_is_elsewhere_or_there_is_not_missed(tmp_path: Path, node: str) -> None:
    assert absent(tmp_path, node) == []


@pytest.mark.parametrize(
    ("node", "says"),
    [
        ("{ cmd: [python3, -u, plam.py] }", "spec.cloud[0].cmd[2] names plam.py, which is not there"),
        ("{ cmd: [./run.sh] }", "spec.cloud[0].cmd[0] names ./run.sh, which is not there"),
        ("{ cmd: [ros2, launch, arm.launch.py] }", "spec.cloud[0].cmd[2] names arm.launch.py, which is not there"),
        (
            "{ package: arm_planner, executable: x, parameter_files: [p.yaml] }",
            "spec.cloud[0].parameter_files[0] names p.yaml, which is not there",
        ),
        (
            "{ package: arm_planner, executable: x, composable_node_descriptions: "
            "[{ package: arm_planner, plugin: A, parameter_files: [p.yaml] }] }",
            "spec.cloud[0].composable_node_descriptions[0].parameter_files[0] names p.yaml, which is not there",
        ),
        ("{ package: arm_planer, executable: x }", "spec.cloud[0].package arm_planer is not in ws/src; write 'arm_planner'"),
        (
            "{ package: left_out, executable: x }",
            "spec.cloud[0].package left_out is not in ws/src; add it there, or ros-jazzy-left-out to spec.ros.apt",
        ),
    ],
)  # fmt: skip
def test_what_is_not_there_is_said_at_its_place(tmp_path: Path, node: str, says: str) -> None:
    [found] = absent(tmp_path, node)
    assert found.startswith(f"6: {says}")


SETUP = """\
from setuptools import setup
setup(name="arm_planner", entry_points={"console_scripts": ["plan = arm_planner.plan:main", "drive=arm_planner:main"]}{MORE})
"""
CMAKE = """\
project(arm_planner)  # add_executable(commented plan.cpp)
add_executable(plan src/plan.cpp)
rclcpp_components_register_node(parts PLUGIN "arm::Part" EXECUTABLE part_node)
install(PROGRAMS scripts/drive.py "scripts/look" DESTINATION lib/${PROJECT_NAME})
install(DIRECTORY launch DESTINATION share/${PROJECT_NAME})
"""


@pytest.mark.parametrize(
    ("name", "content", "executable", "fix"),
    [
        ("setup.py", SETUP.replace("{MORE}", ""), "plan", None), ("setup.py", SETUP.replace("{MORE}", ""), "drive", None),
        ("setup.py", SETUP.replace("{MORE}", ""), "plam", "write 'plan'"),
        ("setup.py", SETUP.replace("{MORE}", ""), "x", "it has: drive, plan"),
        ("setup.py", SETUP.replace("{MORE}", ", scripts=['x']"), "x", None), ("setup.py", "setup(**words)", "x", None),
        ("setup.py", "setup(", "x", None),
        *(("CMakeLists.txt", CMAKE, one, None) for one in ("plan", "part_node", "drive.py", "look")),
        ("CMakeLists.txt", CMAKE, "drives.py", "write 'drive.py'"),
        ("CMakeLists.txt", CMAKE, "commented", "it has: drive.py, look, part_node, plan"),
        ("CMakeLists.txt", CMAKE + "foreach(name a b)\nadd_executable(${name} x)\nendforeach()", "x", None),
        ("CMakeLists.txt", CMAKE + "add_executable(${PROJECT_NAME}_x x.cpp)", "x", None),
        ("CMakeLists.txt", CMAKE + "install(DIRECTORY scripts/ DESTINATION lib/${PROJECT_NAME})", "x", None),
    ],
)  # fmt: skip
def test_an_executable_that_its_package_surely_lacks_is_named(
    tmp_path: Path, name: str, content: str, executable: str, fix: str | None
) -> None:
    at = tmp_path / "ws" / "src" / "deep" / "arm_planner"
    at.mkdir(parents=True)
    (at / name).write_text(content)
    where = "6: spec.cloud[0].executable: the package arm_planner has no"
    said = [] if fix is None else [f"{where} {executable}; {fix}"]
    assert absent(tmp_path, f"{{ package: arm_planner, executable: {executable} }}") == said


def test_a_workspace_that_is_its_own_src_is_named_by_the_directory_above(tmp_path: Path) -> None:
    absent(tmp_path, "{ package: arm_planner, executable: x }")
    (tmp_path / "spec.yaml").write_text(
        (tmp_path / "spec.yaml").read_text().replace("workspace: ws", "workspace: ws/src")
    )
    (found,) = load([tmp_path / "spec.yaml"])[0].absent()
    assert (found.span.line, found.message, found.fix) == (
        8, "spec.ros.workspace must be the directory that has src, not src itself", "write 'ws'"
    )  # fmt: skip


def test_a_command_in_one_text_gets_the_list_as_its_fix(shell: Shell) -> None:
    shell.write("specs/arm.yaml", SPEC.replace("{NODE}", "{ cmd: python3 stitch.py }"))
    assert "^ write [python3, stitch.py]" in shell("validate", code=1).err


KINDS = {
    "workspace": ("ros: {distro: humble, workspace: ws}", "spec.ros.workspace names ws"),
    "parameter file": (
        "cloud: [{package: a, executable: b, parameter_files: [p.yaml]}]", "spec.cloud[0].parameter_files[0] names p.yaml"
    ),
    "program": ("cloud: [{cmd: [./plan]}]", "spec.cloud[0].cmd[0] names ./plan"),
    "script": ("cloud: [{cmd: [python3, plan.py]}]", "spec.cloud[0].cmd[1] names plan.py"),
    "bag": ("benchmark: {budget: $2.50, workload: {bag: run1}}", "spec.benchmark.workload.bag names run1"),
    "client": (
        "benchmark: {budget: $2.50, workload: {node: {cmd: [./ask]}}}", "spec.benchmark.workload.node.cmd[0] names ./ask"
    ),
}  # fmt: skip
VERBS = (
    ["validate", "specs/arm.yaml"],
    ["compile", "specs/arm.yaml"],
    ["lock", "specs/arm.yaml"],
    ["bench", "specs/arm.yaml", "--runner", "skypilot", "--dry-run"],
    ["bench", "specs/arm.yaml", "--runner", "skypilot", "--yes"],
)


@pytest.mark.parametrize("kind", KINDS)
def test_every_command_that_plans_pins_or_starts_says_the_same_and_writes_nothing(kind: str, shell: Shell) -> None:
    field, says = KINDS[kind]
    whole = {
        "cloud": "[{cmd: [/bin/true]}]", "probe": "{request: /a, response: /b}", "ros": "{distro: humble}",
        "infra": "[aws/us-east-1]", "benchmark": "{budget: $2.50}",
    }  # fmt: skip
    key, _, value = field.partition(": ")
    lines = "".join(f"  {name}: {value if name == key else usual}\n" for name, usual in whole.items())
    shell.write("specs/arm.yaml", SPEC.partition("  cloud:")[0] + lines)
    at = 6 + list(whole).index(key) - 1
    for words in VERBS:
        said = shell(*words, code=1).err
        assert f"error[FS545]: {says}, which is not there\n --> specs/arm.yaml:{at}:" in said, (words, said)
        assert "^ paths are relative to the spec's folder" in said
    assert [path.name for path in shell.folder.iterdir()] == ["specs"]


def test_names_that_init_made_up_are_refused(shell: Shell) -> None:
    shell("init", "arm")
    assert shell("validate").err.count("warning[FS523]") == 3
    for words in (["compile"], ["lock"], ["bench", "arm", "--runner", "local", "--yes"]):
        said = shell(*words, code=1).err
        assert "error[FS523]: spec.cloud[0].package is still the one that init made up" in said, words
        assert "error[FS523]: spec.benchmark.workload.node.package is still the one that init made up" in said, words
        assert "error[FS523]: spec.probe still has the topics that init made up" in said, words


def test_a_first_spec_beside_another_lists_its_files(shell: Shell) -> None:
    shell.write("specs/arm.yaml", SPEC.replace("{NODE}", "{ cmd: [plan] }") + "  files: []\n")
    shell("init", "specs/leg.yaml")
    assert "\n  files: [ros2_ws] " in shell.read("specs/leg.yaml")
    assert shell("validate", "specs/leg.yaml").err.count("warning[FS523]") == 3


def test_bench_says_that_nothing_sends_requests_before_it_asks_for_money(shell: Shell) -> None:
    spec = SPEC.replace("{NODE}", "{ cmd: [plan] }").replace(", workload: { node: { cmd: [play] } }", "")
    shell.write("specs/arm.yaml", spec.replace("workspace: ws, ", ""))
    for words, code in ((["validate"], 0), (["bench", "arm", "--runner", "local", "--yes"], 3)):
        said = shell(*words, code=code).err
        assert "warning[FS546]: spec.benchmark.workload is missing" in said, words
        assert "add 'workload: {node: {package: elsewhere, executable: x}}'" in said, words


PYTHON = """
class Arm(Node):
    def __init__(self):
        self.declare_parameter("speed_limit", 1.0)
        self.declare_parameters("", [("speed", 2)])
        self.declare_parameter(f"{side}_gain", 3)
        self.declare_parameter("rate_1", 4)
"""


@pytest.mark.parametrize(
    ("parameters", "says"),
    [
        ("speed_limit: 2.0, speed: 1, left_gain: 3", []),
        ("sped_limit: 2.0", ["6: arm_planner declares no parameter sped_limit; write 'speed_limit'"]),
        ("speedLimit: 2.0", ["6: arm_planner declares no parameter speedLimit; write 'speed_limit'"]),
        (
            "other: 1, rate_2: 5, pid: {sped_limit: 1}, use_sim_time: true",
            [],
        ),  # what is not a slip is asked of the node
    ],
)
def test_a_slip_in_a_parameter_is_found_in_the_python_of_its_package(
    tmp_path: Path, parameters: str, says: list[str]
) -> None:
    module = tmp_path / "ws" / "src" / "deep" / "arm_planner" / "arm_planner" / "arm.py"
    module.parent.mkdir(parents=True)
    module.write_text(PYTHON)
    node = "{ package: arm_planner, executable: x, parameters: { PARAMETERS } }".replace("PARAMETERS", parameters)
    assert absent(tmp_path, node) == says
    module.write_text(f"{PYTHON}ALIASES = ['sped_limit', 'speedLimit']\n")
    assert absent(tmp_path, node) == []
    module.write_text("this is no Python")
    assert absent(tmp_path, node) == []


METADATA = """
rosbag2_bagfile_information:
  topics_with_message_count:
    - topic_metadata:
        name: /b
        type: std_msgs/msg/Header
      message_count: 3
    - topic_metadata:
        name: {topic}
      message_count: {count}
    - topic_metadata:
        name: /silent
      message_count: 0
"""


@pytest.mark.parametrize(
    ("topic", "count", "says"),
    [
        ("/a", 1, []),
        ("/c", 1, ["spec.benchmark.workload.bag names drive, which has no message of /a; the bag has /b, /c"]),
        ("/a", 0, ["spec.benchmark.workload.bag names drive, which has no message of /a; the bag has /b"]),
    ],
)
def test_a_bag_that_lacks_the_request_is_found_by_its_list_of_topics(
    tmp_path: Path, topic: str, count: int, says: list[str]
) -> None:
    (tmp_path / "ws" / "src").mkdir(parents=True)
    (tmp_path / "drive").mkdir()
    (tmp_path / "drive" / "metadata.yaml").write_text(METADATA.format(topic=topic, count=count))
    path = tmp_path / "spec.yaml"
    text = SPEC.replace("{NODE}", "{ cmd: [plan] }").replace("node: { cmd: [play] }", "bag: drive")
    path.write_text(text, "utf-8")
    found = load([path])[0].absent()
    assert [f"{one.message}; {one.fix}" for one in found] == says
    assert load([path])[0].absent(measured=False) == []
    (tmp_path / "drive" / "drive_0.db3.zstd").touch()
    assert [f"{one.message}; {one.fix}" for one in load([path])[0].absent()] == [
        "spec.benchmark.workload.bag names drive, which is compressed file by file, and is not played so; "
        "run 'zstd -d --rm drive/*.zst*' in the spec's folder"
    ]
    (tmp_path / "drive" / "drive_0.db3").touch()
    assert len(load([path])[0].absent()) == len(says)


POINTER = "version https://git-lfs.github.com/spec/v1\noid sha256:{}\nsize 734003200\n".format("4d" * 32)


def test_files_that_git_has_not_filled_are_named_with_the_command(tmp_path: Path) -> None:
    for name in (
        "ws/src/deep/weights.onnx",
        "drive/drive.mcap",
        "work.py",
        "other.bin",
        "left/out.bin",
        "ws/src/late/x",
    ):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(POINTER)
    (tmp_path / "ws/src/late/x").unlink()
    (tmp_path / "real.bin").write_text(POINTER + "x" * 1000)  # only short files are pointers
    (tmp_path / "link.bin").symlink_to("work.py")
    (tmp_path / ".git").mkdir()
    (tmp_path / ".gitmodules").write_text(
        '[submodule "a"]\n\tpath = ws/src/late\n\turl = x\n'
        '[submodule "b"]\n\tpath = "ws/src/deep"\n[submodule "c"]\n\tpath = gone\n'
    )
    (tmp_path / "left" / "spec.yaml").write_text("apiVersion: fogspec.dev/v1alpha1\nkind: Application\n")
    node = "{ cmd: [python3, work.py] }"
    what = "is a pointer of Git LFS, not the file; run 'git lfs pull'"
    assert sorted(absent(tmp_path, node)) == [
        "3: drive/drive.mcap, which machines get, " + what,
        "3: other.bin, which machines get, " + what,
        "6: work.py, which machines get, " + what,
        "8: ws/src/deep/weights.onnx, which machines get, " + what,
        "8: ws/src/late, which machines get, is the empty folder of a submodule; "
        "run 'git submodule update --init ws/src/late'",
    ]


@pytest.mark.parametrize("name", ["spec.yaml", "plan.yaml"])
def test_a_document_that_is_a_pointer_says_so(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text(POINTER)
    with pytest.raises(DiagnosticError) as refused:
        load([tmp_path / name])
    (one,) = refused.value.diagnostics
    assert (one.message, one.fix) == (
        "the file cannot be read: it is a pointer of Git LFS, not the file", "run 'git lfs pull'",
    )  # fmt: skip
