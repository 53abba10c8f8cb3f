"""What a machine tells of its server, and what is believed of it."""

import json
from pathlib import Path

import pytest

from fogspec.agent import machine_facts
from fogspec.backends.agent_state import read_outcome, server_facts
from fogspec.results.schema import ServerFacts

X86 = """\
processor\t: 0
model name\t: AMD EPYC 7452   32-Core Processor
cpu MHz\t\t: 2345.678
flags\t\t: fpu avx avx2 fma hypervisor
microcode\t: 0x830107c

processor\t: 1
model name\t: AMD EPYC 7452   32-Core Processor
cpu MHz\t\t: 2345.000
"""
ARM = "processor\t: 0\nFeatures\t: fp asimd sve crc32\nCPU implementer\t: 0x41\nCPU part\t: {part}\n"
STAT = "cpu  100 0 50 800 0 0 0 {stolen} 0 0\ncpu0 1 1\nprocs_running {running}\n"


def host(tmp_path: Path, cpuinfo: str = X86, stolen: int = 50, running: int = 3, sockets: int = 1) -> tuple[Path, Path]:
    proc, cpus = tmp_path / "proc", tmp_path / "cpu"
    proc.mkdir(exist_ok=True)
    (proc / "cpuinfo").write_text(cpuinfo)
    (proc / "stat").write_text(STAT.format(stolen=stolen, running=running))
    for thread in range(4):
        topology = cpus / f"cpu{thread}" / "topology"
        topology.mkdir(parents=True, exist_ok=True)
        (topology / "physical_package_id").write_text(f"{thread % sockets}\n")
        (topology / "core_id").write_text(f"{thread // 2}\n")
    return proc, cpus


def test_an_x86_server(tmp_path: Path) -> None:
    before = machine_facts.read(*host(tmp_path))
    found = machine_facts.between(before, machine_facts.read(*host(tmp_path, stolen=150, running=7)))
    assert found.pop("arch")
    assert found == {
        "cpu": "AMD EPYC 7452 32-Core Processor", "features": ["avx", "avx2", "fma"], "sockets": 1, "cores": 2, "threads": 4,
        "clock_ghz": 2.345, "run_queue": 6, "steal": 1.0, "io_wait": 0.0,
    }  # fmt: skip


@pytest.mark.parametrize(("part", "cpu"), [("0xd40", "Neoverse-V1"), ("0xabc", "Arm 0x41 0xabc")])
def test_an_arm_server(tmp_path: Path, part: str, cpu: str) -> None:
    found = machine_facts.read(*host(tmp_path, ARM.format(part=part), sockets=2))
    assert (found["cpu"], found["features"], found["sockets"], found["cores"]) == (cpu, ["asimd", "sve"], 2, 4)
    assert "clock_ghz" not in found


def test_a_cpu_that_changed(tmp_path: Path) -> None:
    before = machine_facts.read(*host(tmp_path))
    found = machine_facts.between(before, machine_facts.read(*host(tmp_path, X86.replace("7452", "7763"))))
    assert (found["cpu"], found["changed_to"]) == ("AMD EPYC 7452 32-Core Processor", "AMD EPYC 7763 32-Core Processor")


def test_a_host_that_tells_nothing(tmp_path: Path) -> None:
    nothing = machine_facts.read(tmp_path / "none", tmp_path / "none")
    assert set(machine_facts.between(nothing, nothing)) == {"arch"}
    assert server_facts(machine_facts.between(nothing, nothing)) is None


SOUND = {"cpu": "AMD EPYC 7452", "arch": "x86_64", "cores": 2, "threads": 4, "steal": 0.013, "clock_ghz": 2.6}


@pytest.mark.parametrize(
    "wrong",
    [
        {"steal": 1.5}, {"steal": -0.1}, {"steal": float("nan")}, {"steal": True}, {"cores": 0}, {"threads": 10**9},
        {"clock_ghz": 1e9}, {"arch": "x86; rm"}, {"features": ["avx", "$(x)"]}, {"features": "avx"}, {"run_queue": -1},
        {"sockets": 2.5}, {"changed_to": 7},
    ],
)  # fmt: skip
def test_impossible_facts_are_left_out_and_the_others_stay(wrong: dict[str, object]) -> None:
    found = server_facts({**SOUND, **wrong})
    assert found == ServerFacts(**{name: one for name, one in SOUND.items() if name not in wrong})


@pytest.mark.parametrize("said", [None, 5, [], {}, {"cpu": ""}, {"cpu": 7}, {"cores": 2}, {"cpu": None}])
def test_without_a_cpu_there_are_no_facts(said: object, tmp_path: Path) -> None:
    (tmp_path / "outcome.json").write_text(json.dumps({"state": "ok", "setup_s": 1, "server": said}))
    outcome = read_outcome(tmp_path / "outcome.json")
    assert outcome is not None
    assert (outcome.server, outcome.setup_s) == (None, 1.0)


def test_a_name_with_control_characters_is_tidied_and_cut() -> None:
    found = server_facts({"cpu": "\x1b[31m" + "x" * 500})
    assert found is not None
    assert found.cpu == "[31m" + "x" * 116


def test_the_facts_for_people() -> None:
    facts = ServerFacts(cpu="EPYC 7452", sockets=2, cores=2, threads=4, clock_ghz=2.61, steal=0.0312, run_queue=9)
    assert (
        facts.line()
        == "EPYC 7452, 2 sockets, 2 cores, 4 threads, 2.6 GHz, 3.1% of its time stolen, 9 tasks waiting to run"
    )
    assert ServerFacts(cpu="EPYC 7452", steal=0.0).line() == "EPYC 7452"
