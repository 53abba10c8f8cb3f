"""Classification of SkyPilot's exceptions: a reason for the results, and whether a retry can help soon.

Providers' error codes are searched in the text of the exception and of all its causes, because SkyPilot collects the
refusals of every zone that it tried in `failover_history` and reports them all as unavailable resources. On AWS the causes
do not reach the client (0.14.1: "Failed to launch instances. Max attempts exceeded."); its log of the request has them. Codes:
docs.aws.amazon.com/AWSEC2/latest/APIReference/errors-overview.html; cloud.google.com/compute/docs/troubleshooting;
learn.microsoft.com/azure/azure-resource-manager/troubleshooting/common-deployment-errors.
"""

import re
from collections.abc import Iterator, Mapping
from typing import Any, get_args

from fogspec.results.schema import Reason

DETAIL_LIMIT = 500
FORGOTTEN = "SkyPilot knows of no launch of it: none was requested, or its API server has restarted since"
# The traceback of an API server that failed: nothing in it is about the machine.
SERVER_TRACEBACK = re.compile(r"[\s+|]*Exception Group Traceback \(most recent call last\):.*", re.DOTALL)
# botocore.exceptions.ClientError.MSG_TEMPLATE
REFUSAL = re.compile(
    r"An error occurred \((?P<code>[\w.]+)\) when calling the \w+ operation(?: \([^)]*\))?: (?P<why>.*)"
)
# What SkyPilot (0.14: sky/provision/*/instance.py) logs where a provider refused to create a machine, by itself on one line:
# on AWS, Google Cloud, Azure, and elsewhere.
CREATION = re.compile(
    r"An error occurred \([\w.]+\) when calling the RunInstances operation[^\n]*|Got return codes? [^\n]*"
    r"|(?:Failed to create instances?|run_instances error(?: \([^)]*\))?|API error during instance launch"
    r"|Resource unavailability error): [^\n]*"
)
PLACE = re.compile(r"\bLaunching (?:\S+ )?on ")  # what it logs before it tries one zone, or one region
NO_DECISION = re.compile(r"time(?:d[ -]?)? ?out", re.IGNORECASE)  # a machine may be there
# Of an API that does not answer, botocore.exceptions has these, and SkyPilot's exception nothing.
NO_ANSWER = re.compile(r'(?:(?:Read|Connect) timeout on|Could not connect to the) endpoint URL: "[^"]*"')
ANSI = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")

# What programs on the machine, which is there by then, say of files, keys and servers of their own: no provider's refusal.
PROGRAMS = re.compile(
    r"Permission denied \([^)]*\)|Permission denied, please try again|Disk quota exceeded|toomanyrequests[^\n]*"
    r"|^[^\n]*(?:\b(?:ssh|scp|rsync|pip3?|curl|wget|git|rosdep|dpkg)\b[^:\n]{0,40}:"
    r"|\bHTTP error \d{3} while|\d{3} Error, Credentials)[^\n]*"
    r"|^\s*(?:E|W|N|Err):[^\n]*",
    re.MULTILINE,
)
# The first match decides: a quota is often reported as a lack of capacity, never the other way round. Too many requests
# at once are not quota: they are answered soon.
WORDS: tuple[tuple[Reason, bool, str], ...] = (
    # Compute Engine on series without that disk; Azure on sizes whose disks its image cannot read.
    ("capacity", False, r"features are not compatible|cannot boot with OS image or disk"),
    ("capacity", True, r"RequestLimitExceeded|Throttling"),
    ("quota", False, r"quota|LimitExceeded|MaxSpotInstanceCount|limit of .{0,40}(instances|vcpus)|exceeded.{0,20}limit"
                     r"|EnforcePartLimits|AssocGrp|QOSMax|QOSGrp"),
    ("image", False, r"pull access denied|manifest unknown|manifest for .{0,200} not found|ErrImagePull|ImagePullBackOff"
                     r"|InvalidAMIID|repository does not exist|no such image|image .{0,200} (not found|does not exist)"),
    ("capacity", True, r"InsufficientInstanceCapacity|insufficient.{0,20}capacity|RESOURCE_POOL_EXHAUSTED|stockout"
                       r"|SkuNotAvailable|AllocationFailed|out of (stock|capacity)|no capacity|no longer any instances"
                       r"|Insufficient (cpu|memory)"
                       r"|ReqNodeNotAvail|nodes? .{0,60}(down|drained)|timed out .{0,60}(allocat|provision|schedul)"),
)  # fmt: skip
# SkyPilot starts the container by commands on the machine, which exists by then (sky.provision.docker_utils, 0.14).
CONTAINER = "Failed to run docker setup commands"
PULL = re.compile(r"(docker|podman) (pull|login) .{0,400}failed with return code", re.DOTALL)
REGISTRY_REFUSES = re.compile(
    r"unauthorized|denied|invalid username/password|unknown|not found|no matching manifest|no image found",
    re.IGNORECASE,
)
ACCESS = re.compile(
    r"credential|not enabled|no cloud access|unauthorized|permission denied|sky check"
    r"|ExpiredToken|RequestExpired|AuthFailure|InvalidClientTokenId"
    # The account itself, of AWS, Google Cloud, Azure.
    r"|AccessDenied|OptInRequired|PendingVerification|\(Blocked\)|\bBlocked:|eligible for Free Tier"
    r"|No default VPC|VPCIdNotSpecified|Required '[\w.]+' permission|PERMISSION_DENIED|SERVICE_DISABLED"
    r"|has not been used in project|Constraint constraints/"
    r"|AuthorizationFailed|MissingSubscriptionRegistration|ReadOnlyDisabledSubscription|RequestDisallowedByPolicy"
    r"|\b(?:is|are) forbidden: User|Reason: Forbidden",  # Kubernetes: the namespace gives no right
    re.IGNORECASE,
)
CONTACT = {
    "ApiServerConnectionError", "ServerTemporarilyUnavailableError", "NetworkError", "ClusterStatusFetchingError",
    "FetchClusterInfoError", "RequestInterruptedError", "SkyletUnavailableError", "SkyletInternalError",
    "ConnectionError", "Timeout", "TimeoutError", "ConcurrentWorkerExhaustedError", "ExecutionRetryableError",
}  # fmt: skip
# RuntimeErrors of SkyPilot's client, whose own API server does not start (0.14.1: sky/server/common.py).
SERVER = re.compile(
    r"No SkyPilot API server endpoint|SkyPilot API server process exited|Failed to start SkyPilot API server"
)
# What SkyPilot finds before it asks for a machine.
BEFORE_ANY = {"NotSupportedError", "InvalidClusterNameError", "CloudUserIdentityError"}
GONE = {"ClusterDoesNotExist"}
SETUP = {"ClusterSetUpError", "CommandError", "CommandFailureException", "ClusterNotUpError"}
UNFIT = {
    "ResourcesMismatchError", "NotSupportedError", "InvalidClusterNameError", "ProvisionUnsupportedError", "ValueError",
}  # fmt: skip


class CloudProblem(Exception):
    """A call that SkyPilot refused or could not carry out.

    `again`: a retry can help soon. `gone`: the requested machine does not exist. `contact`: there was no answer, so the state
    is unknown. `refused`: it is certain that there was no machine, so nothing is paid.
    """

    def __init__(
        self,
        reason: Reason,
        detail: str,
        *,
        again: bool = False,
        gone: bool = False,
        contact: bool = False,
        refused: bool = False,
    ) -> None:
        super().__init__(detail)
        self.reason = reason
        self.detail = detail
        self.again = again
        self.gone = gone
        self.contact = contact
        self.refused = refused

    def to_dict(self) -> dict[str, Any]:
        """Return the problem as JSON values."""
        return {name: getattr(self, name) for name in ("reason", "detail", "again", "gone", "contact", "refused")}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "CloudProblem":
        """Return the problem from the values of `to_dict`."""
        reason: Reason = values["reason"] if values.get("reason") in get_args(Reason) else "setup"
        flags = {name: bool(values.get(name)) for name in ("again", "gone", "contact", "refused")}
        return cls(reason, str(values.get("detail", "")), **flags)


def classify(problem: BaseException, log: str = "") -> CloudProblem:
    """Return the problem that an exception of SkyPilot, or of the network below it, stands for.

    `log` is what SkyPilot logged of the request that failed. What the provider answered, in it or in the exception, comes
    first in the detail.
    """
    if isinstance(problem, CloudProblem):
        return problem
    kinds = {kind for one in _causes(problem) for kind in _kinds(one)}
    said, logged = [plain(str(one)) for one in _causes(problem)], plain(log)
    refusals = [
        f"{found['code']}: {found['why'].strip()}" for text in (logged, *said) for found in REFUSAL.finditer(text)
    ]
    refusals += [line for line in CREATION.findall(logged) if not REFUSAL.match(line)] + NO_ANSWER.findall(logged)
    text = "\n".join(dict.fromkeys([*refusals, *said]))
    detail, text = _detail(problem, text), PROGRAMS.sub("", text)
    if kinds & GONE:
        return CloudProblem("capacity", detail, gone=True)
    refused = _refused(problem, kinds, logged)
    for reason, again, words in WORDS:
        if re.search(words, text, re.IGNORECASE):
            return CloudProblem(reason, detail, again=again, refused=refused)
    if kinds & CONTACT or SERVER.search(text):
        return CloudProblem("setup", detail, again=True, contact=True)
    if CONTAINER in text:
        pulled = PULL.search(text) is not None
        return CloudProblem(
            "image" if pulled else "setup", detail, again=not (pulled and REGISTRY_REFUSES.search(text))
        )
    if "NoCloudAccessError" in kinds or ACCESS.search(text):
        return CloudProblem("access", detail, refused=refused)
    if "ResourcesUnavailableError" in kinds:
        tried = getattr(problem, "failover_history", None) or ()
        if tried and all(kind & (UNFIT - {"ValueError"}) for kind in map(_kinds, tried)):
            return CloudProblem("capacity", detail, refused=refused)  # what its cloud, or SkyPilot there, never has
        return CloudProblem("capacity", detail, again=bool(tried), refused=refused)
    if kinds & SETUP:
        return CloudProblem("setup", detail, again=True)
    return CloudProblem("setup", detail, again=not kinds & UNFIT)


def _refused(problem: BaseException, kinds: set[str], log: str) -> bool:
    """Return whether it is certain that there was no machine, whatever words the exception has.

    SkyPilot reports all that fails until a machine has booted as unavailable resources. Either it tried nothing, or in each
    place that it tried its provider refused to create one, and said why.
    """
    if "NoCloudAccessError" in kinds:
        return True
    if "ResourcesUnavailableError" not in kinds:
        return False
    tried = getattr(problem, "failover_history", None) or ()
    if all(_kinds(one) & BEFORE_ANY for one in tried):
        return True
    places = PLACE.split(log)[1:]
    return bool(places) and all(any(map(_decided, CREATION.findall(place))) for place in places)


def _decided(line: str) -> bool:
    """Return whether a provider that refused to create a machine has decided so: it has none left, or allows none."""
    if NO_DECISION.search(line):
        return False
    return ACCESS.search(line) is not None or any(
        reason in ("capacity", "quota") and re.search(words, line, re.IGNORECASE) for reason, _, words in WORDS
    )


def _kinds(problem: BaseException) -> set[str]:
    return {kind.__name__ for kind in type(problem).__mro__}


def _causes(problem: BaseException) -> Iterator[BaseException]:
    """Yield the exception and all its causes."""
    yield problem
    for one in getattr(problem, "failover_history", None) or ():
        if isinstance(one, BaseException):
            yield from _causes(one)
    if problem.__cause__ is not None:
        yield from _causes(problem.__cause__)


def _detail(problem: BaseException, text: str) -> str:
    text = SERVER_TRACEBACK.sub("", text)
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    detail = " | ".join(dict.fromkeys(lines)) or type(problem).__name__
    if len(detail) <= DETAIL_LIMIT:
        return detail
    return f"{detail[: DETAIL_LIMIT // 2 - 3]} … {detail[-DETAIL_LIMIT // 2 :]}"  # SkyPilot puts the reason last


def plain(text: str) -> str:
    """Return the text without colors and control characters; lines are kept."""
    return "".join(c for c in ANSI.sub("", text) if c.isprintable() or c == "\n")
