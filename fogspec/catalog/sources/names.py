"""What an instance type's name says of its family and CPU architecture, for tables without these columns."""

import re
from functools import cache

from fogspec.base.clouds import cloud_of

ARCHITECTURES = {"aarch64": "arm64", "arm": "arm64", "amd64": "x86_64", "x64": "x86_64", "i386": "x86_64"}


@cache
def arch_of(cloud: str, instance: str, said: str) -> str:
    """`x86_64` or `arm64`, from what the table says, else from the name; other words stay as they are."""
    if word := said.strip().lower():
        return ARCHITECTURES.get(word, word)
    pattern = cloud_of(cloud).arm
    arm = pattern is not None and re.match(pattern, instance)
    return "arm64" if arm else "x86_64"


@cache
def family_of(cloud: str, instance: str, said: str) -> str:
    """The family: `c6i` of c6i.large, `n2` of n2-standard-4, `Dsv5` of Standard_D8s_v5; else the name's first word."""
    if said:
        return said
    pattern = cloud_of(cloud).family
    if pattern is not None and (match := re.match(pattern, instance)):
        return "".join(part or "" for part in match.groups())
    return re.split(r"[.\-_]", instance, maxsplit=1)[0]
