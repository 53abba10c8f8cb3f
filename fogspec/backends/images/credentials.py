"""Docker's credentials, read from its configuration file and its credential helpers; those of machines, from the environment.

Nothing is ever written.

Source: docs.docker.com/reference/cli/docker/login ("Credential stores", "Credential helper protocol").
"""

import base64
import json
import os
import subprocess
from collections.abc import Container
from pathlib import Path
from typing import Any, NamedTuple

from fogspec.base import child
from fogspec.base.errors import InvalidInput
from fogspec.language.lockfile import REGISTRY_LOGIN, image_of

DOCKER_HUB_KEYS = ("https://index.docker.io/v1/", "index.docker.io", "docker.io", "registry-1.docker.io")
HELPER_TIMEOUT_S = 30.0


class Credentials(NamedTuple):
    """A name with its password; or, if the name is None, an identity token."""

    name: str | None
    secret: str

    def __repr__(self) -> str:
        return "Credentials(...)"


def credentials(registry: str) -> Credentials | None:
    """Return docker's credentials for a registry, None without any; raise InvalidInput for a damaged configuration."""
    path = Path(os.environ.get("DOCKER_CONFIG") or Path.home() / ".docker") / "config.json"
    if not path.is_file():
        return None
    try:
        config = json.loads(path.read_text(encoding="utf-8"))
        helpers = config.get("credHelpers", {})
        for key in _keys(registry):
            helper = helpers.get(key) or config.get("credsStore")
            if helper and (found := _from_helper(str(helper), key)):
                return found
            if key in config.get("auths", {}) and (found := _from_entry(config["auths"][key])):
                return found
    except (OSError, ValueError, AttributeError, TypeError) as problem:
        raise InvalidInput(f"{path}: docker's configuration cannot be read: {type(problem).__name__}") from None
    return None


def credentials_of_machines(secrets: Container[str], name: str) -> Credentials | None:
    """Return the login with which machines pull an image if it is one of the spec's `secrets`, None otherwise.

    Raise InvalidInput if SkyPilot would pull the image from another registry: it puts the login's server before a name that
    does not begin with it.
    """
    user, password, server = (os.environ.get(one) if one in secrets else None for one in REGISTRY_LOGIN)
    if user is None or password is None or server is None:
        return None
    wanted = image_of(name)
    try:
        pulled = image_of(name if name.startswith(f"{server}/") else f"{server}/{name}")
    except ValueError:
        pulled = None
    if pulled is None or (pulled.registry, pulled.repository) != (wanted.registry, wanted.repository):
        message = f"{name}: its registry is {wanted.registry}, and {REGISTRY_LOGIN[2]} names another one"
        raise InvalidInput(message, f"export {REGISTRY_LOGIN[2]}={wanted.registry}")
    return Credentials(user, password)


def _keys(registry: str) -> tuple[str, ...]:
    return DOCKER_HUB_KEYS if registry in DOCKER_HUB_KEYS else (registry, f"https://{registry}", f"http://{registry}")


def _from_entry(entry: dict[str, Any]) -> Credentials | None:
    if token := entry.get("identitytoken"):
        return Credentials(None, str(token))
    if not (packed := entry.get("auth")):
        return None
    name, _, secret = base64.b64decode(packed).decode().rstrip("\0").partition(":")
    return Credentials(name, secret)


def _from_helper(helper: str, key: str) -> Credentials | None:
    """Return the answer of `docker-credential-HELPER get`; None if the helper is missing or has none."""
    if "/" in helper:
        return None
    try:
        done = subprocess.run(
            [child.program(f"docker-credential-{helper}"), "get"], input=key, capture_output=True, text=True,
            timeout=HELPER_TIMEOUT_S, check=True, cwd=child.ELSEWHERE, env=child.environment(),
        )  # fmt: skip
        said = json.loads(done.stdout)
    except (OSError, subprocess.SubprocessError, ValueError):
        return None
    name, secret = said.get("Username", ""), said.get("Secret", "")
    return Credentials(None if name == "<token>" else name, secret) if secret else None
