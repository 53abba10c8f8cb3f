"""Places and instance types that no catalog knows, said by `validate` with the name that was meant."""

from pathlib import Path

import pytest

from fogspec.catalog.names import bundled, nearest
from fogspec.catalog.sources.snapshot import Snapshot
from fogspec.language.loader import read_document
from fogspec.plan.schema import Plan
from tests.support.running import Shell, shell  # noqa: F401

SPEC = """\
apiVersion: fogspec.dev/v1alpha1
kind: Application
metadata: {{ name: arm }}
spec:
  cloud: [{{ cmd: [plan] }}]
  probe: {{ callback: plan }}
  infra: [{infra}]
  hardware: {{ allow: [{allow}], gpus: [{gpus}] }}
  benchmark: {{ budget: $2.50, machines: [{machines}] }}
"""
TABLE = "InstanceType,AcceleratorName,vCPUs,MemoryGiB,Price,Region,AvailabilityZone\n"


def said(shell: Shell, infra: str, allow: str = "standard", machines: str = "", gpus: str = "none") -> list[str]:
    shell.write("specs/arm.yaml", SPEC.format(infra=infra, allow=allow, machines=machines, gpus=gpus))
    lines = shell("validate").err.splitlines()
    return [
        f"{head.partition(' names ')[2].partition(',')[0]}: {lines[i + 4].partition('^ ')[2]}"
        for i, head in enumerate(lines)
        if head.startswith("warning[FS547]")
    ]


@pytest.mark.parametrize(
    ("infra", "fix"),
    [
        ("aws/us-eest-1", "write 'aws/us-east-1' or 'aws/us-west-1'"),
        ("aws/us-esat-1", "write 'aws/us-east-1'"),
        ("aws/useast1", "write 'aws/us-east-1'"),
        ("aws/eu-south", "write 'aws/eu-south-1' or 'aws/eu-south-2'"),
        ("aws/eu-north-7", "if it is new, give compile a list that has it: --catalog"),
    ],
)
def test_a_misspelt_region_is_said_with_the_nearest_name(shell: Shell, infra: str, fix: str) -> None:
    assert said(shell, infra) == [f"{infra}: {fix}"]


@pytest.mark.parametrize(
    "infra",
    [
        "aws",
        "aws/*",
        "aws/ap-east-1",
        "aws/us-east-1/us-east-1a",
        "gcp/us-centrl1",
        "kubernetes/my-context",
        "slurm/lab",
    ],
)
def test_what_may_be_right_is_not_called_a_slip(shell: Shell, infra: str) -> None:
    assert said(shell, infra, "anything" if not infra.startswith("aws") else "standard") == []


def test_a_zone_is_one_of_its_region(shell: Shell) -> None:
    found = said(shell, "aws/us-east-1/us-west-1a")
    assert found == ["aws/us-east-1/us-west-1a: a zone's name begins with its region's: us-east-1"]


def test_instance_types_and_patterns(shell: Shell) -> None:
    assert said(shell, "aws", "c6i.*, p5.48xlarge, '*'", "m5.large, local/1cpu-1gib") == []
    assert said(shell, "aws", "cc6i.*, c99i.*", "m5-largee") == [
        "cc6i.*: write 'c6i.*'",
        "c99i.*: if it is new, give compile a list that has it: --catalog",
        "m5-largee: write 'm5.large'",
    ]


def test_the_catalog_of_the_lock_or_of_skypilot_counts_too(
    shell: Shell,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.setenv("SKY_RUNTIME_DIR", str(tmp_path / "runtime"))
    assert said(shell, "gcp/us-centrl1") == []
    tables = tmp_path / "runtime" / ".sky" / "catalogs" / "v8"
    for cloud, rows in (
        ("gcp", "n2-standard-4,,4,16,0.2,us-central1,us-central1-a\n"),
        ("aws", "z9.big,,4,16,0.2,us-new-1,\n"),
    ):
        (tables / cloud).mkdir(parents=True)
        (tables / cloud / "vms.csv").write_text(TABLE + rows)
    assert said(shell, "gcp/us-centrl1, aws/us-new-1") == ["gcp/us-centrl1: write 'gcp/us-central1'"]
    assert said(shell, "gcp/us-central1/us-central1-s") == [
        "gcp/us-central1/us-central1-s: write 'gcp/us-central1/us-central1-a'"
    ]
    assert said(shell, "gcp/us-central1", "n2-standart-4, n2-*") == ["n2-standart-4: write 'n2-standard-4'"]
    assert said(shell, "gcp/us-central1, aws", "n2-standard-4, z9.big") == []


def test_a_spec_whose_names_are_right_reads_no_catalog(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fogspec.compile.inputs.load_catalog", None)
    assert said(shell, "aws/us-east-1, local", "c6i.*", "c6i.large") == []
    assert said(shell, "aws/us-esat-1", "c6i.*", "c6i.large") != []


def test_every_name_of_the_bundled_list_is_known() -> None:
    found = Snapshot("", []).load()
    assert bundled().regions["aws"] >= set(found.region.tolist())
    assert bundled().instances["aws"] >= set(found.instance.tolist())


def test_a_changed_digit_is_another_family() -> None:
    assert nearest("c8i.large", ["c7i.large", "c6i.large"]) == []
    assert nearest("c77i.large", ["c7i.large"]) == ["c7i.large"]
    assert nearest("us-eats-1", ["us-east-1", "us-east-2"]) == ["us-east-1"]


def test_compile_says_which_place_it_has_no_machine_in(shell: Shell) -> None:
    spec = SPEC.format(infra="aws/us-eest-1, aws/us-east-1", allow="standard", machines="", gpus="none")
    shell.write("specs/arm.yaml", spec)
    assert "the catalog has no machine in aws/us-eest-1; did you mean aws/us-west-1" in shell("compile").err


@pytest.mark.parametrize(("name", "fix"), [
    ("T4 GPU", "write 'T4'"), ("NVIDIA L4 gpu", "write 'L4'"), ("Tesla T4", "write 'T4'"), ("A100-40GB", "write 'A100'"),
    ("'T44:8'", "write 'T4:8'"), ("Quantum9", "if it is new, give compile a list that has it: --catalog"),
])  # fmt: skip
def test_a_gpu_that_no_catalog_has_is_a_warning(shell: Shell, name: str, fix: str) -> None:
    (found,) = said(shell, "aws", gpus=f"none, t4, 'T4:4', A40, tpu-v5p-8, {name}")
    assert found.partition(": ")[2] == fix


LAB = "Cloud,InstanceType,vCPUs,MemoryGiB,AcceleratorName,AcceleratorCount,Price,Region\n"


def test_a_gpu_of_the_given_list_is_one(shell: Shell) -> None:
    rows = [f"slurm,n{i},16,64,{name},{count},0.60,lab\n" for i, (name, count) in enumerate(
        [("Quantum9", 1), ("Quantum9", 4), ("RTX 9000 Pro", 1)])]  # fmt: skip
    shell.write("lab.csv", LAB + "".join(rows))
    machines = {"Quantum9": ["n0"], "Quantum9:4": ["n1"], "quantum9, rtx 9000 pro": ["n0", "n2"]}
    for gpus, wanted in machines.items():
        listed = ", ".join(f"'{one}'" for one in gpus.split(", "))
        text = SPEC.format(infra="slurm/lab", allow="standard", machines="", gpus=listed)
        shell.write("specs/arm.yaml", text.replace("budget: $2.50, machines: []", "budget: $9"))
        ended = shell("compile", "--catalog", "lab.csv")
        plan = read_document(shell.folder / "compiled/arm/plan.yaml", Plan)
        assert "no catalog here has" not in ended.err
        assert sorted(one.machine.instance for one in plan.spec.samples) == wanted
    shell.write(
        "specs/arm.yaml", text.replace("'quantum9'", "Quantun9").replace("budget: $2.50, machines: []", "budget: $9")
    )
    assert (
        "names Quantun9, and no catalog here has such a GPU: write 'Quantum9'"
        in shell("compile", "--catalog", "lab.csv").err
    )


def test_every_name_of_a_place_that_a_list_has_is_one(shell: Shell) -> None:
    odd = (
        "vast/Poland, PL, EU",
        "vast/, US, NA",
        "vast/Hafnarfj\u00f6r\u00f0ur, IS, EU",
        "kubernetes/arn:aws:eks:x:1:cluster/a",
    )
    for place in odd:
        assert all("FS531" not in one for one in said(shell, f"'{place}'")), place
