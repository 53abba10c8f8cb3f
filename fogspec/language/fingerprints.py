"""What each stage reads of a spec, from what the spec's own fields declare (`fogspec.language.schema.affects`).

A change elsewhere leaves the stage's files fresh. Plan and results carry the record of what was measured, the models that of
what was fitted, the manifest that of what was chosen by.
"""

import json
import re
from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import Any

from pydantic.fields import FieldInfo

from fogspec.base.clouds import LOCAL
from fogspec.base.quantities import Strict
from fogspec.base.text import line
from fogspec.base.yaml.writer import flow
from fogspec.language.introspect import part
from fogspec.language.lockfile import Pins, image_named, is_pinned, pinned
from fogspec.language.named_files import measurement_sends_files
from fogspec.language.schema import Affects, Application, Stage, Waiver

NOTHING: frozenset[Stage] = frozenset()
# What is measured and a waiver may name; the other fields define the figures themselves.
WAIVABLE = ("spec.cloud", "spec.ros", "spec.benchmark.workload", "spec.secrets")
NO_FILES: Mapping[str, str] = MappingProxyType({})
IMAGE = "image"  # the name of the image's digest in a record
REMAPPINGS = re.compile(r"spec\.\w+\[\d+\](\.composable_node_descriptions\[\d+\])?\.remappings")
LONGEST = 60
TOOL = "fogspec"  # that of fogspec's version
RESULTS = "results"  # that of their digest
LIBRARY = "library"  # that of the machine library's digest
SURROGATE = "surrogate"  # that of the model's version
CATALOG = "catalog"  # those of the catalog's provenance begin with it


def stages_of_fields(
    model: type[Strict] = Application, inherited: frozenset[Stage] | None = None, path: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], frozenset[Stage]]]:
    """Yield the path of every leaf field, and the stages that read it; `*` stands for the items of a list or mapping.

    Raise TypeError for a field for which neither it nor one above it declares stages.
    """
    for name, field in model.model_fields.items():
        stages, here = _declared(field, inherited), (*path, name)
        kind, items = part(field.annotation)
        below = _model(kind) or _model(part(items)[0])
        if below is not None:
            yield from stages_of_fields(below, stages, (*here, "*") if items else here)
        elif stages is None:
            raise TypeError(f"{'.'.join(here)} does not declare which stages it affects")
        else:
            yield here, stages


def part_read_by(stage: Stage, model: Strict) -> dict[str, Any]:
    """Return the values of a document that a stage reads, as JSON has them."""
    return _read(stage, type(model), model.model_dump(mode="json"), None)


def chosen_record(application: Application, others: Mapping[str, Any]) -> dict[str, Any]:
    """Return what choice and deployment depend on, by name: limits, objective, admissible machines, as they are written, and
    the `others` that are not None, such as results, catalog and the version of fogspec.
    """
    return _set({**dict(_rows(part_read_by("choice", application)["spec"], "spec")), **others})


def fitted_record(application: Application, others: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the models depend on, by name: the statistic, the metrics, the rate, whether they are of this host, and the
    `others` that are not None: results, machine library and the version of the model.
    """
    spec = application.spec
    metrics = sorted({*spec.constraints.metrics, *([spec.objective.metric] if spec.objective.metric else [])})
    local = spec.infra == [LOCAL] or None
    fields = {
        "spec.constraints.statistic": spec.constraints.statistic,
        "spec.objective.load.rate": spec.objective.load.rate if spec.objective.load else None,
    }
    return _set({**fields, "metrics": metrics or None, LOCAL: local, **others})


def _set(record: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in record.items() if value is not None}


def measured_record(
    application: Application, pins: Pins | None = None, sent: Mapping[str, str] = NO_FILES
) -> dict[str, Any]:
    """Return what a measurement depends on, by name: the spec's fields that it reads, as they are written, without those
    that are not set; the digest of the image if it is known, and that of each file that is `sent`.

    Two names are the same in two records if they are the same input. No two inputs have one name.
    """
    image = image_named(pinned(application, pins))
    exact = {IMAGE: image.partition("@")[2]} if image is not None and is_pinned(image) else {}
    files = sent if measurement_sends_files(application.spec) else {}
    fields = _rows(part_read_by("results", application)["spec"], "spec")
    return {**dict(fields), **exact, **{_file_row(name): files[name] for name in sorted(files)}}


def files_of_record(record: Mapping[str, Any]) -> dict[str, str]:
    """Return the digests of the files in a `measured_record`, by path."""
    return {name.removeprefix("./"): one for name, one in record.items() if name != IMAGE and not _is_field(name)}


def differing_rows(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Return the names of the inputs that differ, or that only one of two records has: fields first, in their order."""
    names = {**before, **now}
    found = [name for name in names if not same_value(before.get(name), now.get(name))]
    return [*filter(_is_field, found), *sorted(name for name in found if not _is_field(name))]


def same_value(one: Any, other: Any) -> bool:
    """Return whether two values of an input are the same; 1, 1.0 and true are three."""
    return json.dumps(one, sort_keys=True) == json.dumps(other, sort_keys=True)


def waivable(row: str) -> bool:
    """Return whether a waiver may name this input: no field of the spec that defines the figures."""
    return not _is_field(row) or any(row == field or row.startswith((f"{field}.", f"{field}[")) for field in WAIVABLE)


def _is_field(row: str) -> bool:
    return row.startswith("spec.")


def _file_row(path: str) -> str:
    return f"./{path}" if path == IMAGE or _is_field(path) else path


def _rows(value: Any, at: str) -> Iterator[tuple[str, Any]]:
    """Yield each value below a field by its path: of mappings their keys, of lists of mappings their items.

    Of remappings the order counts as well, since the first that matches a name is the one that ROS 2 applies.
    """
    if isinstance(value, Mapping) and value and REMAPPINGS.fullmatch(at):
        yield at, [f"{old}:={new}" for old, new in value.items()]
    elif isinstance(value, Mapping):
        for key, inner in value.items():
            plain = isinstance(key, str) and re.fullmatch(r"[^\W\d][\w/-]*", key)
            yield from _rows(inner, f"{at}.{key}" if plain else f"{at}[{json.dumps(key)}]")
    elif isinstance(value, list) and any(isinstance(one, Mapping) for one in value):
        for number, inner in enumerate(value):
            yield from _rows(inner, f"{at}[{number}]")
    elif value is not None and value != []:
        yield at, value


def _read(
    stage: Stage, model: type[Strict], values: Mapping[str, Any], inherited: frozenset[Stage] | None
) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, field in model.model_fields.items():
        if name not in values:  # what a later version added, and is not set
            continue
        stages, value = _declared(field, inherited), values[name]
        below = _model(part(field.annotation)[0])
        if below is not None and value is not None:
            value = _read(stage, below, value, stages)
            if value or stage in (stages or NOTHING):
                found[name] = value
        elif stage in (stages or NOTHING):
            found[name] = value
    return found


def _declared(field: FieldInfo, inherited: frozenset[Stage] | None) -> frozenset[Stage] | None:
    return next((one.stages for one in field.metadata if isinstance(one, Affects)), inherited)


def _model(kind: Any) -> type[Strict] | None:
    return kind if isinstance(kind, type) and issubclass(kind, Strict) else None


def change_text(one: Waiver) -> str:
    """Return a change for people: `spec.cloud[0].env.LOG: info -> debug`; of what has a digest that it changed."""
    if one.change == TOOL:
        return line(f"made by fogspec {one.old}, this is {one.new}")
    if any(str(value).startswith("sha256:") for value in (one.old, one.new)):
        how = "is new" if one.old is None else "is no longer there" if one.new is None else "changed"
        return line(f"{one.change} {how}")
    return line(f"{one.change}: {_short(one.old)} -> {_short(one.new)}")


def _short(value: Any) -> str:
    text = "none" if value is None else flow(value)
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 3]}..."
