"""Render a typed document in full: quantities with units or as numbers, defaults filled in, unset fields left out."""

from typing import Any

from pydantic import BaseModel

from fogspec.base.units import Range


def render_document(document: BaseModel) -> dict[str, Any]:
    """Return the document's values; reading them gives the same document."""
    data: dict[str, Any] = document.model_dump(mode="json", by_alias=True)
    return _rendered(document, data)


def numeric_document(document: BaseModel) -> dict[str, Any]:
    """Return what `render_document` returns, with each quantity as a number in its base unit instead of a text.

    A range is an object with `min` and `max`; an open end is left out.
    """
    return {key: _numeric(inner) for key, inner in _set_fields(document)}


def _set_fields(document: BaseModel) -> list[tuple[str, Any]]:
    """Return key and value of the fields, without those that are None and would be None anyway."""
    fields = [
        (field.alias or name, getattr(document, name), field) for name, field in type(document).model_fields.items()
    ]
    return [
        (key, inner)
        for key, inner, field in fields
        if inner is not None or field.is_required() or field.default is not None
    ]


def _rendered(document: BaseModel, data: dict[str, Any]) -> dict[str, Any]:
    return {key: _text(inner, data[key]) for key, inner in _set_fields(document) if key in data}


def _text(value: Any, data: Any) -> Any:
    if isinstance(value, BaseModel):
        return _rendered(value, data)
    if isinstance(value, dict) and any(isinstance(one, BaseModel) for one in value.values()):
        return {key: _text(one, data[key]) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_text(one, other) for one, other in zip(value, data, strict=True)]
    return data


def _numeric(value: Any) -> Any:
    if isinstance(value, BaseModel):
        return numeric_document(value)
    if isinstance(value, Range):
        return {name: end for name, end in (("min", value.low), ("max", value.high)) if end is not None}
    if isinstance(value, dict):
        return {key: _numeric(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_numeric(one) for one in value]
    return value
