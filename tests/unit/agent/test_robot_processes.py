"""How a node was started, from the command line of its process."""

import os
import subprocess
import sys
from pathlib import Path

from fogspec.agent.robot_processes import Processes, started


def test_an_installed_node_with_its_ros_arguments() -> None:
    words = "/usr/bin/python3 /opt/ros/jazzy/lib/demo_nodes_py/talker --fast --ros-args -r __node:=t -r a:=/b -r a:=/c"
    found = started([*words.split(), "--params-file", "p.yaml", "-p", "x:=1", "--", "last"])
    assert found == {
        "package": "demo_nodes_py", "executable": "talker", "remappings": {"__node": "t", "a": "/b"},
        "arguments": ["--fast", "last"], "parameter_files": ["p.yaml"],
    }  # fmt: skip


def test_a_program_that_is_not_installed_and_words_that_are_cut_off() -> None:
    found = started(["python3", "node.py", "--ros-args", "-r"])
    assert (found["package"], found["remappings"]) == (None, {"": ""})


def test_a_process_is_found_by_the_identifier_of_its_endpoints_or_by_its_node_s_name() -> None:
    words = [sys.executable, "-c", "import time; time.sleep(60)", "--ros-args", "-r", "__node:=sleeper_of_this_test"]
    child = subprocess.Popen(words)
    try:
        host = b"\x01\x0f\x12\x34"
        gid = host + (child.pid & 0xFFFF).to_bytes(2, "little") + bytes(10)
        while not Path(f"/proc/{child.pid}/cmdline").read_text().endswith("test\0"):
            os.sched_yield()
        for gids, own in (({"/any": gid}, host), ({"/any/sleeper_of_this_test": b""}, b"")):
            processes = Processes()
            processes.add(gids, own)
            found = processes.of(next(iter(gids)))
            assert found is not None
            assert found["argv"] == words
            assert found["memory_bytes"] > 0
        elsewhere = Processes()
        elsewhere.add({"/any": gid}, b"\x01\x0f\x99\x99")  # on another computer
        assert elsewhere.of("/any") is None
    finally:
        child.kill()
        child.wait()
