"""Errors of single fields: a pydantic error becomes a `Diagnostic` in the words of the schema."""

import re
from typing import Any, Literal, get_args, get_origin

from fogspec.base.diagnostics import Diagnostic
from fogspec.base.quantities import Strict
from fogspec.base.units import NUMBER, UnitError, format_number
from fogspec.base.yaml.positions import Node, Path, dotted, find, span_of
from fogspec.base.yaml.writer import flow
from fogspec.language.introspect import annotation_at, part
from fogspec.language.suggest import closest

LIMITS = {"greater_than": "more than {gt}", "greater_than_equal": "at least {ge}", "less_than": "less than {lt}",
          "less_than_equal": "at most {le}"}  # fmt: skip
KINDS = {"string_type": "a string", "int_type": "an integer", "int_from_float": "an integer", "float_type": "a number",
         "bool_type": "true or false", "list_type": "a list", "dict_type": "a mapping",
         "model_type": "a mapping", "tuple_type": "a list"}  # fmt: skip

LOOK = "add a node that computes: include the launch file that starts perception or planning, or run init --from-graph"


def diagnose(model: Any, node: Node, path: Path, error: Any) -> Diagnostic:
    """Return the diagnostic for one of pydantic's errors at `path`, in the document under `node`."""
    kind, context = error["type"], error.get("ctx", {})
    name, span = dotted(path) or "the document", span_of(node, path)
    found = find(node, path)
    if kind == "missing":
        return Diagnostic("FS302", f"{name} is missing", span, f"add '{path[-1]}: {_example(model, path)}'")
    if kind == "value_error" and isinstance(context.get("error"), UnitError):
        wrong = context["error"]
        return Diagnostic(wrong.code, f"{name} {wrong.message}", span, f"write '{wrong.fix}'" if wrong.fix else None)
    if kind == "literal_error":
        return _choice(model, path, name, span, found)
    if kind in LIMITS:
        fix = _within(kind, context, found)
        return Diagnostic("FS206", f"{name} must be {_limit(model, path, kind, context)}", span, fix)
    if kind == "string_pattern_mismatch":
        return Diagnostic(
            "FS305", f"{name} must {_pattern(context['pattern'])}", span, _legal_name(context["pattern"], found)
        )
    if kind in ("too_short", "too_long"):
        fix = LOOK if path == ("spec", "cloud") else "add one, or remove the key"
        return Diagnostic("FS306", f"{name} must have at least {context.get('min_length')} entry", span, fix)
    if kind == "string_too_short":
        return Diagnostic("FS303", f"{name} must not be empty", span, f"write text, such as {_example(model, path)}")
    if kind in KINDS:
        if kind == "list_type" and found is not None and isinstance(found.value, dict):
            span = next(iter(found.keys.values()), span)
        message = f"{name} must be {KINDS[kind]}, not {_what(found)}"
        return Diagnostic("FS303", message, span, _retyped(kind, found))
    return Diagnostic("FS303", f"{name}: {error['msg'].lower()}", span)


def _choice(model: Any, path: Path, name: str, span: Any, found: Node | None) -> Diagnostic:
    kind = part(annotation_at(model, path))[0]
    known = [flow(one) for one in get_args(kind)] if get_origin(kind) is Literal else []
    near = closest(str(found.value), known) if found else None
    fix = f"write '{near}'" if near else None
    if len(known) == 1:
        code = "FS307" if path[-1] in ("apiVersion", "kind") else "FS304"
        return Diagnostic(code, f"{name} must be {known[0]}", span, f"write '{known[0]}'")
    return Diagnostic("FS304", f"{name} must be one of {', '.join(known)}", span, fix)


def _example(model: Any, path: Path) -> str:
    """Return what to write for a missing field: its only value, or the schema's example."""
    annotation = part(annotation_at(model, path))[0]
    if get_origin(annotation) is Literal and len(known := get_args(annotation)) == 1:
        return str(known[0])
    parent = part(annotation_at(model, path[:-1]))[0]
    field = parent.model_fields.get(str(path[-1])) if isinstance(parent, type) and issubclass(parent, Strict) else None
    return flow(field.examples[0]) if field is not None and field.examples else "…"


def _within(kind: str, context: Any, found: Node | None) -> str | None:
    """Return the number that was meant: a percentage from 2 as a fraction, otherwise the limit itself if it is allowed."""
    value = found.value if found else None
    if context.get("le") == 1 and isinstance(value, (int, float)) and 2 <= value <= 100:
        return f"write {format_number(round(value / 100, 15))}"
    bound = context.get("le", context.get("ge"))
    return f"write {format_number(bound)}" if kind.endswith("_equal") and isinstance(bound, (int, float)) else None


def _limit(model: Any, path: Path, kind: str, context: Any) -> str:
    parent = part(annotation_at(model, path[:-1]))[0]
    field = parent.model_fields.get(str(path[-1])) if isinstance(parent, type) and issubclass(parent, Strict) else None
    bound = {key: f"{value:g}" for key, value in context.items() if isinstance(value, (int, float))}
    text = LIMITS[kind].format(**bound)
    return f"{text} ({field.description})" if field and field.description else text


def _pattern(pattern: str) -> str:
    if "-a-z0-9" in pattern:
        return "be 1 to 63 lower-case letters, digits and '-', with a letter or digit at both ends"
    return "be a name of letters, digits and '_' that does not start with a digit"


def _legal_name(pattern: str, found: Node | None) -> str | None:
    """Return a name similar to the one found that the pattern accepts."""
    joint = "-" if "-a-z0-9" in pattern else "_"
    text = str(found.value).strip() if found else ""
    text = text.lower() if joint == "-" else re.sub(r"\W+$", "", text)
    made = "".join(one if (one.isascii() and one.isalnum()) or one == joint else joint for one in text)
    made = made.strip("-")[:63].strip("-") if joint == "-" else made
    if joint == "_" and made[:1].isdigit():
        made = f"_{made}"
    return f"write '{made}'" if made.strip("-_") else None


def _what(found: Node | None) -> str:
    if found is None:
        return "nothing"
    if isinstance(found.value, dict):
        return "a mapping"
    if isinstance(found.value, list):
        return "a list"
    if found.value is None:
        return "null"
    if isinstance(found.value, bool):
        return f"the word {found.text}"
    return f"the {'string' if isinstance(found.value, str) else 'number'} {_short(found.text)}"


def _short(text: str) -> str:
    text = " ".join(text.split())
    return text if len(text) <= 40 else f"{text[:37]}..."


def _retyped(kind: str, found: Node | None) -> str | None:
    """Return what to write if only the type is wrong."""
    if kind == "list_type" and found is not None and isinstance(found.value, dict) and found.keys:
        first = next(iter(found.keys))
        below = ", and indent the lines below it by 2 more spaces" if len(found.keys) > 1 else ""
        return f"write '- {first}'{below}"
    if found is None or isinstance(found.value, (dict, list)) or found.value is None:
        return None
    text = _short(found.text)
    if kind == "string_type":
        return f"write '{text}' in quotes"
    if kind == "float_type" and (percent := re.fullmatch(rf"({NUMBER})\s*%", text)):
        return f"write {format_number(round(float(percent[1]) / 100, 15))}"
    if kind == "int_type" and (counted := re.fullmatch(r"(\d+) [a-z]+", text)):
        return f"write {counted[1]}"
    if kind == "list_type":
        return f"write [{', '.join(text.replace(',', ' ').split())}]"
    if kind in ("int_type", "float_type", "bool_type") and found.quoted:
        return f"write {text} without quotes"
    return None
