"""Find where a user's own spec sets a field."""

import os
import re
from collections.abc import Sequence

from fogspec.base.diagnostics import Span
from fogspec.base.yaml.positions import dotted
from fogspec.language.loader import read_nodes


def locate(spec: str | os.PathLike[str], fields: Sequence[str]) -> dict[str, list[tuple[Span, str]]]:
    """Return for each field that the file sets its spans, with the source lines.

    The file need not be valid; raise DiagnosticError if it cannot be read as YAML.
    """
    from fogspec.base.yaml.positions import spans

    found: dict[str, list[tuple[Span, str]]] = {}
    nodes, texts = read_nodes(spec)
    patterns = {field: _pattern(field) for field in fields}
    for node in nodes:
        for path, span in spans(node).items():
            name = dotted(path)
            for field, pattern in patterns.items():
                if path and pattern.fullmatch(name):
                    found.setdefault(field, []).append((span, texts.line(span) or ""))
    return found


def _pattern(field: str) -> re.Pattern[str]:
    """Return a pattern for `spec.cloud[].package` with any index, `spec.metrics.<name>.unit` with any name."""
    return re.compile(re.escape(field).replace(r"\[\]", r"\[\d+\]").replace("<name>", r"[^.\[]+"))
