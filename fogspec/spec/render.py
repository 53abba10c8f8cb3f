"""A typed document as a person would write it in full: units in texts, defaults filled in, nothing that is not set."""

from typing import Any

from pydantic import BaseModel


def render_document(document: BaseModel) -> dict[str, Any]:
    """The document's values; reading them gives the same document."""
    data: dict[str, Any] = document.model_dump(mode="json", by_alias=True)
    found = _set(document, data)
    assert isinstance(found, dict)
    return found


def _set(value: Any, data: Any) -> Any:
    """`data` without the fields that are None and would be None anyway."""
    if isinstance(value, BaseModel):
        kept = {}
        for name, field in type(value).model_fields.items():
            key, inner = field.alias or name, getattr(value, name)
            if inner is not None or field.is_required() or field.default is not None:
                kept[key] = _set(inner, data[key])
        return kept
    if isinstance(value, dict) and any(isinstance(one, BaseModel) for one in value.values()):
        return {key: _set(one, data[key]) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_set(one, other) for one, other in zip(value, data, strict=True)]
    return data
