"""What the paper says, and the machines behind it as far as its prices give them away.

Chen, Hari, Khare, Le, Chung, Drake, Ichnowski, Kubiatowicz, Goldberg, FogROS2-Config: A Toolkit for Choosing Server
Configurations for Cloud Robotics, ICRA 2024, arXiv 2311.05600. The measured samples are in results/, with their source.
"""

from dataclasses import dataclass

WINDOW_S = 300.0  # of each sample in Table II
GRID = "2, 16, 64 vCPUs with 2, 4, 8 GiB each"  # Table I
FAMILIES = ("c6i", "m6i", "r6i")
REGION = "us-east-1"
GPU_REGION = "us-west-1"


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """A cell of Table II in US cents, and the machines whose prices give it: (instance type, region); empty if unknown."""

    application: str
    what: str
    cents: float
    machines: tuple[tuple[str, str], ...]
    why: str


def _sizes(*sizes: str) -> tuple[tuple[str, str], ...]:
    return tuple((f"{family}.{size}", REGION) for family in FAMILIES for size in sizes)


NINE = _sizes("large", "4xlarge", "16xlarge")
WITHOUT_R6I_LARGE = tuple(one for one in NINE if one[0] != "r6i.large")
FULL = (
    ("m6i.large", REGION), ("r6i.large", REGION), *_sizes("xlarge", "4xlarge", "8xlarge", "12xlarge"),
    ("c6i.16xlarge", REGION), ("m6i.16xlarge", REGION),
)  # fmt: skip
NOT_SUPERSET = "its full sweep has no r6i.16xlarge, which its sample has"
UNKNOWN = "the machines are not published, and several lists give this sum"
TABLE_2 = (
    Cell(application="Dex-Net", what="sampled", cents=117.67,
         machines=(*NINE, ("g4dn.xlarge", GPU_REGION), ("g4dn.2xlarge", GPU_REGION)),
         why=f"two T4 machines at the prices of {GPU_REGION}; compile plans three, all in {REGION}"),
    Cell(application="SLAM", what="sampled", cents=104.67,
         machines=(*WITHOUT_R6I_LARGE, ("c4.large", REGION)),
         why="c4.large ($0.10/h) in place of r6i.large ($0.126/h): inferred from the price, 104.675 is printed as 104.67"),
    Cell(application="Cubicles", what="sampled", cents=103.84, machines=WITHOUT_R6I_LARGE,
         why="r6i.large failed and was left out; compile cannot know that beforehand"),
    Cell(application="Apartment", what="sampled", cents=104.89, machines=NINE, why="the same"),
    Cell(application="Dex-Net", what="full", cents=205.00, machines=(), why=UNKNOWN),
    Cell(application="SLAM", what="full", cents=201.43, machines=(), why=UNKNOWN),
    Cell(application="Cubicles", what="full", cents=178.03, machines=FULL, why=NOT_SUPERSET),
    Cell(application="Apartment", what="full", cents=178.74,
         machines=(*FULL, ("c6i.large", REGION)), why=NOT_SUPERSET),
)  # fmt: skip

# The families of the authors' code, which their samples are refitted with: curve in vCPUs, curve in memory, R² to be had.
THEIR_FAMILIES = {
    "Dex-Net": ("power", "power", 0.9999),
    "SLAM": ("power", "power", 0.971),
    "Cubicles": ("power", "power", 0.9996),
    "Apartment": ("hyperbolic", "hyperbolic", 0.733),
}

# Listing 1: constraints of the launch file.
LISTING_LATENCY_S = 0.01
LISTING_CENTS = 0.01

# "up to 20x", 4.95x: prices of an hour.
DEAREST_USD_PER_HOUR = 4.99
DEAREST = "i3.16xlarge"
SAVINGS = (("r6i.4xlarge", 4.95), ("r6i.xlarge", 20.0))

# Section I: a vacuum robot.
VACUUM_MACHINE = "t2.medium"
VACUUM_SESSION = 20 * 60.0
VACUUM_SESSIONS = 1 / (7 * 86400.0)
VACUUM_YEARS = 6
VACUUM_USD = 6.00
VACUUM_RATE = 10.0  # requests per second, ours: the paper names none
