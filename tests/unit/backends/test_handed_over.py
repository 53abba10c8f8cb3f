"""What a rented machine gets besides its task, told before it is paid."""

import json
from pathlib import Path

import pytest

from fogspec.backends.skypilot.handed_over import handed_over

PERSON = {"type": "authorized_user", "refresh_token": "not-a-real-one"}
LOGIN = ".config/gcloud/application_default_credentials.json"


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name in ("SKYPILOT_GLOBAL_CONFIG", "GOOGLE_APPLICATION_CREDENTIALS", "CLOUDSDK_CONFIG"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    return tmp_path


def write(path: Path, content: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


@pytest.mark.parametrize(
    ("places", "clouds"),
    [
        (["aws/us-east-1", "aws/us-west-2"], "aws"),
        (["vast", "runpod", "kubernetes/lab", "slurm", "local"], "runpod or vast"),
        (["kubernetes/lab", "slurm", "ssh/desk", "local"], None),
        ([], None),
    ],
)
def test_a_rented_machine_gets_what_ends_it(places: list[str], clouds: str | None) -> None:
    said = list(handed_over(places))
    assert len(said) == (clouds is not None)
    assert clouds is None or said[0].startswith(
        f"each machine gets your credentials for {clouds}, with which it ends itself: "
    )


@pytest.mark.parametrize(
    ("config", "copied"),
    [
        ("aws: {remote_identity: SERVICE_ACCOUNT}\n", False),
        ("aws:\n  remote_identity: my-role\n", False),
        ("aws: {remote_identity: [{'fogspec-*': my-role}]}\n", False),
        ("aws: {remote_identity: LOCAL_CREDENTIALS}\n", True),
        ("gcp: {remote_identity: SERVICE_ACCOUNT}\n", True),
        ("aws: [\n", True),
        ("- aws\n", True),
        ("", True),
        ("aws: null\n", True),
    ],
)
@pytest.mark.parametrize("named", [True, False])
def test_a_role_takes_their_place(
    home: Path, monkeypatch: pytest.MonkeyPatch, config: str, copied: bool, named: bool
) -> None:
    path = write(home / "mine.yaml" if named else home / ".sky" / "config.yaml", config)
    if named:
        monkeypatch.setenv("SKYPILOT_GLOBAL_CONFIG", str(path))
    assert len(list(handed_over(["aws"]))) == copied


@pytest.mark.parametrize(
    ("login", "expires"), [(PERSON, True), ({"type": "service_account"}, False), ("{", False), ([], False)]
)
def test_a_persons_login_to_google_may_expire_before_the_machine_ends(home: Path, login: object, expires: bool) -> None:
    path = write(home / LOGIN, login)
    said = list(handed_over(["gcp/us-central1"]))
    assert len(said) == 1 + expires
    if expires:
        assert said[1].startswith(
            f"{path} is a person's login: where it expires, SkyPilot's autostop cannot end a machine on gcp"
        )
        assert not any("not-a-real-one" in line for line in said)
        assert len(list(handed_over(["aws"]))) == 1
        write(home / ".sky" / "config.yaml", "gcp: {remote_identity: SERVICE_ACCOUNT}\n")
        assert list(handed_over(["gcp"])) == []


def test_the_login_is_where_googles_libraries_look(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    elsewhere = write(home / "elsewhere" / "application_default_credentials.json", PERSON)
    assert len(list(handed_over(["gcp"]))) == 1
    monkeypatch.setenv("CLOUDSDK_CONFIG", str(elsewhere.parent))
    assert str(elsewhere) in list(handed_over(["gcp"]))[1]
    robot = write(home / "robot.json", {"type": "service_account"})
    monkeypatch.setenv("GOOGLE_APPLICATION_CREDENTIALS", str(robot))
    assert len(list(handed_over(["gcp"]))) == 1
