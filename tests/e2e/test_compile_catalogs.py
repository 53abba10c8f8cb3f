"""Where machines and prices come from, through the command line."""

import json
import os
import re
import shutil
import sys
from pathlib import Path

import pytest

from fogspec.model.library import BUILT_IN
from tests.support.running import CATALOG, Shell, measure, project, shell, spec  # noqa: F401

AT = ("--catalog", "offers.csv")
GCP = """InstanceType,vCPUs,MemoryGiB,AcceleratorName,AcceleratorCount,GpuInfo,Region,AvailabilityZone,Price,SpotPrice
n1-standard-4,4,15,,,,us-central1,us-central1-a,0.19,0.04
n1-standard-4,4,15,,,,us-central1,us-central1-b,0.20,0.04
n1-standard-8,8,30,,,,us-central1,us-central1-a,0,0.08
,,,T4,1,,us-central1,us-central1-a,0.35,0.14
,,,T4,1,,us-central1,us-central1-b,0.35,0.14
"""


@pytest.fixture
def clouds(shell: Shell) -> Shell:
    """SkyPilot's folder of catalogs in a home of its own, and two specs."""
    home = shell.folder.parent / "home"
    shell.monkeypatch.setenv("HOME", str(home))
    shell.monkeypatch.delenv("SKY_RUNTIME_DIR", raising=False)
    for cloud, text in (("aws", CATALOG), ("gcp", GCP)):
        path = home / ".sky" / "catalogs" / "v8" / cloud / "vms.csv"
        path.parent.mkdir(parents=True)
        path.write_text(text)
        os.utime(path, (1.79e9, 1.79e9))  # 2026-09-21
    shell.write("specs/work.py", "print('work')\n")
    shell.write("specs/demo.yaml", spec())
    shell.neighbour("both", spec("both", infra="[aws/r1, gcp/us-central1]", hardware="{cpus: 2..8, gpus: [none, T4]}"))
    return shell


def provenance(shell: Shell, name: str) -> str:
    return re.search(r"  catalog:\n((?:    .*\n)+)", shell.read(f"compiled/{name}/plan.yaml"))[1]


def test_skypilots_own_tables_are_read_without_skypilot(clouds: Shell) -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] == "sky"]:
        clouds.monkeypatch.delitem(sys.modules, name)  # another test of this process had it
    clouds("compile", "specs/both/both.yaml", "--catalog", "skypilot")
    assert "sky" not in sys.modules
    plan = clouds.read("compiled/both/plan.yaml")
    assert "source: skypilot" in plan
    assert 'date: "2026-09-21"' in plan
    assert "gcp/us-central1, instance: n1-standard-4, cpus: 4, memory: 15GiB, gpu: {name: T4, count: 1}" in plan
    assert "price: $0.55/h" in plan, "host and accelerator at the dearest zone"
    explained = clouds("explain", "specs/both/both.yaml").out
    assert "offer" in explained


def test_rows_without_a_price_are_said_aloud(clouds: Shell) -> None:
    said = clouds("compile", "specs/both/both.yaml", "--catalog", "skypilot").err
    assert "gcp/vms.csv: 1 row has a price of 0: not a candidate, such as n1-standard-8 at line 4" in said


def test_only_the_tables_of_the_clouds_that_a_spec_names_count(clouds: Shell) -> None:
    clouds("compile", "specs/demo.yaml", "specs/both/both.yaml", "--catalog", "skypilot")
    alone, both = provenance(clouds, "demo"), provenance(clouds, "both")
    (clouds.folder.parent / "home/.sky/catalogs/v8/gcp/vms.csv").write_text(GCP.replace("0.19", "0.21"))
    clouds("compile", "specs/demo.yaml", "specs/both/both.yaml", "--catalog", "skypilot")
    assert provenance(clouds, "demo") == alone
    assert provenance(clouds, "both") != both


def test_a_table_that_is_missing_is_named_with_the_way_to_get_it(clouds: Shell) -> None:
    clouds.write("specs/demo.yaml", spec(infra="[azure/eastus]"))
    wrong = clouds("compile", "specs/demo.yaml", "--catalog", "skypilot", code=1).err
    assert "no table of azure" in wrong
    assert "sky gpus list --infra azure" in wrong


def test_a_folder_in_skypilots_layout_is_a_catalog_too(clouds: Shell) -> None:
    shutil.copytree(clouds.folder.parent / "home/.sky/catalogs/v8", clouds.folder / "v8")
    clouds("compile", "specs/demo.yaml", "--catalog", "v8")
    assert "source: v8" in clouds.read("compiled/demo/plan.yaml")


def test_an_old_catalog_is_warned_of_on_compile_as_the_spec_allows(clouds: Shell) -> None:
    assert "days old" not in clouds("compile", "specs/demo.yaml", "--catalog", "skypilot").err
    clouds.write("specs/demo.yaml", spec(max_price_age="1h"))
    assert "spec.max_price_age allows" in clouds("compile", "specs/demo.yaml", "--catalog", "skypilot").err
    assert "max_price_age" not in clouds("explain", "specs/demo.yaml").err
    clouds.write("specs/demo.yaml", spec(max_price_age="0s"))
    assert "max_price_age" in clouds("validate", "specs/demo.yaml", code=1).err


def test_how_good_the_bundled_prices_are_is_said_once_on_compile(clouds: Shell) -> None:
    machines = "{cpus: 2..4, allow: [c6i.*]}"
    clouds.write("specs/work.py", "")
    clouds.write("specs/demo.yaml", spec(infra="[aws/us-east-1]", hardware=machines))
    said = clouds("compile", "specs/demo.yaml", "--catalog", "snapshot")
    assert said.out.count("in July 2026, 740 of its 741 prices in us-east-1 were unchanged, and 458 types were") == 1
    assert said.err == ""
    for command in ("explain", "status", "diff"):
        looked = clouds(command, "specs/demo.yaml", code=None)
        assert "days old" not in looked.err
        assert "July 2026" not in looked.out + looked.err
    clouds.write("specs/demo.yaml", spec(infra="[aws/us-east-1]", hardware=machines, max_price_age="30d"))
    assert "days old" in clouds("compile", "specs/demo.yaml", "--catalog", "snapshot").err


def test_skypilots_own_lists_are_the_default_where_they_are(clouds: Shell) -> None:
    assert "catalog   skypilot, 2026-09-21: 4 admissible machines" in clouds("compile", "specs/demo.yaml").out
    clouds("lock", "specs/demo.yaml")
    assert "origin: skypilot" in clouds.read("specs/demo.lock")
    clouds.neighbour("other", spec("other", infra="[aws/us-east-1, azure/eastus]", hardware="{cpus: 2..4}"))
    shown = clouds("compile", "specs/other/other.yaml").out
    assert "catalog   fogspec snapshot" in shown, "SkyPilot has no list of azure here"


def test_a_list_without_prices_or_with_strange_names_is_clear_about_it(clouds: Shell) -> None:
    head = CATALOG.splitlines()[0]
    clouds.write("none.csv", f"Cloud,{head}\naws,a.small,,,2,4,,,r1,\naws,a.large,,,8,16,,,r1,\n")
    ended = clouds("compile", "specs/demo.yaml", "--catalog", "none.csv", code=4)
    assert "none.csv: 2 rows have no price: not a candidate, such as a.small at line 2" in ended.err
    clouds.write("odd.csv", f"Cloud,{head}\naws,Standard_D2s_v5,,,2,4,0.1,,r1,\naws,a.large,,,8,16,0.4,,r1,\n")
    said = clouds("compile", "specs/demo.yaml", "--catalog", "odd.csv").err
    assert "odd.csv: no family of aws is named like Standard" in said


def test_the_lock_says_which_catalog_and_a_new_one_is_refused_until_it_is_locked(clouds: Shell) -> None:
    clouds("lock", "specs/demo.yaml", "--catalog", "skypilot")
    clouds("compile", "specs/demo.yaml")
    assert "source: skypilot" in clouds.read("compiled/demo/plan.yaml")
    table = clouds.folder.parent / "home/.sky/catalogs/v8/aws/vms.csv"
    os.utime(table)
    clouds("check", "specs/demo.yaml")
    table.write_text(CATALOG.replace("0.10", "0.11"))
    assert "--upgrade catalog" in clouds("compile", "specs/demo.yaml", code=3).err
    clouds("check", "specs/demo.yaml", code=3)
    clouds("lock", "specs/demo.yaml", "--upgrade", "catalog")
    clouds("compile", "specs/demo.yaml")
    assert "$0.11/h" in clouds.read("compiled/demo/plan.yaml")


def test_a_catalog_that_was_read_once_is_read_from_the_cache_and_a_damaged_cache_is_no_matter(clouds: Shell) -> None:
    clouds("compile", "specs/both/both.yaml", "--catalog", "skypilot")
    kept = sorted((clouds.folder.parent / "cache/fogspec/catalogs").glob("*.npz"))
    assert len(kept) == 2
    before = {path.name: path.read_bytes() for path in clouds.folder.rglob("*.yaml")}
    clouds.monkeypatch.setattr("fogspec.catalog.sources.csv.read", lambda *_: pytest.fail("parsed again"))
    said = clouds("compile", "specs/both/both.yaml", "--catalog", "skypilot").err
    assert "a price of 0" in said, "what was left out is said again"
    assert {path.name: path.read_bytes() for path in clouds.folder.rglob("*.yaml")} == before
    clouds.monkeypatch.undo()
    clouds.monkeypatch.setenv("HOME", str(clouds.folder.parent / "home"))
    clouds.monkeypatch.setenv("XDG_CACHE_HOME", str(clouds.folder.parent / "cache"))
    for path, content in zip(kept, (b"", kept[1].read_bytes()[:-300]), strict=True):
        path.write_bytes(content)
    clouds("check", "specs/both/both.yaml")


def test_a_cache_that_cannot_be_written_is_no_matter(clouds: Shell) -> None:
    Path(clouds.folder.parent / "cache").write_text("a file where the folder would be")
    clouds("compile", "specs/demo.yaml", "--catalog", "skypilot")


def test_the_funnel_counts_every_filter(clouds: Shell) -> None:
    facts = json.loads(clouds("explain", "specs/demo.yaml", "-o", "json").out)[0]
    assert "11" in json.dumps(facts["funnel"]), "8 on demand and 3 spot"


def test_a_plan_names_its_price_list_and_later_commands_read_it(shell: Shell) -> None:
    project(shell)
    measure(shell)
    shell("compile", "demo", *AT)
    assert "    origin: offers.csv\n" in provenance(shell, "demo")
    for words in (("status",), ("menu", "demo"), ("explain", "demo"), ("diff",), ("compile",)):
        shell(*words)
    states = {stage["state"] for stage in json.loads(shell("status", "-o", "json").out)[0]["stages"]}
    assert states == {"fresh"}
    shell.write("offers.csv", CATALOG.replace("a.small,,,2,4,0.10", "a.small,,,2,4,0.15"))
    assert "new catalog, re-estimated" in shell("status").out
    elsewhere = shell.folder.parent / "elsewhere.csv"
    elsewhere.write_text(CATALOG)
    for verb in ("compile", "lock"):
        refused = shell(verb, "demo", "--catalog", str(elsewhere), code=2).err
        assert "elsewhere.csv is not in the project" in refused
        assert f"cp -r {elsewhere} ." in refused
    shell("compile", "demo", *AT)
    whole = shell.read("compiled/demo/plan.yaml")
    shell.write("compiled/demo/plan.yaml", whole.replace("origin: offers.csv", f"origin: ../{elsewhere.name}"))
    refused = shell("menu", "demo", code=5).err
    assert "elsewhere.csv, which is not in the project" in refused
    assert "fogspec compile specs/demo.yaml --catalog FILE" in refused
    assert "FAIL  demo" in shell("check", code=3).out, "a reason of this application, and of no other"
    shell("compile", "demo", *AT)
    (shell.folder / "offers.csv").unlink()
    (shell.folder / "offers.csv").symlink_to(elsewhere)
    assert "link" in shell("menu", "demo", code=None).err
    assert "FAIL  demo" in shell("check", code=3).out
    (shell.folder / "offers.csv").unlink()
    assert "offers.csv: the catalog cannot be read" in shell("menu", "demo", code=1).err


def test_what_a_lock_names_is_in_the_project(shell: Shell) -> None:
    project(shell)
    measure(shell)
    shell("lock", *AT)
    lock = shell.read("specs/demo.lock")
    elsewhere = shell.folder.parent / "catalog-elsewhere"
    (shell.folder / "offers.csv").rename(elsewhere)
    (shell.folder / "offers.csv").symlink_to(elsewhere)
    for verb in ("lock", "compile"):
        assert "link" in shell(verb, "demo", code=1).err
    (shell.folder / "offers.csv").unlink()
    shell.write("specs/demo.lock", lock.replace("origin: offers.csv", f"origin: ../{elsewhere.name}"))
    for verb in ("lock", "compile"):
        assert f"{elsewhere.name}, which is not in the project" in shell(verb, "demo", code=5).err
    assert "FAIL  demo" in shell("check", code=3).out


def test_a_machine_library_is_in_the_project(shell: Shell) -> None:
    project(shell)
    measure(shell)
    shell.write("specs/demo.yaml", spec(library="library.json.gz"))
    elsewhere = shell.folder.parent / "library-elsewhere.json.gz"
    shutil.copy(BUILT_IN, elsewhere)
    (shell.folder / "specs/library.json.gz").symlink_to(elsewhere)
    assert "link" in shell("compile", "demo", code=1).err
    (shell.folder / "specs/library.json.gz").unlink()
    assert "library.json.gz" in shell("compile", "demo", code=1).err
    shell.write("specs/demo.yaml", spec(library=f"../../{elsewhere.name}"))
    assert "which is not in the project" in shell("compile", "demo", code=5).err
    assert "FAIL  demo" in shell("check", code=3).out
    shutil.copy(BUILT_IN, shell.folder / "specs/library.json.gz")
    shell.write("specs/demo.yaml", spec(library="library.json.gz"))
    shell("compile", "demo")
    shell("check")


def test_machines_without_prices_cost_core_hours_beside_others_that_cost_dollars(shell: Shell) -> None:
    shell.write("lab.csv", "Cloud,InstanceType,vCPUs,MemoryGiB,Region\nslurm,s,2,4,lab\nslurm,m,8,32,lab\n")
    shell.write("offers.csv", CATALOG)
    own, rented = shell.neighbour("own", spec("own", infra="[slurm/lab]")), shell.neighbour("rented", spec("rented"))
    for path, name, catalog in ((own, "own", "lab.csv"), (rented, "rented", "offers.csv")):
        shell("compile", path, "--catalog", catalog)
        measure(shell, name=name)
    of_own, of_rented = shell("compile").out.split("\n\n")
    assert "8.00 core-h/h" in of_own
    assert "spent of a budget of 5.00 core-h" in of_own
    assert "$" not in of_own
    assert "$0.40/h" in of_rented
    assert "core-h" not in of_rented
    for verb in ("menu", "explain", "status"):
        said = shell(verb, "own").out
        assert "core-h" in said
        assert "$" not in said
    for path in ("menu.svg", "tasks/slurm-lab-m.sky.yaml", "deploy.sky.yaml"):
        text = shell.read(f"compiled/own/{path}")
        assert "8.00 core-h/h" in text
        assert not re.search(r"\$\d", text)
        assert "core-h" not in shell.read(f"compiled/rented/{path}".replace("slurm-lab-m", "aws-r1-a-large"))
    shell("report", "own")
    assert "core-h" in shell.read("compiled/own/report.html")
    assert "price: $8/h" in shell.read("compiled/own/menu.yaml"), "files keep quantities of the spec's grammar"
    (shell.folder / "lab.csv").unlink()
    assert "manifest verified; prices as of lab.csv" in shell("check", "own").out
