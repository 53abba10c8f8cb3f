"""All codes in one table."""

from fogspec.spec import codes, codes_of_rules
from fogspec.spec.codes import Code

CODES: dict[str, Code] = {
    **codes.TEXT, **codes.QUANTITIES, **codes.FIELDS, **codes.DATA, **codes_of_rules.NODES, **codes_of_rules.MEASURING,
    **codes_of_rules.MACHINES, **codes_of_rules.LINKS, **codes.POLICIES, **codes.GENERATED, **codes.LAUNCHES,
}  # fmt: skip
