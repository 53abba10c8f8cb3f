"""Credentials that are planted in a spec are refused; what ordinary specs have is not. None of these was ever valid."""

import random
import string
import time

import pytest

from fogspec.base.credentials import kind_of
from tests.support.running import Shell, shell, spec  # noqa: F401

CHANCE = random.Random(7)
LETTERS = string.ascii_letters + string.digits


def some(count: int, alphabet: str = LETTERS) -> str:
    """Return random characters, with a digit, a small and a large letter."""
    return ("a1B" + "".join(CHANCE.choices(alphabet, k=count)))[:count]


def hexadecimal(count: int) -> str:
    return "a1" + "".join(CHANCE.choices("0123456789abcdef", k=count - 2))


# In pieces, so that no scanner takes this file for a leak.
PLANTED = {
    "pem": "-----BEGIN " + "OPENSSH PRIVATE KEY-----\n" + some(60),
    "age": "AGE-SECRET-" + "KEY-1" + some(58, string.ascii_uppercase + string.digits).upper(),
    "google account": '{"type": "service_account", "private_' + f'key_id": "{hexadecimal(40)}"}}',
    "google api": "AIza" + some(35),
    "aws id": "AKIA" + some(16, string.ascii_uppercase).upper().replace("1", "7"),
    "azure storage": "DefaultEndpointsProtocol=https;AccountName=x;Account" + f"Key={some(86)}==",
    "azure sas": f"https://x.blob.core.windows.net/c?sv=2024&sig={some(44)}%3D",
    "azure client": f"{some(3)}8" + f"Q~{some(34)}",
    "github": "ghp_" + some(36),
    "github fine": "github_" + f"pat_{some(22)}_{some(59)}",
    "gitlab": "glpat-" + some(20),
    "slack": "xoxb-" + "123456789012-" + some(24),
    "slack hook": "https://hooks.slack.com/" + f"services/T{some(8)}/B{some(8)}/{some(24)}",
    "openai": "sk-" + some(48),
    "openai project": "sk-" + f"proj-{some(48)}",
    "anthropic": "sk-" + f"ant-api03-{some(90)}",
    "hugging face": "hf_" + some(34),
    "stripe": "sk_" + f"live_{some(24)}",
    "npm": "npm_" + some(36),
    "pypi": "pypi-" + f"AgEIcHlwaS5vcmc{some(60)}",
    "docker": "dckr_" + f"pat_{some(27)}",
    "vault": "hvs." + some(90),
    "telegram": "1234567890:" + f"AA{some(33)}",
    "jwt": "eyJ" + f"{some(30)}.eyJ{some(80)}.{some(43)}",
    "database": "postgresql://robot:" + f"{some(12)}@db.example.org:5432/maps",
    "url": "https://me:" + f"{some(20)}@github.com/me/maps.git",
    "header": f"Authorization: Bearer {some(40)}",
    "option": f"--api-key={some(32)}",
    "sentence": f"connect with token: {some(32)} please",
    "wireguard": f"PrivateKey = {some(43)}=",
}
NAMED = {
    "OPENAI_KEY": some(32),
    "MAP_TOKEN": hexadecimal(40),
    "db-password": "hunter2!",
    "clientSecret": some(24),
    "GITHUB_PAT": some(40),
    "aws_secret_access_key": some(40),
    "WANDB_API_KEY": hexadecimal(40),
    "passphrase": "correct horse battery",
    "preshared_key": f"{some(43)}=",
    "HEROKU_TOKEN": "5d8a1c0e-93b7-4f0d-9c35-0f2f9a6be7d1",
}
ORDINARY = {
    "digest": f"sha256:{hexadecimal(64)}",
    "image": f"ghcr.io/me/robot-nodes:v1.2.3@sha256:{hexadecimal(64)}",
    "commit": hexadecimal(40),
    "id": "5d8a1c0e-93b7-4f0d-9c35-0f2f9a6be7d1",
    "MAX_TOKENS": "4096",
    "TOKENIZERS_PARALLELISM": "false",
    "token": "$MAP_TOKEN",
    "password": "${PASSWORD}",
    "token_file": "/run/secrets/token",
    "AWS_WEB_IDENTITY_TOKEN_FILE": "/var/run/token-12345678",
    "url": "https://github.com/me/maps.git",
    "uri": "ssh://git@github.com:22/me/maps.git",
    "dsn": "postgresql://robot@db/maps",
    "topic": "/gqcnn/image_compressed",
    "model": "weights/yolo_v8n_2024_01_15.pt",
    "name": "sk-learn-grasp-planner-v2-final",
    "public_key": f"{some(43)}=",
    "map_key": "office-2",
    "api_key": "<your key>",
    "secret": "changeme",
    "remapping": "secret:=/topic",
    "proxy": "http://proxy.example.org:3128",
    "note": "the token of a request names its kind; key: value",
    "hf": "hf_transfer",
    "endpoint": "tcp/10.0.0.1:7447",
    "placeholder": "postgresql://robot:$PASSWORD@db/maps",
    "frame_id": "base_link_0123456789abcdef",
}


@pytest.mark.parametrize("name", PLANTED)
def test_a_form_is_recognized_wherever_it_stands(name: str) -> None:
    assert kind_of(PLANTED[name]), PLANTED[name]
    assert kind_of(f"--option {PLANTED[name]} more", "arguments")


@pytest.mark.parametrize("name", NAMED)
def test_a_random_value_under_the_name_of_a_secret(name: str) -> None:
    assert kind_of(NAMED[name], name), NAMED[name]
    assert kind_of(NAMED[name], "note") is None


@pytest.mark.parametrize("name", ORDINARY)
def test_an_ordinary_value_is_none(name: str) -> None:
    assert kind_of(ORDINARY[name], name) is None


@pytest.mark.parametrize("piece", ["eyJ-", "a", "a:", "://:", "sk-", "token=", '"private_key" ', "Authorization: "])
def test_long_texts_take_no_longer_than_they_are(piece: str) -> None:
    def took(count: int) -> float:
        text = piece * count
        began = time.process_time()
        kind_of(text)
        return time.process_time() - began

    took(1)
    assert took(2**13) < 64 * took(2**10) + 0.05, "eight times the text, and far from its square"
    assert took(2**20) < 64 * took(2**13) + 0.05, "no more than its beginning"


def test_nothing_of_a_planted_credential_is_shown(shell: Shell) -> None:
    secret = NAMED["MAP_TOKEN"]
    for line in (
        f"[{{cmd: [python3, work.py, --token, {secret}]}}]",
        f"[{{cmd: [work], env: {{MAP_TOKEN: {secret}}}}}]",
    ):
        shell.write("specs/demo.yaml", spec(cloud=line))
        said = shell("validate", "specs/demo.yaml", code=1)
        assert "FS509" in said.out + said.err
        assert secret not in said.out + said.err
