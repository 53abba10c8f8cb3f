"""A SkyPilot of its own on that account: home, configuration, keys. Nothing of it touches the user's ~/.sky or ~/.aws."""

import json
import sys
import urllib.request
import zlib
from pathlib import Path
from typing import Any

import boto3

from tests.tools.aws import shapes
from tests.tools.aws.cloud import ENDPOINT
from tests.tools.slurm import engine

PROFILE = "skypilot-v1"  # what SkyPilot makes of an account at its first launch, with two waits of 15 s
KEYS = "[default]\naws_access_key_id = AKIAOFTHEUSER\naws_secret_access_key = none\n"


def environment(folder: Path) -> dict[str, str]:
    """The environment in which SkyPilot, and so fogspec, is this account's."""
    kept = {name: value for name, value in engine.environment(folder).items() if not name.startswith("AWS_")}
    path = f"{Path(sys.executable).parent}:{kept['PATH']}"  # SkyPilot runs `aws`
    return kept | {"PATH": path, "AWS_ENDPOINT_URL": ENDPOINT, "AWS_EC2_METADATA_DISABLED": "true"}


def configure(folder: Path) -> None:
    """The user's keys, and the price list that SkyPilot would fetch."""
    home = folder / "sky"
    (home / ".aws").mkdir(parents=True)
    (home / ".aws" / "credentials").write_text(KEYS)
    (home / ".aws" / "config").write_text(f"[default]\nregion = {shapes.REGION}\n")
    (home / ".sky").mkdir()
    (home / ".sky" / "user_hash").write_text(f"{zlib.crc32(str(folder).encode()):08x}")
    (home / ".sky" / "config.yaml").write_text("allowed_clouds: [aws]\n")
    shapes.write(home / ".sky" / "catalogs" / "v8")


def clusters(folder: Path, refresh: bool = False) -> list[str]:
    """Names of the clusters that SkyPilot has, as it believes, or as AWS says."""
    return engine.known(environment(folder), refresh)


def client(service: str = "ec2") -> Any:
    """The API, as the account's owner sees it."""
    keys = {"aws_access_key_id": "AKIAOFTHEOWNER", "aws_secret_access_key": "none"}
    return boto3.client(service, region_name=shapes.REGION, endpoint_url=ENDPOINT, **keys)


def furnish() -> None:
    """What an account has: a way out of its default network, and what SkyPilot's first launch leaves."""
    ec2, iam = client(), client("iam")
    vpc = ec2.describe_vpcs()["Vpcs"][0]["VpcId"]
    gateway = ec2.create_internet_gateway()["InternetGateway"]["InternetGatewayId"]
    ec2.attach_internet_gateway(InternetGatewayId=gateway, VpcId=vpc)
    tables = ec2.describe_route_tables(Filters=[{"Name": "vpc-id", "Values": [vpc]}])["RouteTables"]
    ec2.create_route(RouteTableId=tables[0]["RouteTableId"], DestinationCidrBlock="0.0.0.0/0", GatewayId=gateway)
    iam.create_instance_profile(InstanceProfileName=PROFILE)
    iam.create_role(RoleName=PROFILE, AssumeRolePolicyDocument=json.dumps({"Version": "2012-10-17", "Statement": []}))
    iam.add_role_to_instance_profile(InstanceProfileName=PROFILE, RoleName=PROFILE)


def ask(path: str, **said: Any) -> Any:
    """Tell the cloud what is to go wrong, or ask what did."""
    request = urllib.request.Request(ENDPOINT + path, data=json.dumps(said).encode())
    with urllib.request.urlopen(request, timeout=600) as answer:
        return json.load(answer)
