"""What the language can say and this version cannot do yet: one table, which shrinks as features land."""

from collections.abc import Iterator

from fogspec.base.nodes import Path, dotted
from fogspec.rules.finding import Finding
from fogspec.spec import Application, Spec


def unavailable(application: Application) -> Iterator[Finding]:
    """A located error for each field that nothing in this version acts upon."""
    for path, instead in _used(application.spec):
        at = ("spec", *path)
        yield Finding("FS901", at, f"{dotted(at)} is not available in this version", instead, at_key=True)


def _used(spec: Spec) -> Iterator[tuple[Path, str]]:
    if spec.benchmark.sampler == "adaptive":
        yield ("benchmark", "sampler"), "write 'grid'"
    if spec.connectivity.link != "none":
        yield ("connectivity", "link"), "write 'none' and join robot and cloud yourself"
    for kind in ("service", "action", "bag"):
        if getattr(spec.probe, kind) is not None:
            yield ("probe", kind), "measure topics with request and response, or code with callback"
    if spec.benchmark.workload.bag is not None:
        yield ("benchmark", "workload", "bag"), "send the requests with benchmark.workload.node"
    if spec.benchmark.workload.rate is not None:
        yield ("benchmark", "workload", "rate"), "send the requests with benchmark.workload.node"
    for name, metric in spec.metrics.items():
        if metric.topic is not None:
            yield ("metrics", name, "topic"), "report the value with fogspec_probe.stop and name it in callback"
