"""Wheel and sdist are whole: in an empty environment, from an empty folder, the first commands of a user work."""

import os
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

from fogspec import __version__
from tests.support.interpreters import python
from tests.support.once import once

ROOT = Path(__file__).resolve().parents[2]
UV = [sys.executable, "-m", "uv", "--quiet"]
# Also what is not shipped: the sdist's own tests run on it.
SDIST = {"CITATION.cff", "LICENSE", "Makefile", "PKG-INFO", "compiled", "docs", "fogspec", "lab", "mkdocs.yml", "probe",
         "pyproject.toml", "requirements", "results", "schemas", "specs", "templates", "tests", ".gitignore"}  # fmt: skip
PAGES = ("CHANGELOG", "CODE_OF_CONDUCT", "CONTRIBUTING", "README", "SECURITY")
# Every Python that is here, for `make dist`; the release workflow has all that pyproject.toml admits.
OWN = f"3.{sys.version_info.minor}"
INTERPRETERS = [
    pytest.param(path, id=one, marks=[] if one == OWN else [pytest.mark.rare])
    for one in ("3.11", "3.12", "3.13", "3.14")
    if (path := sys.executable if one == OWN else python(one))
]


def build(source: Path, folder: Path) -> dict[str, Path]:
    """Make sdist and wheel of a project, and the wheel that its sdist makes; return them."""
    for kind in ("--sdist", "--wheel"):
        subprocess.run([*UV, "build", kind, "--out-dir", folder, source], check=True, timeout=1200)
    sdist = next(folder.glob("*.tar.gz"))
    subprocess.run([*UV, "build", "--wheel", "--out-dir", folder / "again", sdist], check=True, timeout=1200)
    return packages(folder)


def packages(folder: Path) -> dict[str, Path]:
    """Return what `build` made in a folder."""
    sdist = next(folder.glob("*.tar.gz"))
    return {"wheel": next(folder.glob("*.whl")), "sdist": sdist, "wheel of sdist": next(folder.glob("again/*.whl"))}


@pytest.fixture(scope="module")
def built() -> dict[str, Path]:
    return packages(once("packages of the product", lambda folder: build(ROOT, folder)))


def contents(wheel: Path) -> dict[str, tuple[bytes, int]]:
    with zipfile.ZipFile(wheel) as archive:
        return {one.filename: (archive.read(one), one.external_attr) for one in archive.infolist()}


def environment_with(folder: Path, interpreter: str, *packages: Path, offline: bool = False) -> Path:
    """Return an environment of this interpreter with these packages and what they need."""
    subprocess.run([*UV, "venv", "--python", interpreter, folder], check=True, timeout=600)
    install = [*UV, "pip", "install", *(["--offline"] if offline else []), "--python", folder / "bin/python", *packages]
    subprocess.run(install, check=True, timeout=1200, cwd=folder.parent)
    return folder


def test_the_wheel_holds_what_runs_and_no_more(built: dict[str, Path]) -> None:
    with zipfile.ZipFile(built["wheel"]) as archive:
        names = set(archive.namelist())
    for folder in ("templates", "schemas", "specs"):
        shipped = {name.rpartition("/")[2] for name in names if name.startswith(f"fogspec/_shipped/{folder}/")}
        assert shipped >= {path.name for path in (ROOT / folder).glob("*.*")}
    modules = {path.relative_to(ROOT).as_posix() for path in (ROOT / "fogspec").rglob("*") if path.is_file()}
    assert names >= {name for name in modules if "__pycache__" not in name}
    assert {name.partition("/")[0] for name in names} == {"fogspec", f"fogspec-{__version__}.dist-info"}
    # Neither at another place than the top: what checks the product or makes its numbers is not it.
    assert not [name for name in names if {"fogspec_lab", "tests", "tools"} & set(name.split("/"))]


def test_the_sdist_holds_what_builds_and_tests_it(built: dict[str, Path]) -> None:
    with tarfile.open(built["sdist"]) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert names >= {"README.md", "LICENSE", "CHANGELOG.md", "CITATION.cff", "Makefile", "mkdocs.yml", "pyproject.toml"}
    assert names >= {
        "tests/corners/test_wheel.py",
        "docs/tutorial.md",
        "results/vslam-recorded/aws-us-east-1-c6i-large.yaml",
        "requirements/run.lock",
    }
    assert {name.partition("/")[0] for name in names if name} == {*SDIST, *(f"{name}.md" for name in PAGES)}


def test_the_sdist_makes_the_same_wheel(built: dict[str, Path]) -> None:
    """So that what works after the installation of one works after that of the other."""
    assert contents(built["wheel"]) == contents(built["wheel of sdist"])


@pytest.mark.parametrize("interpreter", INTERPRETERS)
def test_the_first_commands_work_in_an_empty_environment(
    built: dict[str, Path], tmp_path: Path, interpreter: str
) -> None:
    environment, here = (
        environment_with(tmp_path / "environment", interpreter, built["wheel of sdist"]),
        tmp_path / "empty",
    )
    here.mkdir()

    def fogspec(*words: str) -> str:
        ended = subprocess.run(
            [environment / "bin/fogspec", *words], cwd=here, capture_output=True, text=True, timeout=600, check=False,
            env={"PATH": "/usr/bin:/bin", "HOME": str(tmp_path), "LANG": "C.UTF-8"},
        )  # fmt: skip
        assert ended.returncode == 0, f"{words}: {ended.stderr}"
        return ended.stdout

    assert fogspec("--version") == f"fogspec, version {__version__}\n"
    assert "Plan and measure" in fogspec("--help")
    fogspec("init", "--name", "my-robot")
    written = {str(path.relative_to(here)) for path in here.rglob("*.*")}
    assert written == {"specs/my-robot/my-robot.yaml", "schemas/Application.json"}
    fogspec("validate")
    own = (here / "specs/my-robot/my-robot.yaml").read_text().replace("my_package", "planning")
    own = own.replace(": /request ", ": /scene ").replace(": /response ", ": /plan ")
    (here / "specs/my-robot/my-robot.yaml").write_text(own)
    package = here / "specs/my-robot/ros2_ws/src/planning/package.xml"
    package.parent.mkdir(parents=True)
    package.write_text("<package><name>planning</name></package>")
    fogspec("compile", "specs/my-robot/my-robot.yaml")
    assert (here / "compiled/my-robot/plan.yaml").read_bytes().startswith(b"# Generated by fogspec")
    assert "FS201" in fogspec("explain", "FS201")
    assert "fogspec menu grasp-planning" in fogspec("init", "--example", "grasp-planning")
    fogspec("compile", "grasp-planning")
    assert f'fogspec: "{__version__}"\n' in (here / "compiled/grasp-planning/manifest.yaml").read_text()
    assert (here / "compiled/grasp-planning/menu.svg").stat().st_size > 1000
    for verb in ("menu", "explain"):
        assert "g4dn.xlarge" in fogspec(verb, "grasp-planning")
    fogspec("report", "grasp-planning")
    assert (here / "compiled/grasp-planning/report.html").is_file()
    assert os.access(environment / "bin/fogspec", os.X_OK)


def test_the_lab_works_beside_the_product_from_its_sdist(built: dict[str, Path], tmp_path: Path) -> None:
    mine, here = build(ROOT / "lab", tmp_path / "dist"), tmp_path / "empty"
    assert contents(mine["wheel"]) == contents(mine["wheel of sdist"])
    environment = environment_with(tmp_path / "environment", sys.executable, built["wheel"], mine["wheel of sdist"])
    here.mkdir()

    def lab(*words: str, code: int = 0) -> str:
        ended = subprocess.run(
            [environment / "bin/fogspec-lab", *words], cwd=here, capture_output=True, text=True, timeout=600, check=False,
            env={"PATH": "/usr/bin:/bin", "HOME": str(tmp_path), "LANG": "C.UTF-8"},
        )  # fmt: skip
        assert ended.returncode == code, f"{words}: {ended.stderr}"
        return ended.stdout + ended.stderr

    assert lab("--version") == f"fogspec-lab, version {__version__}\n"
    assert "costs nothing" in lab("conformance", "--dry-run")
    assert "next: write library: library.json.gz in a spec" in lab("library", "--from", str(ROOT / "tests/data/suite"))
    for verb in ("paper", "snapshot"):  # of files that are not there
        assert "pip install --editable ./lab" in lab(verb, code=5)
    assert (environment / "bin/fogspec").is_file()


@pytest.mark.parametrize("interpreter", INTERPRETERS)
def test_the_probe_s_own_wheel_is_one_module(tmp_path: Path, interpreter: str) -> None:
    mine, here = build(ROOT / "probe", tmp_path / "dist"), tmp_path / "empty"
    found = contents(mine["wheel"])
    assert found == contents(mine["wheel of sdist"])
    assert found["fogspec_probe.py"][0] == (ROOT / "fogspec/agent/fogspec_probe.py").read_bytes()
    assert not [name for name in found if name != "fogspec_probe.py" and ".dist-info/" not in name]
    environment = environment_with(tmp_path / "environment", interpreter, mine["wheel of sdist"], offline=True)
    here.mkdir()
    assert probe_does_nothing(environment, here)


def probe_does_nothing(environment: Path, here: Path) -> bool:
    """Whether a program that times a request runs there, prints nothing and writes nothing."""
    before = sorted(here.rglob("*"))
    program = "import fogspec_probe as probe; probe.start('plan'); probe.stop('plan', length_m=1)"
    words = [environment / "bin/python", "-I", "-c", program]
    ended = subprocess.run(words, cwd=here, capture_output=True, timeout=600, check=True, env={"PATH": "/usr/bin:/bin"})
    return ended.stdout + ended.stderr == b"" and sorted(here.rglob("*")) == before
