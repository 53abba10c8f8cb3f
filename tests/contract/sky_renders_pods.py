"""The pod that SkyPilot would send for each task: `python sky_renders_pods.py TASK...` prints one line of JSON a task.

SkyPilot is not modified: the cluster that it asks is a server on loopback with one node, which keeps what it is sent.
"""

import http.server
import json
import os
import pathlib
import sys
import threading
from typing import Any

NODE: dict[str, Any] = {
    "metadata": {
        "name": "node-1",
        "labels": {"kubernetes.io/hostname": "node-1", "nvidia.com/gpu.product": "Tesla-T4"},
    },
    "spec": {},
    "status": {
        "allocatable": {"cpu": "63", "memory": "250Gi", "pods": "110", "nvidia.com/gpu": "1"},
        "capacity": {"cpu": "64", "memory": "256Gi", "pods": "110", "nvidia.com/gpu": "1"},
        "conditions": [{"type": "Ready", "status": "True"}],
        "nodeInfo": {"architecture": "amd64", "operatingSystem": "linux"},
    },
}
CHANGED: list[str] = []


class Api(http.server.BaseHTTPRequestHandler):
    """What SkyPilot asks of a cluster before it sends a pod: nodes, pods, and whether it may."""

    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        path = self.path.partition("?")[0]
        if path == "/version":
            return self.answer({"major": "1", "minor": "31", "gitVersion": "v1.31.0", "platform": "linux/amd64"})
        if path == "/api/v1/nodes":
            return self.answer({"kind": "NodeList", "apiVersion": "v1", "metadata": {}, "items": [NODE]})
        if path.startswith("/api/v1/namespaces/") and path.count("/") == 4:
            return self.answer({"kind": "Namespace", "apiVersion": "v1", "metadata": {"name": path.split("/")[4]}})
        return self.answer({"kind": "List", "apiVersion": "v1", "metadata": {}, "items": []})

    def do_POST(self) -> None:
        length = int(self.headers.get("Content-Length", 0))
        body = json.loads(self.rfile.read(length) or b"{}")
        if "authorization.k8s.io" in self.path:
            return self.answer({**body, "status": {"allowed": True}}, 201)
        CHANGED.append(self.path)
        return self.answer({"kind": "Status", "code": 403, "reason": "Forbidden", "message": "only looked at"}, 403)

    do_PATCH = do_PUT = do_DELETE = do_POST

    def answer(self, body: object, code: int = 200) -> None:
        """Answer with JSON."""
        content = json.dumps(body).encode()
        self.send_response(code)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, *_words: object) -> None:
        """Say nothing."""


server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Api)
threading.Thread(target=server.serve_forever, daemon=True).start()
config = pathlib.Path.home() / ".kube" / "config"
config.parent.mkdir(parents=True, exist_ok=True)
config.write_text(json.dumps({
    "apiVersion": "v1", "kind": "Config", "current-context": "lab",
    "clusters": [{"name": "lab", "cluster": {"server": f"http://127.0.0.1:{server.server_port}"}}],
    "contexts": [{"name": "lab", "context": {"cluster": "lab", "user": "me", "namespace": "robots"}}],
    "users": [{"name": "me", "user": {"token": "t"}}],
}))  # fmt: skip
os.environ["KUBECONFIG"] = str(config)

import sky  # noqa: E402
from sky import clouds  # noqa: E402
from sky.backends import backend_utils  # noqa: E402
from sky.utils import yaml_utils  # noqa: E402

for path in sys.argv[1:]:
    task = sky.Task.from_yaml(path)
    (wanted,) = task.resources
    found = wanted.cloud.get_feasible_launchable_resources(wanted, 1).resources_list
    (one,) = found
    written = backend_utils.write_cluster_config(
        one,
        1,
        "kubernetes-ray.yml.j2",
        "fogspec-demo-one",
        pathlib.Path("wheel"),
        "hash",
        clouds.Region("lab"),
        dryrun=True,
    )
    rendered = yaml_utils.read_yaml(written["ray"])
    (node_type,) = rendered["available_node_types"].values()
    print(
        json.dumps(
            {
                "path": path,
                "pod": node_type["node_config"],
                "provider": rendered["provider"],
                "changed": CHANGED,
                "infras": clouds.Kubernetes.expand_infras(),
            }
        )
    )
