"""What providers and SkyPilot say, and the reason it becomes."""

import pytest

from fogspec.backends.skypilot.errors import CloudProblem, classify


def raised(kind: str, text: str, history: tuple[str, ...] = ()) -> Exception:
    """An exception by the name that SkyPilot's has."""
    problem = type(kind, (Exception,), {})(text)
    problem.failover_history = [Exception(one) for one in history]
    return problem


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
        (raised("CommandError", "Command rsync failed with return code 255"), "setup", True),
        (raised("NoCloudAccessError", "No cloud is enabled"), "access", False),
        (raised("ResourcesUnavailableError", ALL_FAILED, ("ExpiredToken: The security token is expired",)),
         "access", False),
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


def test_a_machine_that_is_not_there_and_silence_are_no_reasons() -> None:
    assert classify(raised("ClusterDoesNotExist", "Cluster 'fogspec-x' does not exist.")).gone
    assert classify(raised("ApiServerConnectionError", "Could not connect to SkyPilot API server")).contact
    assert classify(ConnectionError("refused")).contact


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


def test_a_problem_survives_the_pipe() -> None:
    problem = CloudProblem("image", "no such image", again=True, gone=True)
    assert CloudProblem.from_dict(problem.to_dict()).to_dict() == problem.to_dict()
    assert CloudProblem.from_dict({"reason": "rm -rf", "detail": 3}).to_dict()["reason"] == "setup"


def test_what_a_failing_api_server_was_doing_is_not_told() -> None:
    said = "Failed to get request 1: 500   + Exception Group Traceback (most recent call last):\n  | File x\n  | ValueError"
    assert classify(RuntimeError(said)).detail == "Failed to get request 1: 500"
