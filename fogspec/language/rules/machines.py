"""Rules about which machines are admissible and where they are."""

import re
from collections.abc import Iterator, Sequence

from fogspec.base.clouds import CLOUDS, cloud_name, cloud_of, is_zone_id
from fogspec.base.units import Range, format_memory, format_number
from fogspec.base.yaml.positions import Path, dotted
from fogspec.language.rules.finding import Finding
from fogspec.language.schema import LOCAL_SHAPE, UBUNTU, Application
from fogspec.language.suggest import closest

OFFICIAL_IMAGE = "docker.io/library/ros:{}"
CLOUD, PLAIN = re.compile(r"[a-z0-9-]+"), re.compile(r"[A-Za-z0-9*_.-]+")
OF_PLAIN_NAMES = ("aws", "azure", "gcp")  # clouds in whose regions and zones there is nothing else
COUNT = re.compile(r"\d{1,6}(\.\d{1,3})?")


def is_place(text: str) -> bool:
    """Return whether a text may be cloud, cloud/region or cloud/region/zone: what a region's name is, its list decides."""
    cloud, *rest = text.split("/")
    named = text.isprintable() and all(one.strip() for one in rest) and bool(CLOUD.fullmatch(cloud))
    if cloud in OF_PLAIN_NAMES and not all(map(PLAIN.fullmatch, rest)):
        return False
    return named and (len(rest) <= 2 or cloud == "kubernetes")  # the name of a context may have a slash


def places(application: Application) -> Iterator[Finding]:
    """Require infra in the form cloud, cloud/region or cloud/region/zone."""
    for i, text in enumerate(application.spec.infra):
        path, cloud = ("spec", "infra", i), cloud_name(text)
        if not is_place(text):
            start, _, rest = re.sub(r"[:\s]+", "/", text.strip().strip("/").lower(), count=1).partition("/")
            tidy = f"{start}/{re.sub(r'[ /]+', '', rest)}" if start in CLOUDS else ""
            fix = f"write '{tidy}'" if is_place(tidy) else "write it like aws/us-east-1"
            yield Finding("FS531", path, f"{dotted(path)} must be cloud, cloud/region or cloud/region/zone", fix)
        elif is_zone_id(text):
            region = text.split("/")[1]
            fix = f"write '{cloud}/{region}' for all zones, or the name that yours has, such as '{cloud}/{region}/{region}a'"
            yield Finding("FS531", path, f"{dotted(path)} must have a zone's name, and {text} ends in an id", fix)
        elif cloud not in CLOUDS:
            near = closest(cloud, CLOUDS, 0.75)  # a newer SkyPilot knows more
            fix = f"write '{near}{text[len(cloud) :]}'" if near else f"write one of {', '.join([*CLOUDS][:6])}, ..."
            start, _, rest = text.partition("-")
            if start in CLOUDS and _cloud_with_region(rest):
                fix = f"write '{start}/{rest}'"
            elif near is None and (owner := _cloud_with_region(text)):
                fix = f"write '{owner}/{text}'"
            yield Finding(
                "FS531", path, f"{dotted(path)} must name a cloud that SkyPilot knows, and '{cloud}' is none", fix
            )


def _cloud_with_region(text: str) -> str | None:
    """Return the cloud that names its regions like this text."""
    return next((cloud.name for cloud in CLOUDS.values() if cloud.names_region(text)), None)


def gpus(application: Application) -> Iterator[Finding]:
    """Require what can be a GPU's name and a count: what is one, the catalog decides."""
    for i, text in enumerate(application.spec.hardware.gpus):
        if _is_gpu(text):
            continue
        path, tidy = ("spec", "hardware", "gpus", i), "".join(text.split())
        message = f"{dotted(path)} must be none, a GPU such as T4, or several such as T4:4, and '{text}' is not"
        yield Finding("FS532", path, message, f"write '{tidy}'" if _is_gpu(tidy) else "write it like T4, or T4:4")


def _is_gpu(text: str) -> bool:
    name, colon, count = text.partition(":")
    counted = not colon or bool(COUNT.fullmatch(count) and float(count) > 0 and name != "none")
    return bool(name.strip()) and name.isprintable() and counted


def listed_once(application: Application) -> Iterator[Finding]:
    """Reject repeated entries."""
    spec = application.spec
    lists: tuple[tuple[Path, Sequence[str]], ...] = (
        (("spec", "infra"), spec.infra),
        (("spec", "secrets"), spec.secrets),
        (("spec", "hardware", "gpus"), spec.hardware.gpus),
        (("spec", "hardware", "arch"), spec.hardware.arch),
        (("spec", "hardware", "allow"), spec.hardware.allow),
        (("spec", "hardware", "deny"), spec.hardware.deny),
        (("spec", "benchmark", "machines"), spec.benchmark.machines),
    )
    for path, entries in lists:
        for i, entry in enumerate(entries):
            if entry in entries[:i]:
                yield Finding(
                    "FS533", (*path, i), f"{dotted((*path, i))} is there already: {entry}", "remove one of the two"
                )
    allow: Path = ("spec", "hardware", "allow")
    for i, entry in enumerate(spec.hardware.deny):
        if entry in spec.hardware.allow:
            path = ("spec", "hardware", "deny", i)
            yield Finding(
                "FS533", path, f"{dotted(path)} is both allowed and denied: {entry}", "remove one of the two", (allow,)
            )


def sampled_machines(application: Application) -> Iterator[Finding]:
    """Require sampled machines to be instance types or shapes of this host."""
    for i, name in enumerate(application.spec.benchmark.machines):
        path = ("spec", "benchmark", "machines", i)
        if name.startswith("local") and not LOCAL_SHAPE.fullmatch(name):
            numbers = re.findall(r"[1-9]\d*", name)
            shape = f"local/{numbers[0]}cpu-{numbers[1]}gib" if len(numbers) == 2 else "local/2cpu-4gib"
            yield Finding("FS534", path, f"{dotted(path)} must look like local/<n>cpu-<m>gib", f"write '{shape}'")
        elif not name.startswith("local") and not (name.strip() and name.isprintable() and not {*name} & {*"*?/"}):
            yield Finding(
                "FS534",
                path,
                f"{dotted(path)} must be one instance type, such as c6i.large, or local/2cpu-4gib",
                "name each machine; patterns belong into spec.hardware.allow",
            )


def shapes(application: Application) -> Iterator[Finding]:
    """Require ranges of CPUs, memory and memory per vCPU that leave some machine possible."""
    hardware = application.spec.hardware
    at: Path = ("spec", "hardware")
    for name in ("cpus", "memory", "memory_per_cpu"):
        found: Range | None = getattr(hardware, name)
        if found is not None and found.high == 0:
            yield Finding(
                "FS535",
                (*at, name),
                f"{dotted((*at, name))}: the upper bound must be more than 0",
                "raise the upper bound",
            )
            return
    cpus, memory, ratio = hardware.cpus, hardware.memory, hardware.memory_per_cpu
    if cpus is None or memory is None or ratio is None:
        return
    about = ((*at, "cpus"), (*at, "memory"))
    if cpus.low and ratio.low and memory.high is not None and cpus.low * ratio.low > memory.high:
        least = f"{format_number(cpus.low)} vCPUs at {format_memory(ratio.low)} each"
        message = f"{least} need more than {format_memory(memory.high)}"
        yield Finding("FS535", (*at, "memory_per_cpu"), message, "widen one of cpus, memory, memory_per_cpu", about)
    if cpus.high is not None and ratio.high is not None and memory.low and cpus.high * ratio.high < memory.low:
        most = f"{format_number(cpus.high)} vCPUs at {format_memory(ratio.high)} each"
        message = f"{most} never have {format_memory(memory.low)}"
        yield Finding("FS535", (*at, "memory_per_cpu"), message, "widen one of cpus, memory, memory_per_cpu", about)


def lacks(distro: str, place: str) -> bool:
    """Return whether machines of a place are known to have another Ubuntu than that of a ROS 2 distribution."""
    cloud = CLOUDS.get(cloud_name(place))
    return cloud is not None and cloud.ubuntu not in (None, UBUNTU[distro])


def ros_block(infra: Sequence[str]) -> str:
    """Return the spec's words for a ROS 2 environment that machines at these places can have."""
    image = f", image: {OFFICIAL_IMAGE.format('jazzy')}" if any(lacks("jazzy", place) for place in infra) else ""
    return f"ros: {{distro: jazzy{image}}}"


def distribution(application: Application) -> Iterator[Finding]:
    """Require an image where the machines' own Ubuntu has no packages of the ROS 2 distribution."""
    spec = application.spec
    if spec.ros is None or spec.ros.image is not None:
        return
    distro, tunnel = spec.ros.distro, spec.connectivity.link == "wireguard"
    for i, place in enumerate(spec.infra):
        if not lacks(distro, place):
            continue
        cloud, image = cloud_of(place), f"'image: {OFFICIAL_IMAGE.format(distro)}'"
        yield Finding(
            "FS548",
            ("spec", "infra", i),
            f"machines of {cloud.name} have Ubuntu {cloud.ubuntu}, and ROS 2 {distro} comes for {UBUNTU[distro]}",
            f"write 'link: zenoh', and add {image} to spec.ros" if tunnel else f"add {image} to spec.ros",
            (("spec", "ros"), *([("spec", "connectivity", "link")] if tunnel else [])),
        )


RULES = (places, gpus, listed_once, sampled_machines, shapes, distribution)
