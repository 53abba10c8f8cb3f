"""Compile the recorded specs with the oldest and the newest libraries, Python and kernels: every file has the committed bytes.

`make bytes` runs it. Environments are made by uv in `build/bytes/`. A chart that differs is counted as a warning, for it is
no link of the chain. Exit code 1 if another file differs, or an interpreter is missing.
"""

import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "build" / "bytes"
# Core types that OpenBLAS has kernels for: of processors with and without AVX2 and fused multiplication.
CORES = {"x86_64": ("Haswell", "Prescott"), "aarch64": ("NEOVERSEN1", "ARMV8")}.get(platform.machine(), ("generic",))
OLD = CORES[-1]  # also without the instructions that NumPy itself finds at run time
NUMERICAL = ("numpy", "scipy")
RESOLUTIONS = {"oldest": "lowest-direct", "newest": "highest"}
KERNEL = """
import ctypes, pathlib, numpy
for path in (pathlib.Path(numpy.__file__).parents[1] / "numpy.libs").glob("*openblas*"):
    library = ctypes.CDLL(str(path))
    for name in ("scipy_openblas_get_corename64_", "openblas_get_corename64_", "openblas_get_corename"):
        if hasattr(library, name):
            ask = getattr(library, name)
            ask.restype = ctypes.c_char_p
            print(numpy.__version__, ask().decode())
            raise SystemExit
"""
FOUND = "import numpy; print(*numpy.show_config(mode='dicts')['SIMD Extensions'].get('found', ()))"


def settings(core: str, python: str = sys.executable) -> dict[str, str]:
    """Return the environment variables with which NumPy computes as on a processor of this core type."""
    found = {name: value for name, value in os.environ.items() if not name.startswith(("OPENBLAS_", "NPY_"))}
    found |= {"OPENBLAS_CORETYPE": core, "PYTHONPATH": str(ROOT)}
    if core == OLD:
        found["NPY_DISABLE_CPU_FEATURES"] = _output([python, "-c", FOUND], found)
    return found


def kernel_of(python: str, core: str) -> str:
    """Return NumPy's version and the kernel that its OpenBLAS chose; empty where it has another BLAS."""
    return _output([python, "-c", KERNEL], settings(core, python))


def _output(words: list[str], environment: dict[str, str] | None = None) -> str:
    return subprocess.run(words, env=environment, check=True, capture_output=True, text=True).stdout.strip()


def _interpreters() -> Iterator[tuple[str, str | None]]:
    """Yield the oldest supported Python and the newest that is here, each with its path; None if it is not here."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    low, high = map(int, re.findall(r"3\.(\d+)", project["requires-python"]))
    found = {f"3.{minor}": _interpreter(f"3.{minor}") for minor in range(low, high)}
    print("found:", ", ".join(f"Python {name}: {path}" for name, path in found.items() if path))
    oldest = f"3.{low}"
    yield oldest, found.pop(oldest)
    yield next(((name, path) for name, path in reversed(found.items()) if path), (f"3.{high - 1}", None))


def _interpreter(version: str) -> str | None:
    """Return the Python of this version on the PATH or among pyenv's, whose shims work for one version only."""
    root = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv"))
    for path in (shutil.which(f"python{version}"), *sorted(map(str, root.glob(f"versions/{version}.*/bin/python")))):
        words = [path or "false", "-c", "import platform; print(platform.python_version())"]
        ended = subprocess.run(words, capture_output=True, text=True)
        if ended.returncode == 0 and ended.stdout.startswith(f"{version}."):
            return path
    return None


def _environment(uv: str, interpreter: str, name: str, resolution: str) -> str:
    """Return the Python of an environment with the locked packages and these versions of the numerical ones."""
    folder = FOLDER / name
    python = str(folder / "bin" / "python")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    wanted = [one for one in project["dependencies"] if one.startswith(NUMERICAL)]
    install = [uv, "pip", "install", "--quiet", "--python", python]
    for words in (
        [uv, "venv", "--quiet", "--clear", "--python", interpreter, str(folder)],
        [*install, "--require-hashes", "-r", str(ROOT / "requirements" / "run.lock")],
        [*install, "--only-binary", ":all:", "--upgrade", "--resolution", resolution, *wanted],
    ):
        subprocess.run(words, check=True)
    return python


def _differing(python: str, core: str) -> list[str]:
    """Return the compiled files that differ from the committed ones when they are computed again."""
    with tempfile.TemporaryDirectory() as folder:
        for name in ("specs", "results", "compiled"):
            shutil.copytree(ROOT / name, Path(folder) / name, ignore=shutil.ignore_patterns("install", "build", "log"))
        specs = sorted(str(path.relative_to(folder)) for path in Path(folder).glob("specs/*-recorded.yaml"))
        before = _files(Path(folder))
        for inputs in ([*specs, "--catalog", "snapshot"], ["specs/cubicles-planner"]):
            words = [python, "-m", "fogspec", "--quiet", "compile", *inputs]
            subprocess.run(words, cwd=folder, env=settings(core, python), check=True, stdout=subprocess.DEVNULL)
        after = _files(Path(folder))
    return sorted(name for name in before.keys() | after.keys() if before.get(name) != after.get(name))


def _files(folder: Path) -> dict[str, bytes]:
    found = (path for path in folder.glob("compiled/**/*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in found}


def main() -> int:
    """Print a line for each environment and core type with what differs; return 1 if more than charts do."""
    uv, failed, kernels = str(Path(sys.executable).with_name("uv")), False, set[str]()
    for version, interpreter in _interpreters():
        if interpreter is None:
            print(f"Python {version} is not here: install it, or put it on the PATH", file=sys.stderr)
            failed = True
            continue
        print(f"Python {version}")
        for age, resolution in RESOLUTIONS.items():
            python = _environment(uv, interpreter, f"{version}-{age}", resolution)
            for core in CORES:
                kernel = kernel_of(python, core)
                kernels.add(kernel.partition(" ")[2])
                differing = _differing(python, core)
                charts = [name for name in differing if name.endswith(".svg")]
                others = [name for name in differing if name not in charts]
                failed |= bool(others)
                print(
                    f"  numpy {kernel:<18} {len(others)} files differ, {len(charts)} charts",
                    *others,
                    sep="\n    ",
                    flush=True,
                )
    if len(kernels) < len(CORES):
        print(f"the core types {', '.join(CORES)} gave the same kernel: {', '.join(kernels)}", file=sys.stderr)
        failed = True
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
