"""A private registry beside the account, and container images in it as a robotics team has them: Debian with ROS 2.

The registry is Debian's, with TLS and a password. An image has two layers: Debian packages, which `make image-root` unpacked,
and the ROS 2 of `make ros-env`. A machine has podman under docker's name, so that SkyPilot's own code logs in, pulls the
image and starts the container; the machine knows the registry's certificate, and not the password.
"""

import base64
import hashlib
import json
import shutil
import ssl
import subprocess
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from tests.support.registries import HTPASSWD, PASSWORD, USER
from tests.tools import network
from tests.tools.slurm import nodes, ros

ROOT = Path(__file__).resolve().parents[3] / "build" / "image" / "root.tar"
PROGRAMS = ("podman", "crun", "docker-registry", "openssl")
PORT = 5443
REGISTRY = f"{network.CONTROLLER}:{PORT}"
OCI = "application/vnd.oci.image"  # the OCI Image Format Specification 1.1, in media types and fields
PATH = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
# Of the packages in ROS 2's environment, what only case studies compute with and what only builds: half of its size.
UNUSED = ("cv2", "opencv*", "onnx*", "ompl*", "pip", "Cython", "colcon*", "zenoh", "*.pyc")


def missing() -> str | None:
    """What stands in the way here, and the one command that helps; None where nothing does."""
    if absent := [name for name in PROGRAMS if shutil.which(name) is None]:
        return f"needs {', '.join(absent)}: apt-get install --no-install-recommends {' '.join(PROGRAMS)}"
    if not ROOT.exists():
        return "needs the root of an image: make image-root"
    if not ros.WHEELS.exists():
        return "needs ROS 2: make ros-env"
    return None


@dataclass
class Images:
    """The registry, and the images in it; `account` is the account's folder."""

    account: Path
    name: str = f"{REGISTRY}/team/nodes"

    @contextmanager
    def served(self) -> Iterator[None]:
        """Run the registry; machines that boot meanwhile can start containers and know its certificate."""
        self.folder.mkdir()
        run("openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes", "-days", "2",
            "-subj", "/CN=registry", "-addext", f"subjectAltName=IP:{network.CONTROLLER}",
            "-keyout", str(self.folder / "key.pem"), "-out", str(self.certificate))  # fmt: skip
        (self.folder / "htpasswd").write_text(HTPASSWD)
        (self.folder / "config.yml").write_text(
            f"version: 0.1\nlog: {{level: error}}\nstorage: {{filesystem: {{rootdirectory: {self.folder}/images}}}}\n"
            f"auth: {{htpasswd: {{realm: here, path: {self.folder}/htpasswd}}}}\n"
            f"http: {{addr: '{REGISTRY}', tls: {{certificate: {self.certificate}, key: {self.folder}/key.pem}}}}\n"
        )
        from tests.tools.aws.cloud import until  # with moto, which takes a second that only this needs

        told = self.account / "registry.json"
        with open(self.folder / "log", "wb") as log:
            server = subprocess.Popen(
                ["docker-registry", "serve", str(self.folder / "config.yml")], stdout=log, stderr=log
            )
        try:
            until(self._answers)
            told.write_text(json.dumps({"name": REGISTRY, "certificate": self.certificate.read_text()}))
            yield
        finally:
            told.unlink(missing_ok=True)
            server.terminate()
            server.wait()

    @property
    def folder(self) -> Path:
        """Its own."""
        return self.account / "registry"

    @property
    def certificate(self) -> Path:
        """Of the registry; it signed itself."""
        return self.folder / "registry.pem"

    def log_in(self, folder: Path) -> None:
        """Write what `docker login` leaves in docker's folder."""
        folder.mkdir()
        (folder / "config.json").write_text(json.dumps({"auths": {REGISTRY: {"auth": _packed()}}}))

    def push(self, version: str) -> str:
        """Push an image as tag `latest`, whose variable TEAM_IMAGE is `version`; return its digest."""
        inside = {"Env": [f"PATH={PATH}", f"TEAM_IMAGE={version}"], "Cmd": ["/bin/bash"]}
        config = {
            "architecture": "amd64",
            "os": "linux",
            "config": inside,
            "rootfs": {"type": "layers", "diff_ids": [one["digest"] for one in self.layers]},
        }
        path = self.folder / f"config-{version}.json"
        path.write_text(json.dumps(config))
        described = self._blob(path, "config.v1+json")
        manifest = {
            "schemaVersion": 2,
            "mediaType": f"{OCI}.manifest.v1+json",
            "config": described,
            "layers": self.layers,
        }
        body = json.dumps(manifest).encode()
        self._send("PUT", f"/v2/{self._repository}/manifests/latest", body, manifest["mediaType"])
        return f"sha256:{hashlib.sha256(body).hexdigest()}"

    @cached_property
    def layers(self) -> list[dict[str, Any]]:
        """Both layers, which the registry has."""
        tree, packed = self.folder / "opt", self.folder / "ros.tar"
        tree.mkdir()
        assert ros.prepare(tree, nodes.PYTHON)
        run("tar", "-C", str(self.folder), *(f"--exclude={one}" for one in UNUSED), "-cf", str(packed), "opt")
        shutil.rmtree(tree)
        found = [self._blob(path, "layer.v1.tar") for path in (ROOT, packed)]
        packed.unlink()
        return found

    @property
    def _repository(self) -> str:
        return self.name.partition("/")[2]

    def _blob(self, path: Path, kind: str) -> dict[str, Any]:
        """Upload a file; return what a manifest says of it."""
        with open(path, "rb") as file:
            digest = f"sha256:{hashlib.file_digest(file, 'sha256').hexdigest()}"
            file.seek(0)
            where = self._send("POST", f"/v2/{self._repository}/blobs/uploads/")
            self._send("PUT", f"{where}&digest={digest}", file, length=path.stat().st_size)
        return {"mediaType": f"{OCI}.{kind}", "digest": digest, "size": path.stat().st_size}

    def _send(
        self, method: str, url: str, body: Any = b"", kind: str = "application/octet-stream", length: int = 0
    ) -> str:
        headers = {
            "Content-Type": kind,
            "Authorization": f"Basic {_packed()}",
            "Content-Length": str(length or len(body)),
        }
        url = url if url.startswith("https:") else f"https://{REGISTRY}{url}"
        request = urllib.request.Request(url, data=body, method=method, headers=headers)
        trusted = ssl.create_default_context(cafile=str(self.certificate))
        with urllib.request.urlopen(request, timeout=600, context=trusted) as answer:
            return str(answer.headers.get("Location", ""))

    def _answers(self) -> bool:
        try:
            self._send("GET", "/v2/")
        except OSError:
            return False
        return True


def _packed() -> str:
    return base64.b64encode(f"{USER}:{PASSWORD}".encode()).decode()


def run(*words: str) -> None:
    """A command that must succeed."""
    subprocess.run(words, check=True)
