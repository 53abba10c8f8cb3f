"""Field types of the spec: floats in base units, read from and written as text with a unit."""

import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, get_args, get_origin

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    SerializerFunctionWrapHandler,
    ValidationInfo,
    WithJsonSchema,
    model_serializer,
)
from pydantic_core import to_jsonable_python

from fogspec.base import units
from fogspec.base.units import Range, UnitError


class Strict(BaseModel):
    """A mapping of the spec: unknown keys are errors, `x-` keys are accepted and dropped before."""

    model_config = ConfigDict(extra="forbid", frozen=True, validate_default=False, defer_build=True)

    if not TYPE_CHECKING:

        def __init__(self, **values: Any) -> None:
            """Take quantities as floats in base units, unlike documents, which write them as text."""
            self.__pydantic_validator__.validate_python(values, self_instance=self, context=BASE_UNITS)

        # Without this mark pydantic would read documents through __init__ too, and bare numbers would pass.
        __init__.__pydantic_base_init__ = True

    @property
    def is_default(self) -> bool:
        """Whether every field has its default: as a comparison with a new model, whose class need not be built for it."""
        fields = type(self).model_fields
        return all(value == fields[name].get_default(call_default_factory=True) for name, value in self)


class Lean(Strict):
    """A model that is written without the fields that have their default."""

    @property
    def unset(self) -> frozenset[str]:
        """The names of these fields."""
        fields = type(self).model_fields.items()
        return frozenset(
            name
            for name, one in fields
            if not one.is_required() and getattr(self, name) == one.get_default(call_default_factory=True)
        )

    @model_serializer(mode="wrap")
    def _without_unset(self, dump: SerializerFunctionWrapHandler) -> dict[str, Any]:
        found: dict[str, Any] = dump(self)
        unset = self.unset
        return {name: value for name, value in found.items() if name not in unset}


BASE_UNITS = {"base_units": True}


@dataclass(frozen=True, slots=True)
class Bounds:
    """A closed range of a figure in `unit`."""

    least: float
    most: float
    unit: str = ""

    def holds(self, value: float) -> bool:
        """Return whether the value is in the range; NaN is not."""
        return self.least <= value <= self.most

    def check(self, value: float) -> float:
        """Return the value; raise UnitError if it is out of range."""
        if not self.holds(value):
            # JSON's integers have no largest one, floats have.
            shown = f"{float(value):g}{self.unit}" if abs(value) <= sys.float_info.max else "no finite number"
            raise UnitError(f"is {shown}, and must be {self.text}", code="FS206")
        return value

    @property
    def text(self) -> str:
        """Return `between 0s and 1e+06s`."""
        return f"between {self.least:g}{self.unit} and {self.most:g}{self.unit}"


def _whole(value: float) -> int | float:
    return int(value) if value == int(value) else value


Parts = tuple[BeforeValidator, PlainSerializer, WithJsonSchema]


# Ids become names of files, so they are none that lead elsewhere.
Id = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")]


def _quantity(parse: Callable[[Any], float], fmt: Callable[[float], str], pattern: str, example: str) -> Parts:
    def read(value: Any, info: ValidationInfo) -> float:
        bare = info.context is not None and type(value) in (int, float) and info.context.get("base_units")
        return float(value) if bare else parse(value)

    return (
        BeforeValidator(read),
        PlainSerializer(fmt, return_type=str),
        WithJsonSchema({"type": "string", "pattern": rf"^\s*{pattern}\s*$", "examples": [example]}),
    )


def _range(
    parse: Callable[[Any], float], fmt: Callable[[float], str], end: str, example: str, number: bool = False
) -> Parts:
    schema: dict[str, Any] = {
        "type": "string",
        "pattern": rf"^\s*({end}|{end}\s*\.\.\s*({end})?|\.\.\s*{end})\s*$",
        "examples": [example],
    }
    if number:
        schema |= {"type": ["string", "number"], "minimum": 0}
    return (
        BeforeValidator(lambda value: value if isinstance(value, Range) else units.parse_range(value, parse)),
        PlainSerializer(lambda value: units.format_range(value, fmt), return_type=str),
        WithJsonSchema(schema),
    )


_N = r"(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?"
_D = rf"{_N}\s*(ns|us|ms|s|min|h|d)"
_DATE = r"\d{4}-\d{2}-\d{2}T\d{2}:\d{2}(:\d{2})?(Z|[+-]\d{2}:\d{2})"
_M = rf"{_N}\s*(MiB|GiB|TiB|MB|GB|TB)"
_USD = rf"(\$\s*{_N}|{_N}\s*(cents?|¢))"
_COST = rf"{_USD}\s*/\s*({_N})?\s*requests?"
_RATE = rf"{_N}\s*(Hz|(requests?)?\s*/\s*(s|min|h|day|week|month))"

Count = Annotated[float, Field(allow_inf_nan=False), PlainSerializer(_whole, return_type=int | float)]
Duration = Annotated[float, *_quantity(units.parse_duration_s, units.format_duration, _D, "1.5s")]
Until = Annotated[
    str,
    AfterValidator(units.check_until),
    WithJsonSchema({"type": "string", "pattern": rf"^\s*({_D}|{_DATE})\s*$", "examples": ["8h"]}),
]
Memory = Annotated[float, *_quantity(units.parse_memory_gib, units.format_memory, _M, "64GiB")]
Money = Annotated[float, *_quantity(units.parse_money_usd, units.format_money, _USD, "$2.50")]
Cost = Annotated[float, *_quantity(units.parse_cost_usd_per_request, units.format_cost, _COST, "$0.001/request")]
Price = Annotated[
    float, *_quantity(units.parse_price_usd_per_hour, units.format_price, rf"{_USD}\s*/\s*(h|hour)", "$0.526/h")
]
Rate = Annotated[float, *_quantity(units.parse_rate_per_s, units.format_rate, _RATE, "10/s")]


def _spot(value: Any, info: ValidationInfo) -> bool | float:
    known = isinstance(value, bool) or (isinstance(value, float) and info.context is not None)
    return value if known else units.parse_rate_per_s(value)


Spot = Annotated[
    bool | float,
    BeforeValidator(_spot),
    PlainSerializer(
        lambda value: value if isinstance(value, bool) else units.format_rate(value), return_type=bool | str
    ),
    WithJsonSchema({"type": ["boolean", "string"], "pattern": rf"^\s*{_RATE}\s*$", "examples": [True, "0.1/h"]}),
]


def _confidence(value: Any, info: ValidationInfo) -> float | None:
    if value == NO_CONFIDENCE or (value is None and info.context is not None and info.context.get("base_units")):
        return None
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise units.UnitError("must be a number, or none", code="FS303")
    if not 0 < value < 1:
        raise units.UnitError("must be more than 0 and less than 1, or none", code="FS206")
    return float(value)


NO_CONFIDENCE = "none"
Confidence = Annotated[
    float | None,
    BeforeValidator(_confidence),
    PlainSerializer(lambda value: NO_CONFIDENCE if value is None else value, return_type=float | str),
    WithJsonSchema(
        {
            "type": ["number", "string"],
            "exclusiveMinimum": 0,
            "exclusiveMaximum": 1,
            "pattern": "^none$",
            "examples": [0.95],
        }
    ),
]
Percent = Annotated[float, *_quantity(units.parse_percent, units.format_percent, rf"{_N}\s*%", "5%")]
CountRange = Annotated[Range, *_range(units.parse_count, units.format_number, _N, "2..64", number=True)]
MemoryRange = Annotated[Range, *_range(units.parse_memory_gib, units.format_memory, _M, "4GiB..512GiB")]

# The ends of keys whose values are numbers in base units, by what writes the quantity as text.
SUFFIXES: dict[Callable[..., str], str] = {
    units.format_duration: "_s",
    units.format_memory: "_gib",
    units.format_money: "_usd",
    units.format_cost: "_usd_per_request",
    units.format_price: "_usd_per_hour",
    units.format_rate: "_per_s",
    units.format_percent: "_fraction",
}


def as_numbers(value: Any) -> Any:
    """Return a value as programs read it in JSON: a quantity is a number in base units, whose key ends with the unit.

    A machine has `memory_gib` and `price_usd_per_hour`, where a file has `memory: 16GiB` and `price: $0.526/h`.
    """
    if isinstance(value, BaseModel):
        unset = value.unset if isinstance(value, Lean) else frozenset[str]()
        fields = {name: (field, getattr(value, name)) for name, field in type(value).model_fields.items()}
        return {
            f"{name}{_suffix(field.annotation, field.metadata)}": as_numbers(one)
            for name, (field, one) in fields.items()
            if name not in unset
        }
    if isinstance(value, Mapping):
        return {str(name): as_numbers(one) for name, one in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        return [as_numbers(one) for one in value]
    if isinstance(value, float):
        return _whole(value) if math.isfinite(value) else None
    return to_jsonable_python(value)


def _suffix(annotation: Any, metadata: Sequence[Any] = ()) -> str:
    """Return how the key of a field ends whose value, or each item of it, is a quantity of this type; empty for others."""
    if get_origin(annotation) is Annotated:
        annotation, *more = get_args(annotation)
        metadata = (*metadata, *more)
    for one in metadata:
        if isinstance(one, PlainSerializer) and (found := SUFFIXES.get(one.func)) is not None:
            return found
    return next(filter(None, (_suffix(one) for one in get_args(annotation) if one is not type(None))), "")
