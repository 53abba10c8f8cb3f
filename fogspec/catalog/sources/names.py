"""What an instance type's name says of its family and CPU architecture, for tables without these columns.

Naming schemes: docs.aws.amazon.com/ec2 "Amazon EC2 instance type naming conventions", learn.microsoft.com "Azure
virtual machine sizes naming conventions", cloud.google.com/compute/docs "CPU platforms" (Arm: T2A, C4A, N4A, A4X).
"""

import re
from functools import cache

AWS_ARM = re.compile(r"a1\.|mac2|[a-z]+\d+[a-z]*g[a-z]*(-[^.]*)?\.")
AZURE_ARM = re.compile(r"Standard_[A-Z]+\d+(-\d+)?[a-z]*p[a-z]*(_|$)|.*_GB\d")
GCP_ARM = re.compile(r"(t2a|c4a|n4a|a4x)-")
AZURE_FAMILY = re.compile(r"(?:Standard|Basic)_([A-Z]+)\d+(?:-\d+)?([a-z]*)(?:.*_(v\d+))?")
ARCHITECTURES = {"aarch64": "arm64", "arm": "arm64", "amd64": "x86_64", "x64": "x86_64", "i386": "x86_64"}


@cache
def arch_of(cloud: str, instance: str, said: str) -> str:
    """`x86_64` or `arm64`, from what the table says, else from the name; other words stay as they are."""
    if word := said.strip().lower():
        return ARCHITECTURES.get(word, word)
    arm = {
        "aws": AWS_ARM.match(instance),
        "azure": AZURE_ARM.match(instance),
        "gcp": GCP_ARM.match(instance),
        "lambda": re.search(r"gh200|gb\d00", instance),
    }.get(cloud)
    return "arm64" if arm else "x86_64"


@cache
def family_of(cloud: str, instance: str, said: str) -> str:
    """The family: `c6i` of c6i.large, `n2` of n2-standard-4, `Dsv5` of Standard_D8s_v5; else the name's first word."""
    if said:
        return said
    if cloud == "azure" and (match := AZURE_FAMILY.match(instance)):
        return "".join(part or "" for part in match.groups())
    return re.split(r"[.\-_]", instance, maxsplit=1)[0]
