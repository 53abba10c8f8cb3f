"""What providers and SkyPilot say, and the reason it becomes."""

import pytest

from fogspec.backends.skypilot.errors import DETAIL_LIMIT, CloudProblem, classify


def raised(kind: str, text: str, history: tuple[str, ...] = ()) -> Exception:
    """An exception by the name that SkyPilot's has."""
    problem = type(kind, (Exception,), {})(text)
    problem.failover_history = [Exception(one) for one in history]
    return problem


IMAGE = "r.example.org/team/nodes@sha256:00"
CONTAINER = "Failed to run docker setup commands."
LOGIN_FAILS = (
    "Command sudo docker login --username me --password <redacted> r.example.org failed with return code 1.\n"
    f"{CONTAINER}\nError response from daemon: Get https://r.example.org/v2/: unauthorized: authentication required"
)
ALL_FAILED = "Failed to provision all possible launchable resources. Relax the task's resource requirements"


@pytest.mark.parametrize(
    ("problem", "reason", "again"),
    [
        (raised("ResourcesUnavailableError", ALL_FAILED, ("VcpuLimitExceeded: You have requested more vCPU capacity",)),
         "quota", False),
        (raised("ResourcesUnavailableError", ALL_FAILED, ("Quota 'GPUS_ALL_REGIONS' exceeded.  Limit: 0.0 globally.",)),
         "quota", False),
        (raised("ResourcesUnavailableError", ALL_FAILED, ("QuotaExceeded: Operation could not be completed",)),
         "quota", False),
        (raised("ResourcesUnavailableError", ALL_FAILED,
                ("InsufficientInstanceCapacity: We currently do not have sufficient g4dn.xlarge capacity",)),
         "capacity", True),
        (raised("ResourcesUnavailableError", ALL_FAILED, ("ZONE_RESOURCE_POOL_EXHAUSTED_WITH_DETAILS",)), "capacity", True),
        (raised("ResourcesUnavailableError", ALL_FAILED, ("SkuNotAvailable: The requested size",)), "capacity", True),
        (raised("ResourcesUnavailableError", "Catalog does not contain any instances satisfying the request"),
         "capacity", False),
        (raised("ClusterSetUpError", "docker pull failed: manifest for ros:jazy not found: manifest unknown"),
         "image", False),
        (raised("CommandError", "pull access denied for me/mine, repository does not exist"), "image", False),
        (raised("CommandError", LOGIN_FAILS), "image", False),
        (raised("CommandError", f"Command sudo docker pull {IMAGE} failed with return code 1.\n{CONTAINER}\n"
                                "Error response from daemon: Get https://r.example.org/v2/: net/http: TLS handshake timeout"),
         "image", True),
        (raised("CommandError", f"Command sudo docker pull {IMAGE} failed with return code 1.\n{CONTAINER}\n"
                                "no matching manifest for linux/amd64 in the manifest list entries"),
         "image", False),
        (raised("CommandError", f"Command flock -c sudo docker run {IMAGE} failed with return code 126.\n{CONTAINER}\n"
                                "Error: crun: setrlimit `RLIMIT_NOFILE`: Operation not permitted: OCI permission denied"),
         "setup", True),
        (raised("CommandError", "Command rsync failed with return code 255"), "setup", True),
        (raised("NoCloudAccessError", "No cloud is enabled"), "access", False),
        (raised("ResourcesUnavailableError", ALL_FAILED, ("ExpiredToken: The security token is expired",)),
         "access", False),
        (raised("ResourcesUnavailableError", ALL_FAILED, ("RequestExpired: Request has expired.",)), "access", False),
        (raised("ResourcesUnavailableError", ALL_FAILED, ("UnauthorizedOperation: You are not authorized",)),
         "access", False),
        (raised("ResourcesUnavailableError", ALL_FAILED, ("RequestLimitExceeded: Request limit exceeded.",)),
         "capacity", True),
        (raised("NotSupportedError", "Spot instances are not supported in Slurm."), "setup", False),
        (raised("ValueError", "Invalid instance type 'c6i.larg' for cloud AWS."), "setup", False),
    ],
)  # fmt: skip
def test_reasons(problem: Exception, reason: str, again: bool) -> None:
    found = classify(problem)
    assert (found.reason, found.again, found.gone, found.contact) == (reason, again, False, False)
    assert found.detail


def unsupported(*texts: str) -> Exception:
    problem = raised("ResourcesUnavailableError", ALL_FAILED)
    problem.failover_history = [raised("NotSupportedError", text) for text in texts]
    return problem


@pytest.mark.parametrize(
    "text",
    [
        "An error occurred (AccessDenied) when calling the CreateRole operation: User is not authorized",
        "OptInRequired: You are not subscribed to this service.",
        "PendingVerification: Your request for accessing resources in this region is being validated",
        "Blocked: This account is currently blocked and not recognized as a valid account.",
        "InvalidParameterCombination: The specified instance type is not eligible for Free Tier.",
        "VPCIdNotSpecified: No default VPC for this user",
        "Required 'compute.instances.create' permission for 'projects/mine/zones/us-central1-a/instances/x'",
        "{'status': 'PERMISSION_DENIED', 'message': 'Permission denied on resource project mine'}",
        "Compute Engine API has not been used in project 1 before or it is disabled.",
        "Constraint constraints/compute.vmExternalIpAccess violated for project 1.",
        "(AuthorizationFailed) The client does not have authorization to perform action",
        "MissingSubscriptionRegistration: The subscription is not registered to use namespace 'Microsoft.Compute'.",
        "ReadOnlyDisabledSubscription: The subscription is disabled and therefore marked as read only.",
        "RequestDisallowedByPolicy: Resource 'x' was disallowed by policy.",
    ],
)
def test_what_an_account_may_not_is_access_and_not_a_lack_of_machines(text: str) -> None:
    found = classify(raised("ResourcesUnavailableError", ALL_FAILED, (text,)))
    assert (found.reason, found.again) == ("access", False)
    assert text[:30] in found.detail


@pytest.mark.parametrize(
    "text",
    [
        "me@203.0.113.7: Permission denied (publickey).",
        'rsync: [receiver] mkstemp "/home/me/.x" failed: Permission denied (13)',
        "tar: agent.pyz: Cannot write: Disk quota exceeded",
        "E: Failed to fetch https://ppa.example.org/InRelease  401  Unauthorized [IP: 192.0.2.1 443]",
        "ERROR: HTTP error 401 while getting https://pypi.example.org/simple/ray/: Unauthorized",
        "curl: (22) The requested URL returned error: 403 Forbidden, no credential",
        "Error response from daemon: toomanyrequests: You have reached your unauthenticated pull rate limit, quota exceeded",
    ],
)
@pytest.mark.parametrize("kind", ["CommandError", "ResourcesUnavailableError", "ClusterSetUpError"])
def test_what_programs_on_the_machine_say_is_no_refusal_of_its_provider(kind: str, text: str) -> None:
    """A machine is up by then: that all others of the cloud are refused, too, does not follow."""
    found = classify(raised(kind, text) if kind != "ResourcesUnavailableError" else raised(kind, ALL_FAILED, (text,)))
    assert found.reason == ("capacity" if kind == "ResourcesUnavailableError" else "setup")
    assert found.again
    assert not found.refused, "what was up is paid"
    assert text.strip() in found.detail


@pytest.mark.parametrize(
    "problem",
    [
        raised("ResourcesUnavailableError", ALL_FAILED,
               ("[pd-balanced] features are not compatible for creating instance.",)),
        raised("ResourcesUnavailableError", ALL_FAILED,
               ("The VM size 'Standard_D2s_v6' cannot boot with OS image or disk. Please check that disk controller types",)),
        unsupported("Autodown is not supported on Verda.", "Docker image is not supported on Verda."),
    ],
)  # fmt: skip
def test_what_a_cloud_never_has_is_not_tried_again(problem: Exception) -> None:
    found = classify(problem)
    assert (found.reason, found.again) == ("capacity", False), "and another machine may take its place"


def test_what_one_of_two_clouds_never_has_may_come_from_the_other() -> None:
    both = unsupported("Autodown is not supported on Verda.")
    both.failover_history.append(Exception("ZONE_RESOURCE_POOL_EXHAUSTED"))
    assert (classify(both).reason, classify(both).again) == ("capacity", True)


def test_a_machine_that_is_not_there_and_silence_are_no_reasons() -> None:
    assert classify(raised("ClusterDoesNotExist", "Cluster 'fogspec-x' does not exist.")).gone
    assert classify(raised("ApiServerConnectionError", "Could not connect to SkyPilot API server")).contact
    assert classify(ConnectionError("refused")).contact
    for words in (
        "No SkyPilot API server endpoint is configured, and starting a local API server on this machine is disabled",
        "SkyPilot API server process exited unexpectedly.\nView logs at: ~/.sky/api_server/server.log",
        "Failed to start SkyPilot API server at http://127.0.0.1:46580",
    ):
        assert classify(RuntimeError(words)).contact


def test_the_cause_speaks_too_and_details_are_short_and_plain() -> None:
    problem = raised("ResourcesUnavailableError", f"\x1b[31m{ALL_FAILED}\x1b[0m\n" + "x" * 2000)
    problem.__cause__ = Exception("VcpuLimitExceeded")
    found = classify(problem)
    assert found.reason == "quota"
    assert len(found.detail) <= 500
    assert "\x1b" not in found.detail


LOST = "Failed to acquire resources in all zones in us-east-1 for {AWS(c6i.4xlarge, mem=32.0)}."
LOG = (
    "\x1b[2mW 11-22 17:41:03.831 PID=1557 instance.py:415] create_instances: Attempt failed with An error occurred "
    "(VcpuLimitExceeded) when calling the RunInstances operation (reached max retries: 0): You have requested more vCPU "
    "capacity than your current vCPU limit of 16 allows.\x1b[0m\n"
)


def test_what_the_provider_answered_is_told_where_only_the_log_has_it() -> None:
    """Recorded: SkyPilot 0.14.1 on AWS's API."""
    found = classify(raised("ResourcesUnavailableError", LOST, (LOST,)), LOG * 2)
    assert (found.reason, found.again) == ("quota", False)
    assert found.detail.startswith(
        "VcpuLimitExceeded: You have requested more vCPU capacity than your current vCPU limit"
    )
    assert found.detail.count("VcpuLimitExceeded") == 1
    assert classify(raised("ResourcesUnavailableError", LOST, (LOST,))).reason == "capacity"


def tried(*places: tuple[str, str]) -> str:
    """What SkyPilot 0.14 logs of a launch that failed in each of these places."""
    lines = [f"⚙︎ Launching on {place}.\n\x1b[2m{said}\x1b[0m\n" for place, said in places]
    return "Considered resources (1 node):\n" + "".join(lines) + f"{ALL_FAILED}\n"


NO_ROOM = "Got return code 'ZONE_RESOURCE_POOL_EXHAUSTED' in us-central1-a: 'The zone does not have enough resources'"
OUT_OF_TIME = "run_instances error: HTTPSConnectionPool: Read timed out. (no capacity)"


@pytest.mark.parametrize(
    ("log", "reason", "refused"),
    [
        (tried(("GCP us-central1 (us-central1-a)", NO_ROOM)), "capacity", True),
        (tried(("GCP us-central1 (us-central1-a)", "Got return code 'QUOTA_EXCEEDED' in us-central1-a: 'Limit: 0.0'")),
         "quota", True),
        (tried(("Azure eastus", "Failed to create instances: [azure.core.exceptions.HttpResponseError] (SkuNotAvailable) The")),
         "capacity", True),
        (tried(("RunPod CA", "run_instances error: There are no longer any instances available with the requested specs")),
         "capacity", True),
        (tried(("Lambda us-east-1", "run_instances error: instance-operations/launch/insufficient-capacity")),
         "capacity", True),
        (tried(("Lambda us-east-1", "run_instances error: Unauthorized: Invalid API key")), "access", True),
        (tried(("AWS us-east-1 (us-east-1a)", LOG)), "quota", True),
        (tried(("GCP us-central1 (us-central1-a)", NO_ROOM), ("GCP us-central1 (us-central1-b)", "")), "capacity", False),
        (tried(("RunPod CA", "")), "capacity", False),
        (tried(("RunPod CA", OUT_OF_TIME)), "capacity", False),
        (tried(("Lambda us-east-1", "run_instances error: an answer that is not known")), "capacity", False),
        (NO_ROOM, "capacity", False),
        ("", "capacity", False),
    ],
)  # fmt: skip
def test_that_there_was_no_machine_is_certain_where_each_place_refused_to_create_it(
    log: str, reason: str, refused: bool
) -> None:
    found = classify(raised("ResourcesUnavailableError", LOST, (LOST,)), log)
    assert (found.reason, found.refused) == (reason, refused)
    assert not classify(raised("RuntimeError", "Failed to SSH to 203.0.113.7 after timeout 600s"), log).refused


def test_what_was_never_asked_for_was_not_there() -> None:
    assert classify(raised("NoCloudAccessError", "No cloud is enabled")).refused
    assert classify(raised("ResourcesUnavailableError", "Catalog does not contain any instances")).refused
    assert classify(unsupported("Autodown is not supported on Verda.")).refused
    both = unsupported("Autodown is not supported on Verda.")
    both.failover_history.append(Exception("ZONE_RESOURCE_POOL_EXHAUSTED"))
    assert not classify(both).refused
    for text in ("InsufficientInstanceCapacity", "ExpiredToken: The security token is expired", "VcpuLimitExceeded"):
        assert not classify(raised("ResourcesUnavailableError", ALL_FAILED, (text,))).refused, "words are no evidence"


def test_a_problem_survives_the_pipe() -> None:
    problem = CloudProblem("image", "no such image", again=True, gone=True, refused=True)
    assert CloudProblem.from_dict(problem.to_dict()).to_dict() == problem.to_dict()
    assert CloudProblem.from_dict({"reason": "rm -rf", "detail": 3}).to_dict()["reason"] == "setup"


def test_what_a_failing_api_server_was_doing_is_not_told() -> None:
    said = "Failed to get request 1: 500   + Exception Group Traceback (most recent call last):\n  | File x\n  | ValueError"
    assert classify(RuntimeError(said)).detail == "Failed to get request 1: 500"


def test_what_the_provider_answers_comes_first_also_without_a_log() -> None:
    found = classify(raised(
        "StopFailoverError",
        "terminating 'mine' failed. Details: [botocore.exceptions.ClientError] An error occurred (ExpiredToken) when calling "
        "the DescribeInstances operation: The security token included in the request is expired",
    ))  # fmt: skip
    assert found.reason == "access"
    assert found.detail.startswith(
        "ExpiredToken: The security token included in the request is expired | terminating 'mine'"
    )


def test_a_long_detail_keeps_its_beginning_and_its_end() -> None:
    found = classify(
        raised("ResourcesUnavailableError", f"{ALL_FAILED}: {'zone by zone, ' * 60}reason: no credentials")
    )
    assert len(found.detail) <= DETAIL_LIMIT
    assert found.detail.startswith(ALL_FAILED)
    assert found.detail.endswith("reason: no credentials")
