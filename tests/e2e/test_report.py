"""`fogspec report` and `fogspec menu`'s picture, through the command line on files."""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from tests.conftest import ROOT
from tests.support.forking import Ended, forked


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """The SLAM spec and its measurements in an empty folder."""
    (tmp_path / "specs").mkdir()
    shutil.copy(ROOT / "specs" / "vslam-recorded.yaml", tmp_path / "specs" / "vslam-recorded.yaml")
    shutil.copytree(ROOT / "results" / "vslam-recorded", tmp_path / "results" / "vslam-recorded")
    return tmp_path


def fogspec(cwd: Path, *words: str, code: int = 0, **env: str) -> Ended:
    ended = forked(cwd, words, {"COLUMNS": "80", **env})
    assert ended.returncode == code, ended.stderr + ended.stdout
    return ended


def test_the_page_is_whole_by_itself_and_the_same_each_time(checkout):
    fogspec(checkout, "report", "vslam-recorded")
    page = checkout / "compiled" / "vslam-recorded" / "report.html"
    first = page.read_bytes()
    # In a process of its own, with another order of sets.
    words = ["report", "specs/vslam-recorded.yaml", "--name", "vslam-recorded"]
    seed = "2" if os.environ.get("PYTHONHASHSEED") == "1" else "1"
    environment = {**os.environ, "COLUMNS": "80", "PYTHONHASHSEED": seed}
    subprocess.run(
        [sys.executable, "-m", "fogspec", *words], cwd=checkout, check=True, capture_output=True, env=environment
    )
    assert page.read_bytes() == first
    text = first.decode()
    assert str(checkout) not in text
    assert len(first) < 300_000
    assert not re.findall(r"""(?:src|href)=["'](?!#|data:)[^"']*""", text), "nothing is loaded from elsewhere"
    assert "default-src 'none'" in text
    for words in ("Machines", "Why this machine", "Evidence"):
        assert f">{words}</h2>" in text
    assert "c6i.4xlarge is the best machine that meets both limits" in text


def test_the_numbers_in_the_page_are_data(checkout):
    text = fogspec(checkout, "report", "vslam-recorded", "--out", "-").stdout
    data = json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.S)[1])
    program, *words = shlex.split(data["command"])
    assert program == "fogspec"
    assert "c6i.4xlarge" in fogspec(checkout, *words, "--alpha", "0.5").stdout
    assert len(data["machines"]) == 21
    assert {len(one) for one in data["machines"]} == {len(data["columns"]) + len(data["fixed"])}
    places = sorted(one[data["columns"].index("order")] for one in data["machines"])
    assert places == list(range(21))


def test_what_was_not_measured_has_a_page_without_a_menu(checkout):
    shutil.rmtree(checkout / "results" / "vslam-recorded")
    text = fogspec(checkout, "report", "vslam-recorded", "--out", "-").stdout
    assert "not measured yet" in text
    assert "samples to be measured" in text
    assert 'id="data"' not in text
    assert "<svg" not in text


@pytest.mark.parametrize(
    "name", ["grasp-planning-recorded", "motion-planning-apartment-recorded", "motion-planning-cubicles-recorded"]
)
def test_page_and_terminal_have_the_same_figures(tmp_path, name):
    for folder in ("specs", "results"):
        shutil.copytree(ROOT / folder, tmp_path / folder)
    page = fogspec(tmp_path, "report", name, "--out", "-").stdout
    explained = fogspec(tmp_path, "explain", name, "-v").stdout
    spec = next(path for path in (tmp_path / "specs").glob("*-recorded.yaml") if name in path.read_text())
    compiled = fogspec(tmp_path, "compile", str(spec)).stdout.partition(f"{name}\n")[2]
    spent = re.search(r"samples count; (\S+) spent", compiled)[1]
    assert f"{spent} spent of a budget of " in page
    median, most = re.search(r"median (\S+), max (\S+); \d+ of \d+ are within", " ".join(explained.split())).groups()
    rows = re.findall(r'data-head="error">([^<]+)%<', page)
    errors = sorted(abs(float(one)) for one in rows)
    assert errors[-1] == pytest.approx(float(most.rstrip("%")), abs=0.1)
    assert errors[len(errors) // 2] == pytest.approx(float(median.rstrip("%")), abs=0.1)


def test_one_machine_is_one_everywhere(tmp_path):
    for folder in ("specs", "results"):
        shutil.copytree(ROOT / folder, tmp_path / folder)
    page = fogspec(tmp_path, "report", "motion-planning-apartment-recorded", "--out", "-").stdout
    assert "c6i.4xlarge is the only machine that meets both limits" in page
    assert re.search(r"9,264 offers -&gt; .* -&gt; 1 meets all limits", page)
    assert "no other machine meets all limits" in page
    assert re.search(r"\[[\d., ]+\]</td><td>limit 10 s</td><td>15% headroom", page)
    explained = fogspec(tmp_path, "explain", "motion-planning-apartment-recorded", "-v").stdout
    said = " ".join(explained.split())
    assert "21 predicted -> 1 meets all limits" in said
    words = re.search(r"scales like, by weight of the library's programs: ((?:, |\w+ -?\d\.\d\d)+)", said)[1]
    manifest = YAML(typ="safe").load(
        (ROOT / "compiled" / "motion-planning-apartment-recorded" / "manifest.yaml").read_text()
    )
    assert words == ", ".join(f"{name} {weight:.2f}" for name, weight in manifest["evidence"]["scales_like"].items())


def test_an_answer_of_none_has_a_page(checkout):
    spec = checkout / "specs" / "vslam-recorded.yaml"
    spec.write_text(re.sub(r"latency: .*", "latency: 1ms", spec.read_text(), count=1))
    text = fogspec(checkout, "report", "vslam-recorded", "--out", "-").stdout
    assert "No machine meets the latency limit of 1 ms" in text


@pytest.mark.parametrize(
    ("words", "said"),
    [(("nothing-of-this-name",), "no application named"), (("specs/missing.yaml",), "missing.yaml"),
     (("specs/vslam-recorded.yaml", "--name", "other"), "no application named other")],
)  # fmt: skip
def test_what_is_not_there_is_said(checkout, words, said):
    ended = forked(checkout, ["report", *words])
    assert ended.returncode in (1, 2)
    assert said in ended.stderr
    assert "Traceback" not in ended.stderr


def test_the_report_stays_when_compile_tidies_up(checkout):
    fogspec(checkout, "report", "vslam-recorded")
    fogspec(checkout, "compile", "specs/vslam-recorded.yaml")
    assert (checkout / "compiled" / "vslam-recorded" / "report.html").is_file()
    assert (checkout / "compiled" / "vslam-recorded" / "latency.svg").is_file()
    fogspec(checkout, "check", "--resolve-image", "specs/vslam-recorded.yaml")


def test_menu_takes_limits_away(checkout):
    assert "limits: cost at most" in fogspec(checkout, "menu", "specs/vslam-recorded.yaml", "--latency", "none").stdout


def test_verbs_take_the_name_of_an_application_as_well_as_its_spec(checkout):
    for verb in ("compile", "explain", "menu", "validate", "status"):
        by_name = fogspec(checkout, verb, "vslam-recorded").stdout
        by_path = fogspec(checkout, verb, "specs/vslam-recorded.yaml").stdout
        # The next command is given the argument of this one.
        assert by_name.replace("vslam-recorded\n", "specs/vslam-recorded.yaml\n") == by_path.replace(
            "vslam-recorded\n", "specs/vslam-recorded.yaml\n"
        )
    (checkout / "compiled" / "vslam-recorded" / "manifest.yaml").unlink()
    assert "compiled/vslam-recorded/manifest.yaml" in fogspec(checkout, "apply", "vslam-recorded", code=1).stderr
    assert "no application named slam" in fogspec(checkout, "menu", "slam", code=2).stderr
    spec = checkout / "specs" / "vslam-recorded.yaml"
    spec.write_text(spec.read_text("utf-8").replace("name: vslam", "nmae: vslam"), "utf-8")
    assert "write 'name'" in fogspec(checkout, "menu", "vslam-recorded", code=1).stderr, (
        "its mistakes, not that it is missing"
    )


def test_a_weight_that_is_no_number_is_wrong_usage(checkout):
    for alpha in ("nan", "inf", "2", "x"):
        said = fogspec(checkout, "menu", "vslam-recorded", "--alpha", alpha, code=2).stderr
        assert said.startswith("error: Invalid value for '--alpha'"), alpha


def test_a_month_is_the_paid_hours_of_a_month_everywhere(checkout):
    """With sessions of 20 min a week and 5 min of start-up, and not 730 hours."""
    spec = checkout / "specs" / "vslam-recorded.yaml"
    usage = "{load: {rate: 20/s, session: 20min, sessions: 1/week}}"
    text = re.sub(r"\n  objective:.*?(?=\n  [a-z])", "", spec.read_text(), flags=re.S)
    text = text.replace("$0.01/1000 requests", "$1/request")
    spec.write_text(text.replace("\nspec:\n", f"\nspec:\n  objective: {usage}\n  deployment: {{until: 20min}}\n"))
    usd = json.loads(fogspec(checkout, "menu", "vslam-recorded", "-o", "json").stdout)[0]["balanced"]["usd_per_month"]
    assert usd < 10
    month = f"${usd:.2f}"
    assert f", {month}/month" in fogspec(checkout, "menu", "vslam-recorded").stdout
    assert f"/h, {month}/month" in fogspec(checkout, "compile", "vslam-recorded").stdout
    assert f", {month}/month" in fogspec(checkout, "report", "vslam-recorded", "--out", "-").stdout
