"""A part of a machine: whole cores, one socket first, and what runs in it stays in it."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from fogspec.agent.confinement import Confinement, together
from fogspec.agent.sample import Part

GIB = 2**30


def host(folder: Path, sockets: int, cores: int) -> Path:
    """CPUs as Linux numbers them: first threads of all cores, then second ones."""
    count = sockets * cores
    for cpu in range(2 * count):
        topology = folder / f"cpu{cpu}" / "topology"
        topology.mkdir(parents=True)
        (topology / "thread_siblings_list").write_text(f"{cpu % count},{cpu % count + count}\n")
        (topology / "physical_package_id").write_text(f"{cpu % count // cores}\n")
    return folder


def test_both_threads_of_a_core_and_all_cores_of_a_socket_stand_together(tmp_path: Path) -> None:
    cpus = host(tmp_path, sockets=2, cores=2)
    assert together(range(8), cpus) == [0, 4, 1, 5, 2, 6, 3, 7]
    assert together({1, 5, 7, 3}, cpus) == [1, 5, 3, 7]
    assert together([3, 1], tmp_path / "none") == [1, 3]


def test_what_is_started_in_a_part_has_its_vcpus_and_this_process_all_of_its_own_again() -> None:
    before = os.sched_getaffinity(0)
    with Confinement(1, GIB) as part:
        count = [sys.executable, "-c", "import os; print(len(os.sched_getaffinity(0)))"]
        said = subprocess.run(part.command(count), capture_output=True, text=True, check=True)
        assert said.stdout == "1\n"
        assert part.facts()["cpus_by"] in ("cpuset", "affinity")
        assert part.kills() == 0
        group = part.group
    assert os.sched_getaffinity(0) == before
    assert group is None or not group.exists()


def test_more_vcpus_than_there_are_are_no_part() -> None:
    with pytest.raises(OSError, match="may be used"):
        Confinement(len(os.sched_getaffinity(0)) + 1, GIB)


def test_limits_are_written_where_a_cgroup_can_be_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder in place of the kernel's, which makes the files of a new cgroup as the kernel does."""
    _, version_2, own = Path("/proc/self/cgroup").read_text().partition("0::/")
    if not version_2:
        pytest.skip("needs cgroups of version 2")
    here = tmp_path / own.strip()
    here.mkdir(parents=True, exist_ok=True)
    (here / "cgroup.procs").touch()
    mkdir = Path.mkdir

    def made(self: Path, *words: object, **more: object) -> None:
        mkdir(self, *words, **more)  # type: ignore[arg-type]
        for name in ("cpuset.cpus", "memory.max", "memory.swap.max", "cgroup.procs", "memory.events"):
            (self / name).write_text("oom_kill 2\n" if name == "memory.events" else "")

    monkeypatch.setattr(Path, "mkdir", made)
    monkeypatch.setattr(Path, "rmdir", lambda self: [one.unlink() for one in self.iterdir()] and os.rmdir(self))
    with Confinement(1, GIB, tmp_path) as part:
        assert part.group is not None
        assert (part.group / "memory.max").read_text() == str(GIB)
        assert (part.group / "cpuset.cpus").read_text() == str(part.cpus[0])
        assert part.facts() == {"cpus_by": "cpuset", "memory_by": "cgroup"}
        assert part.kills() == 2
        assert part.command(["true"])[-2:] == [str(part.group / "cgroup.procs"), "true"]
    assert not part.group.exists()


@pytest.mark.parametrize(
    "text", ["", "half", "half:0:1", "half:1:0", "Half:1:1", "../x:1:1", "half:1:1:1", "half:-1:5"]
)
def test_a_part_is_a_name_vcpus_and_bytes(text: str) -> None:
    assert Part.parse("half:2:4294967296") == Part("half", 2, 2**32)
    with pytest.raises(ValueError, match=f"^{re.escape(text)}$"):
        Part.parse(text)
