"""Resolves an image's tag to its digest, and tells what it is, by the registry's own protocol: manifests, never layers.

Sources: OCI Distribution Specification 1.1, "Pulling manifests"; distribution.github.io/distribution, "Token
authentication". A registry on this host's loopback is queried by plain HTTP, as docker does; all others by HTTPS. Credentials
go to the registry and to the token server that it names, never along a redirection to another host, port or protocol.
"""

import base64
import hashlib
import ipaddress
import json
import math
import os
import queue
import re
import threading
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from email.message import Message
from functools import partial
from http.client import HTTPException, HTTPMessage
from typing import Any, TypeVar

from fogspec.backends.images.credentials import Credentials, credentials, credentials_of_machines
from fogspec.base.errors import CloudError, InvalidInput
from fogspec.base.text import visible
from fogspec.base.units import format_duration
from fogspec.language.lockfile import DOCKER_HUB, REGISTRY_LOGIN, Image, ImageUse, image_of

ACCEPT = ", ".join((
    "application/vnd.oci.image.index.v1+json", "application/vnd.docker.distribution.manifest.list.v2+json",
    "application/vnd.oci.image.manifest.v1+json", "application/vnd.docker.distribution.manifest.v2+json",
))  # fmt: skip
TIMEOUT_S = 20.0  # without a byte
DEADLINE_S = 60.0  # for a whole answer: one byte now and then is no answer
MAX_BYTES = 4 << 20  # of a manifest: the specification's limit
LONGEST_CHALLENGE = 4096
# Assumed: a slow provider's network, one core that unpacks, and a disk of 218 MB/s that holds several times as much.
PULL_S_PER_GIB = 90.0
GIB = 2**30
# OCI Image Specification, "Image Index" and "Image Configuration": GOARCH's names.
ARCHITECTURES = {"x86_64": "amd64", "arm64": "arm64"}
ROOT = ("", "0", "root")
MOST_LAYER_BYTES = 2**50  # a larger size is none
BLOB = re.compile(r"sha256:[0-9a-f]{64}")
PARAMETER = re.compile(r'(\w+)="([^"]*)"')

Answer = tuple[HTTPMessage, bytes]
ResultT = TypeVar("ResultT")


class NotShown(InvalidInput):
    """The registry requires another login than this computer's, if any; a machine may have one."""


class Registry:
    """A client of image registries, with docker's credentials or a machine's."""

    def digest(self, name: str) -> str:
        """Return `sha256:...` of the manifest, or the index of manifests by platform, that a tag names now.

        Raise InvalidInput for an invalid name or one that the registry does not have or not show,
        CloudError if the registry does not answer.
        """
        return _asked(name, partial(_digest, name))

    def check(self, name: str, use: ImageUse) -> None:
        """Raise InvalidInput if the registry does not have the image, or it is not one that these machines can start in time.

        What it does not say of its CPU, size and user passes. If the machines have a login, it is used as they will use it:
        raise InvalidInput if it is not accepted. Raise NotShown if the registry requires a login and there is none, CloudError
        if it does not answer.
        """
        login = credentials_of_machines(use.secrets, name)
        try:
            builds = _asked(name, partial(_builds, use=use, login=login))
        except NotShown:
            if login is None:
                raise
            registry, (user, password, _) = image_of(name).registry, REGISTRY_LOGIN
            raise InvalidInput(
                f"{name}: the registry {registry} does not show it to the user that {user} and {password} log in",
                f"export the values with which this works: docker login {registry}",
            ) from None
        has = {one.architecture for one in builds if one.architecture}
        if missing := [one for one in use.architectures if has and ARCHITECTURES[one] not in has]:
            raise InvalidInput(
                f"{name}: is for {', '.join(sorted(has))}, and spec.hardware.arch has {', '.join(missing)}",
                f"build and push it for linux/{ARCHITECTURES[missing[0]]}, or change spec.hardware.arch",
            )
        for one in builds:
            _check_user(name, one.user, use)
        _check_time(name, max((one.compressed_bytes for one in builds), default=0), use)


def _check_user(name: str, user: str, use: ImageUse) -> None:
    variable = use.user_variable
    if (
        variable is None
        or user.partition(":")[0] in ROOT
        or (variable in use.secrets and os.environ.get(variable) == user)
    ):
        return
    raise InvalidInput(
        f"{name}: its USER is {visible(user)}, and SkyPilot logs in as root where machines are containers",
        "build it with USER root as its last one",
        f"or add {variable} to spec.secrets, and export it with that name",
    )


def _check_time(name: str, compressed_bytes: int, use: ImageUse) -> None:
    pull_s = compressed_bytes / GIB * PULL_S_PER_GIB
    if pull_s <= use.timeout_s:
        return
    longer = format_duration(math.ceil((use.timeout_s + pull_s) / 60) * 60)
    size, limit = f"{compressed_bytes / GIB:.1f} GiB (compressed)", f"{use.timeout} is {format_duration(use.timeout_s)}"
    takes = f"may take {format_duration(math.ceil(pull_s / 60) * 60)} at {PULL_S_PER_GIB:g} s per GiB, which is assumed"
    raise InvalidInput(
        f"{name}: to pull its {size} {takes}; {limit}",
        f"set {use.timeout}: {longer}, and compile again; or make the image smaller",
    )


def _asked(name: str, ask: Callable[[Image], ResultT]) -> ResultT:
    """Return what the registry of an image answers; raise as `Registry.digest`."""
    try:
        image = image_of(name)
    except ValueError as wrong:
        raise InvalidInput(str(wrong)) from None
    try:
        return _in_time(partial(ask, image))
    except urllib.error.HTTPError as refused:
        raise _refused(name, image, refused) from None
    except (OSError, HTTPException, ValueError) as problem:
        reason = getattr(problem, "reason", None) or problem
        raise CloudError(f"{name}: the registry {image.registry} cannot be asked: {reason}") from None


def _in_time(work: Callable[[], ResultT]) -> ResultT:
    """Return the result of `work`; raise TimeoutError after `DEADLINE_S`, and leave it to its thread, which ends with us."""
    ended: queue.SimpleQueue[ResultT | Exception] = queue.SimpleQueue()

    def run() -> None:
        try:
            ended.put(work())
        except Exception as problem:
            ended.put(problem)

    threading.Thread(target=run, daemon=True).start()
    try:
        result = ended.get(timeout=DEADLINE_S)
    except queue.Empty:
        raise TimeoutError(f"it took longer than {DEADLINE_S:g} s to answer") from None
    if isinstance(result, Exception):
        raise result
    return result


@dataclass(frozen=True, slots=True)
class Build:
    """An image for one CPU (GOARCH's name, None if it is not said): what is pulled, in bytes, and as whom it runs."""

    architecture: str | None
    compressed_bytes: int = 0
    user: str = ""


def _builds(image: Image, use: ImageUse, login: Credentials | None = None) -> list[Build]:
    """Return a Linux image's builds; of those for other CPUs than its machines' the CPU alone."""
    manifest = _mapping(_fetch(image, f"manifests/{image.digest or image.tag}", login)[1])
    listed = manifest.get("manifests")
    if not isinstance(listed, list):
        return [_build(image, manifest, login)]
    found = []
    for one in filter(_is_linux, listed):
        cpu, digest = _architecture(one["platform"]), str(one.get("digest"))
        if cpu in [ARCHITECTURES[arch] for arch in use.architectures] and BLOB.fullmatch(digest):
            found.append(_build(image, _mapping(_fetch(image, f"manifests/{digest}", login)[1]), login, cpu))
        else:
            found.append(Build(cpu))
    return found


def _is_linux(listed: object) -> bool:
    platform = listed.get("platform") if isinstance(listed, dict) else None
    return isinstance(platform, dict) and platform.get("os", "linux") == "linux"


def _build(image: Image, manifest: Mapping[str, Any], login: Credentials | None, cpu: str | None = None) -> Build:
    """Return what a manifest and its configuration say; `cpu` is the one that the index gave."""
    layers, config = manifest.get("layers"), manifest.get("config")
    sizes = [one.get("size") for one in layers if isinstance(one, dict)] if isinstance(layers, list) else []
    compressed_bytes = sum(size for size in sizes if isinstance(size, int) and 0 < size < MOST_LAYER_BYTES)
    digest = str(config.get("digest")) if isinstance(config, dict) else ""
    if not BLOB.fullmatch(digest):
        return Build(cpu, compressed_bytes)
    values = _mapping(_fetch(image, f"blobs/{digest}", login)[1])
    runs = values.get("config")
    user = runs.get("User") if isinstance(runs, dict) else None
    return Build(
        cpu or (_architecture(values) if values.get("os", "linux") == "linux" else None),
        compressed_bytes,
        user if isinstance(user, str) else "",
    )


def _architecture(said: Mapping[str, Any]) -> str | None:
    one = said.get("architecture")
    return one if isinstance(one, str) and re.fullmatch(r"[a-z0-9]{1,20}", one) else None


def _mapping(content: bytes) -> Mapping[str, Any]:
    value = json.loads(content)
    return value if isinstance(value, dict) else {}


def _fetch(image: Image, what: str, login: Credentials | None = None) -> Answer:
    """Return a manifest or a configuration, with this login or docker's if the registry requires one."""
    url, headers = f"{_address(image.registry)}/v2/{image.repository}/{what}", {"Accept": ACCEPT}
    try:
        return _get(url, headers)
    except urllib.error.HTTPError as refused:
        if refused.code != 401:
            raise
        return _get(url, headers | _authorization(image, refused.headers, login))


def _digest(name: str, image: Image) -> str:
    said, body = _fetch(image, f"manifests/{image.digest or image.tag}")
    found = f"sha256:{hashlib.sha256(body).hexdigest()}"
    told = said.get("Docker-Content-Digest", found)
    if told != found:
        raise CloudError(f"{name}: the registry says {told}, and what it sent has {found}")
    return found


def _address(registry: str) -> str:
    if registry == DOCKER_HUB:
        return "https://registry-1.docker.io"
    return f"{'http' if _is_loopback(registry) else 'https'}://{registry}"


def _is_loopback(registry: str) -> bool:
    host = registry.rpartition(":")[0] or registry
    try:
        return host == "localhost" or ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def _authorization(image: Image, said: Message, login: Credentials | None) -> dict[str, str]:
    """Return the header that answers the registry's challenge."""
    challenge = said.get("WWW-Authenticate", "")[:LONGEST_CHALLENGE]
    kind, known = challenge.partition(" ")[0].lower(), login or credentials(image.registry)
    if kind == "basic" and known is not None and known.name is not None:
        return _basic(known)
    if kind != "bearer":
        return {}
    asked = dict(PARAMETER.findall(challenge))
    realm = asked.pop("realm", "")
    secure = realm.startswith("https://")
    if not secure and not (realm.startswith("http://") and _is_loopback(urllib.parse.urlsplit(realm).netloc)):
        raise ValueError(f"it sends credentials to {realm or 'nowhere'}, which is not https")
    asked["scope"] = f"repository:{image.repository}:pull"
    if known is not None and known.name is None:
        form = asked | {"grant_type": "refresh_token", "refresh_token": known.secret, "client_id": "fogspec"}
        _, body = _get(realm, {}, urllib.parse.urlencode(form).encode())
    else:
        _, body = _get(f"{realm}?{urllib.parse.urlencode(asked)}", _basic(known) if known else {})
    answer = json.loads(body)
    token = (answer.get("token") or answer.get("access_token")) if isinstance(answer, dict) else None
    if not isinstance(token, str):
        raise ValueError("its token server sent no token")
    return {"Authorization": f"Bearer {token}"}


def _basic(known: Credentials) -> dict[str, str]:
    packed = base64.b64encode(f"{known.name}:{known.secret}".encode()).decode()
    return {"Authorization": f"Basic {packed}"}


class _NoCredentialsElsewhere(urllib.request.HTTPRedirectHandler):
    """Follows redirections by the same protocol or to HTTPS, and sends credentials to the same host and port only."""

    def redirect_request(
        self, req: urllib.request.Request, fp: object, code: int, msg: str, headers: HTTPMessage, newurl: str
    ) -> urllib.request.Request | None:
        before, after = urllib.parse.urlsplit(req.full_url), urllib.parse.urlsplit(newurl)
        local = before.scheme == after.scheme == "http" and _is_loopback(after.netloc)
        if after.scheme != "https" and not local:
            raise ValueError(f"it redirects to {newurl[:200]}, which is not https")
        if req.data is not None:
            raise ValueError("its token server redirects what holds a secret")
        again = super().redirect_request(req, fp, code, msg, headers, newurl)  # type: ignore[arg-type]
        if again is not None and (before.scheme, before.netloc) != (after.scheme, after.netloc):
            again.headers.pop("Authorization", None)
        return again


def _get(url: str, headers: Mapping[str, str], form: bytes | None = None) -> Answer:
    request = urllib.request.Request(url, data=form, headers={"User-Agent": "fogspec", **headers})  # noqa: S310
    with urllib.request.build_opener(_NoCredentialsElsewhere).open(request, timeout=TIMEOUT_S) as answer:
        body: bytes = answer.read(MAX_BYTES + 1)
        if len(body) > MAX_BYTES:
            raise ValueError("its answer is longer than a manifest may be")
        return answer.headers, body


def _refused(name: str, image: Image, refused: urllib.error.HTTPError) -> InvalidInput | CloudError:
    if refused.code == 404:
        return InvalidInput(f"{name}: the registry {image.registry} has no such image")
    if refused.code in (401, 403):
        return NotShown(f"{name}: the registry {image.registry} does not show it", f"docker login {image.registry}")
    wait = " for now: too many requests" if refused.code == 429 else ""
    return CloudError(f"{name}: the registry {image.registry} refuses{wait} (HTTP {refused.code})")
