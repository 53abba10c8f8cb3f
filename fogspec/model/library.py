"""Machine libraries: how fast other programs are on many machines, so that fewer samples suffice.

A library is JSON, plain or gzipped, as `fogspec-lab library` writes it: columns of machines, and a profile of each program over
them.
The one in this package is derived from Spare Cores' public benchmarks (CC BY-SA 4.0, `library.md` beside it).
"""

import json
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from fogspec.base import digest
from fogspec.base.errors import InvalidInput
from fogspec.base.files import decompress, read_bounded
from fogspec.numerics.kernels import Floats, Machines, codes
from fogspec.numerics.priors import PriorData

BUILT_IN = Path(__file__).with_name("library.json.gz")
MOST_BYTES = 16 << 20
MOST_PROGRAMS = 500  # a matrix of programs by programs is decomposed
TEXTS = ("cloud", "family", "arch", "cpu_model", "gpu")
NUMBERS = ("vcpus", "memory_gib", "gpu_count", "gpu_memory_gib", "physical_cores", "clock_ghz", "burstable")
Name = Annotated[str, Field(max_length=100)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class _Program(_Strict):
    """A program, the suite that it is of, and its log-latency on each machine over its mean; None: not measured."""

    name: Name
    suite: Name
    log_latency: list[Annotated[float, Field(ge=-20, le=20)] | None]


class _Library(_Strict):
    instance: list[Name] = Field(min_length=1)
    texts: dict[str, list[Name]]
    numbers: dict[str, list[Annotated[float, Field(ge=0)] | None]]
    programs: list[_Program] = Field(min_length=1, max_length=MOST_PROGRAMS)


def read_library(path: Path) -> PriorData:
    """Return a library; its digest is of what it says. Raise InvalidInput for a file that is not one."""
    try:
        return library_of(decompress(read_bounded(path, MOST_BYTES), path, MOST_BYTES))
    except (OSError, ValueError) as wrong:
        said = getattr(wrong, "strerror", None) or (_first(wrong) if isinstance(wrong, ValidationError) else wrong)
        raise InvalidInput(f"{path}: not a machine library: {said}", "fogspec-lab library --out FILE") from None


@cache
def built_in() -> PriorData:
    """Return the library of this package."""
    return read_library(BUILT_IN)


def library_of(content: bytes) -> PriorData:
    """Return the library in JSON. Raise ValueError (pydantic's, too) for any other text."""
    known = _Library.model_validate_json(content)
    count = len(known.instance)
    lengths = {name: len(column) for name, column in known.texts.items()}
    lengths |= {name: len(column) for name, column in known.numbers.items()}
    lengths |= {one.name: len(one.log_latency) for one in known.programs}
    if set(known.texts) != set(TEXTS) or set(known.numbers) != set(NUMBERS):
        raise ValueError(f"machines have the columns {', '.join((*TEXTS, *NUMBERS))}")
    if wrong := [name for name, length in lengths.items() if length != count]:
        raise ValueError(f"{wrong[0]} has {lengths[wrong[0]]} values for {count} machines")
    numbers = {name: np.array(known.numbers[name], dtype=np.float64) for name in NUMBERS}
    names = tuple(f"{cloud}/{kind}" for cloud, kind in zip(known.texts["cloud"], known.instance, strict=True))
    if len(set(names)) != count:
        raise ValueError("a machine is there twice")
    return PriorData(
        names=names,
        machines=machines_of(known.texts, numbers),
        workloads=tuple(one.name for one in known.programs),
        suites=tuple(one.suite for one in known.programs),
        log_latency=np.array([one.log_latency for one in known.programs], dtype=np.float64),
        digest=digest.of_bytes(content),
    )


def machines_of(texts: Mapping[str, list[str]], numbers: Mapping[str, Floats]) -> Machines:
    """Return machines by their columns `TEXTS` and `NUMBERS`; without prices, they are 1, and no profile depends on them."""
    prices = {"price_usd_per_hour": np.ones(len(numbers["vcpus"])), **numbers}
    columns: dict[str, Any] = {**prices, **{name: codes(column) for name, column in texts.items()}}
    known = {"gpu_count": np.nan_to_num(numbers["gpu_count"]), "burstable": numbers["burstable"] > 0}
    return Machines(**columns | known)


def library_bytes(instance: list[str], texts: dict[str, Any], numbers: dict[str, Any], programs: list[Any]) -> bytes:
    """Return the JSON of a library: the same bytes for the same values. `programs` are (name, suite, log-latencies)."""
    said = {
        "instance": instance,
        "texts": texts,
        "numbers": numbers,
        "programs": [{"name": name, "suite": suite, "log_latency": column} for name, suite, column in programs],
    }
    content = json.dumps(said, separators=(",", ":"), allow_nan=False).encode()
    library_of(content)
    return content


def _first(wrong: ValidationError) -> str:
    one = wrong.errors(include_url=False, include_input=False)[0]
    return f"{'.'.join(map(str, one['loc']))}: {one['msg']}"
