"""A bucket of moto's S3 on loopback, and the user's log-in to it in the environment."""

import itertools
import subprocess
import sys
from collections.abc import Iterator

import pytest

try:
    import boto3
    import moto.server  # noqa: F401
    import s3fs  # noqa: F401
except ImportError:
    boto3 = None  # type: ignore[assignment]

NAMES = itertools.count()


@pytest.fixture(scope="session")
def server() -> Iterator[str]:
    if boto3 is None:
        pytest.skip("needs s3fs, in an environment of its own: make object-store-test")
    # A process of its own: the commands of a test are forked from this one.
    served = "import sys; from moto.server import ThreadedMotoServer as Server; one = Server('127.0.0.1', 0, False); "
    served += "one.start(); print(one.get_host_and_port()[1], flush=True); sys.stdin.read()"
    pipe, nothing = subprocess.PIPE, subprocess.DEVNULL
    one = subprocess.Popen([sys.executable, "-c", served], stdin=pipe, stdout=pipe, stderr=nothing, text=True)
    assert one.stdout is not None
    port = next(line for line in one.stdout if line.strip().isdigit())
    yield f"http://127.0.0.1:{int(port)}"
    one.kill()
    one.wait()


@pytest.fixture
def bucket(server: str, monkeypatch: pytest.MonkeyPatch) -> str:
    """A new bucket's name."""
    for name, value in (
        ("AWS_ENDPOINT_URL_S3", server),
        ("AWS_ACCESS_KEY_ID", "testing"),
        ("AWS_SECRET_ACCESS_KEY", "testing"),
        ("AWS_DEFAULT_REGION", "us-east-1"),
        ("AWS_EC2_METADATA_DISABLED", "true"),
        ("AWS_CONFIG_FILE", "/dev/null"),
        ("AWS_SHARED_CREDENTIALS_FILE", "/dev/null"),
    ):
        monkeypatch.setenv(name, value)
    name = f"live-{next(NAMES)}"
    boto3.client("s3").create_bucket(Bucket=name)
    return name
