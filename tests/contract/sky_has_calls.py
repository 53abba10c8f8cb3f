"""Whether SkyPilot has the calls that fogspec makes, with the words it uses: `python sky_has_calls.py`, in any environment."""

import inspect
import json
from pathlib import Path

import sky
from sky import clouds, exceptions, global_user_state, provision, resources, skypilot_config
from sky.client import sdk
from sky.clouds import aws, azure, gcp
from sky.utils import registry

CALLS = (
    (sky.launch, ("task",), {"cluster_name": "c"}),
    (sky.get, ("request",), {}),
    (sky.stream_and_get, ("request",), {"follow": False, "output_stream": None}),
    (sky.api_info, (), {}),
    (sky.api_stop, (), {}),
    (sky.api_status, (), {"all_status": False}),
    (sky.api_status, (["request"],), {"all_status": True}),
    (sky.api_status, (), {"cluster_name": "c", "all_status": False}),
    (sky.api_cancel, (["request"],), {"silent": True}),
    (sky.queue, ("c",), {"all_users": True}),
    (sky.tail_logs, ("c", 1), {"follow": True, "preload_content": False}),
    (sky.status, (["c"],), {"refresh": sky.StatusRefreshMode.FORCE, "all_users": True}),
    (sdk.enabled_clouds, (), {}),
    (sdk.enabled_clouds, (), {"expand": True}),
    (sdk.check, (("aws",),), {"verbose": False}),
    (sky.down, ("c",), {}),
    (sky.autostop, ("c",), {"idle_minutes": 1, "down": True}),
    (sky.Task.from_yaml_config, ({"run": "true"},), {}),
    # Not of the public API: fogspec/backends/skypilot/internals.py.
    (global_user_state.get_cluster_yaml_dict, ("c.yml",), {}),
    (provision.query_instances, ("aws", "c", "c-1", {}), {"non_terminated_only": True}),
    (provision.terminate_instances, ("aws", "c-1", {}), {}),
    (skypilot_config.get_nested, (("aws", "post_provision_runcmd"),), {"default_value": None}),
    (skypilot_config.override_skypilot_config, ({"aws": {}},), {}),
)
for call, words, named in CALLS:
    inspect.signature(inspect.unwrap(call)).bind(*words, **named)
names = ("ClusterDoesNotExist", "ResourcesUnavailableError", "NoCloudAccessError", "ApiServerConnectionError",
         "ClusterSetUpError", "CommandError", "NetworkError", "RequestInterruptedError", "ServerTemporarilyUnavailableError",
         "ClusterStatusFetchingError", "FetchClusterInfoError", "SkyletUnavailableError", "ExecutionRetryableError",
         "ConcurrentWorkerExhaustedError", "ResourcesMismatchError", "NotSupportedError", "InvalidClusterNameError",
         "ProvisionUnsupportedError", "ClusterNotUpError", "SkyletInternalError", "CloudUserIdentityError")  # fmt: skip
# What it logs before it tries a place, and where the provider refused to create a machine: fogspec/backends/skypilot/errors.py.
# Which Ubuntu it starts without an image: fogspec/base/clouds.py.
WORDS = {
    "backends/cloud_vm_ray_backend.py": "f'Launching{controller_str} on '",
    "provision/aws/instance.py": "f'create_instances: Attempt failed with {",
    "provision/azure/instance.py": "f'Failed to create instances: {",
    "provision/gcp/instance_utils.py": "f'Got return code{plural} {codes}",
    **dict.fromkeys((f"provision/{one}/instance.py" for one in ("lambda_cloud", "nebius", "runpod", "vast")),
                    "f'run_instances error: {"),
    "clouds/gcp.py": "'skypilot:custom-cpu-ubuntu-2204'",
    "clouds/kubernetes.py": "'skypilot:custom-cpu-ubuntu-2204-v1'",
    "clouds/runpod.py": "-ubuntu2204'",
    "clouds/nebius.py": "'ubuntu24.04-driverless'",
    "provision/fluidstack/fluidstack_utils.py": "'ubuntu_22_04_lts_nvidia'",
}  # fmt: skip
package = Path(sky.__file__).parent
names += tuple(f"{path}: {words}" for path, words in WORDS.items() if words not in (package / path).read_text())
# The disk that comes with a machine, which fogspec/base/clouds.py prices, and the largest of the images that must fit on it.
disks = [
    *aws.AWS._get_disk_specs(None).values(), gcp.GCP._get_disk_type("n2-standard-4", None), azure.Azure._get_disk_type(None)
]  # fmt: skip
least_gib = max(aws.DEFAULT_AMI_GB, gcp.DEFAULT_GCP_IMAGE_GB, azure._DEFAULT_SKYPILOT_IMAGE_GB)
# Whether it still asks for a disk that series with Hyperdisk alone do not take.
series = ("c4", "c4d", "c4a", "n4d", "n4a", "h4d", "m4", "x4", "n4")
plain = [one for one in series if gcp.GCP._get_disk_type(f"{one}-standard-8", None).startswith("pd-")]
# What it refuses on each cloud, which the rows of fogspec/base/clouds.py say too.
features, refused = ("AUTODOWN", "DOCKER_IMAGE", "OPEN_PORTS"), {}
for name in sorted(registry.CLOUD_REGISTRY):
    cloud = registry.CLOUD_REGISTRY.from_str(name)
    asked = cloud._unsupported_features_for_resources(sky.Resources(cloud=cloud))
    refused[name] = [one for one in features if getattr(clouds.CloudImplementationFeatures, one) in asked]
missing = [name for name in names if not hasattr(exceptions, name)]
print(json.dumps({"missing": missing, "clouds": sorted(registry.CLOUD_REGISTRY), "disks": disks, "plain": plain,
                  "least_gib": least_gib, "refused": refused, "default_gib": resources.DEFAULT_DISK_SIZE_GB}))  # fmt: skip
