"""An image is not started on this host, and what was measured without it says so."""

from types import SimpleNamespace

from fogspec.bench.run import without_image
from fogspec.language.schema import Application


def application(**ros: str) -> Application:
    spec = {
        "cloud": [{"package": "p", "executable": "e"}],
        "probe": {"callback": "x"},
        "infra": ["aws/us-east-1"],
        "ros": ros,
    }
    return Application.model_validate(
        {"apiVersion": "fogspec.dev/v1alpha1", "kind": "Application", "metadata": {"name": "app"}, "spec": spec}
    )


def test_the_local_runner_measures_without_the_image() -> None:
    imaged = application(image="registry.example.org/team/nodes:1")
    (said,) = without_image(imaged, SimpleNamespace(name="local"))
    assert "registry.example.org/team/nodes:1" in said
    assert without_image(imaged, SimpleNamespace(name="skypilot")) == []
    assert without_image(application(distro="jazzy"), SimpleNamespace(name="local")) == []
