"""Values of plain YAML scalars: the core schema of YAML 1.2, minus what other readers take differently.

ROS 2 and SkyPilot read YAML 1.1, where `no` is false, `010` is 8 and `5:00` is 300. A scalar that the two versions
take for different values is refused with what to write instead, so that no file means two things.
"""

import math
import re
from dataclasses import dataclass

NULL = {"", "~", "null", "Null", "NULL"}
TRUE = {"true", "True", "TRUE"}
FALSE = {"false", "False", "FALSE"}
OLD_TRUE = {"yes", "Yes", "YES", "on", "On", "ON"}
OLD_FALSE = {"no", "No", "NO", "off", "Off", "OFF"}
INTEGER = re.compile(r"[-+]?(0|[1-9][0-9]*)")
BASED = re.compile(r"0o[0-7]+|0x[0-9a-fA-F]+")
FLOAT = re.compile(r"[-+]?(\.[0-9]+|(0|[1-9][0-9]*)(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
NOT_FINITE = re.compile(r"[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)")
LEADING_ZERO = re.compile(r"[-+]?0[0-9][0-9_]*(\.[0-9_]*)?([eE][-+]?[0-9]+)?")
SEXAGESIMAL = re.compile(r"[-+]?[0-9][0-9_]*(:[0-5]?[0-9])+(\.[0-9_]*)?")
UNDERSCORED = re.compile(r"[-+]?[0-9][0-9_]*_[0-9_]*(\.[0-9_]*)?")
LONGEST_NUMBER = 40
# Characters that are not text, or hide it: controls, separators other than a line feed, changes of reading direction.
HIDDEN = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff\ufeff\ufffe\uffff]")


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why a scalar is refused: its code, what must hold, and what to write."""

    code: str
    message: str
    fix: str


def resolve(text: str) -> str | int | float | bool | Refusal | None:
    """Return the value of a plain scalar, or the reason why it is rejected."""
    if text in NULL:
        return None
    if text in TRUE or text in FALSE:
        return text in TRUE
    if text in OLD_TRUE or text in OLD_FALSE:
        meant = "true" if text in OLD_TRUE else "false"
        message = f"{text} is ambiguous: {meant} in YAML 1.1 (ROS 2, SkyPilot), a string in YAML 1.2"
        return Refusal("FS110", message, f"write {meant}, or '{text}' in quotes")
    if not (text[0].isascii() and text[0] in "0123456789.+-"):
        return text
    return _number(text)


def _number(text: str) -> str | int | float | Refusal:
    if NOT_FINITE.fullmatch(text):
        return Refusal("FS111", "a number must be finite", "write a number")
    if LEADING_ZERO.fullmatch(text):
        bare = text.replace("_", "")
        kept = re.sub(r"^([-+]?)0+(?=\d)", r"\1", bare)
        return Refusal(
            "FS110", f"{text} is octal to some readers and decimal to others", f"write {kept}, or '{text}' in quotes"
        )
    if SEXAGESIMAL.fullmatch(text):
        return Refusal("FS110", f"{text} is a number in base 60 to some readers and a string to others",
                       f"write '{text}' in quotes, or a duration such as 5min")  # fmt: skip
    if UNDERSCORED.fullmatch(text):
        return Refusal("FS110", f"{text} is a number to some readers and a string to others",
                       f"write {text.replace('_', '')}, or '{text}' in quotes")  # fmt: skip
    whole, based = INTEGER.fullmatch(text), BASED.fullmatch(text)
    if not (whole or based or FLOAT.fullmatch(text)):
        return text
    if len(text) > LONGEST_NUMBER:
        return Refusal("FS111", f"a number has at most {LONGEST_NUMBER} characters", "write it shorter, or in quotes")
    if whole or based:
        value = int(text, 0) if based else int(text)
        if -(2**63) <= value < 2**63:
            return value
        return Refusal("FS111", "an integer must fit into 64 bits", f"write {float(value)!r}, or '{text}' in quotes")
    number = float(text)
    return number if math.isfinite(number) else Refusal("FS111", "a number must be finite", "write a smaller number")
