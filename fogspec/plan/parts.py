"""The parts of a machine that stand for smaller machines: its half, quarter and eighth (`fogspec.numerics.nested`)."""

import math
from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from fogspec.base.clouds import LOCAL
from fogspec.base.units import dollars, format_number, shown_duration
from fogspec.catalog.filters import matches_infra
from fogspec.catalog.machine import Machine
from fogspec.catalog.table import Catalog
from fogspec.numerics.nested import PARTS, SAME_MEMORY
from fogspec.plan.commitment import PART_S, Commitment
from fogspec.plan.schema import Part, PartName, Sample, article

NAMES: dict[int, PartName] = {2: "half", 4: "quarter", 8: "eighth"}


def with_parts(sample: Sample, offers: Catalog, only: Collection[str] | None = None) -> Sample:
    """Return the sample with the parts of its machine that stand for an offer; with `only`, for one of these instance types."""
    found = local_parts(sample.machine) if sample.machine.is_local else _offered(sample.machine, offers)
    parts = [one for one in found if only is None or one.machine.instance in only]
    return sample.model_copy(update={"parts": parts})


def nested_notes(samples: Sequence[Sample], each: Commitment) -> list[str]:
    """Return which shapes a plan expects from which machine, what they add to its price, and what they would cost alone."""
    notes, hourly = [], 0.0
    for one in samples:
        if one.parts:
            shapes = ", ".join(f"{part.machine.instance} ({article(part.part)})" for part in one.parts)
            notes.append(f"nested in {one.machine.instance}: {shapes}; each {shown_duration(PART_S)} at most")
            hourly += sum(part.machine.price for part in one.parts)
    if not notes:
        return ["nested shapes: none, for no part of these machines is worth measuring"]
    added = math.fsum(one.machine.price for one in samples) * each.parts_s / 3600
    alone = replace(each, nested=False).usd(hourly)
    price = (
        f": at most {dollars(added)} more, where samples of their own cost at most {dollars(alone)}" if hourly else ""
    )
    spared = sum(len(one.parts) for one in samples)
    return [*notes, f"nested shapes spare {spared} start{'s' if spared > 1 else ''} of a machine{price}"]


def local_parts(machine: Machine) -> list[Part]:
    """Return the parts of a shape of this host: whole CPUs, and that share of its memory."""
    found = []
    for part in PARTS:
        cpus, memory = machine.cpus / part, machine.memory / part
        if cpus == int(cpus):
            instance = f"{int(cpus)}cpu-{format_number(memory)}gib"
            found.append(
                Part(
                    part=NAMES[part],
                    machine=Machine(infra=LOCAL, instance=instance, cpus=cpus, memory=memory, price=0.0),
                )
            )
    return found


def _offered(machine: Machine, offers: Catalog) -> list[Part]:
    """Return the parts for which there is an offer in the same place, of the same family and CPU."""
    own = np.flatnonzero((offers.instance == machine.instance) & (offers.cloud == machine.cloud_name))
    if machine.gpu is not None or not len(own) or offers.burstable[own[0]] or not offers.family[own[0]]:
        return []
    like = own[0]
    same = (offers.cloud == offers.cloud[like]) & (offers.family == offers.family[like]) & (offers.gpu == "")
    same &= (offers.arch == offers.arch[like]) & (offers.spot == machine.spot) & _equal(offers.clock_ghz, like)
    same &= _equal(offers.vcpus / offers.physical_cores, like) & matches_infra(offers, machine.infra)
    ratio = offers.memory_gib / offers.vcpus / (machine.memory / machine.cpus)
    same &= np.abs(ratio - 1) <= SAME_MEMORY
    found = []
    for part in PARTS:
        rows: Sequence[int] = np.flatnonzero(same & (offers.vcpus == machine.cpus / part)).tolist()
        found += [Part(part=NAMES[part], machine=_here(offers.machine(row), machine)) for row in rows[:1]]
    return found


def _here(part: Machine, machine: Machine) -> Machine:
    """Return the machine of a part as one in the place of its machine."""
    return part.model_copy(update={"infra": machine.infra})


def _equal(column: "np.ndarray", row: int) -> "np.ndarray":
    """Return where a column has the value of a row; an unknown value is like another unknown one."""
    return np.asarray(np.nan_to_num(column, nan=-1.0) == np.nan_to_num(column[row], nan=-1.0))
