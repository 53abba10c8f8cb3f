"""Rules between fields, on whatever is right by itself."""

import pytest

from fogspec.language.loader import check_text

BASE = """\
apiVersion: fogspec.dev/v1alpha1
kind: Application
metadata: {{ name: arm }}
spec:
  cloud: [{cloud}]
  probe: {probe}
  infra: [aws]
  benchmark: {benchmark}
{more}
"""
ROS = "  ros: { distro: humble }"
ZENOH = f"  connectivity: {{ link: zenoh, expose: {{/tf: topic}} }}\n{ROS}"


def said(
    cloud: str = "{ cmd: [plan] }",
    probe: str = "{ callback: plan }",
    benchmark: str = "{ budget: $1 }",
    more: str = "",
    infra: str = "[aws]",
) -> list[tuple[str, str | None]]:
    content = BASE.format(cloud=cloud, probe=probe, benchmark=benchmark, more=more)
    content = content.replace("infra: [aws]", f"infra: {infra}")
    return [(one.code, one.fix) for one in check_text(content.encode(), "spec.yaml")[1]]


@pytest.mark.parametrize(
    ("change", "codes"),
    [
        ({}, []),
        ({"probe": "{ request: /a, response: /b, match: order }", "more": ROS}, ["FS525"]),
        ({"probe": "{ request: /a, response: /b, match: order, via: preload }", "more": ROS}, []),
        (
            {
                "probe": "{ request: /a, response: /b, match: order }",
                "more": ROS,
                "benchmark": "{ budget: $1, workload: { node: { cmd: [talk] } } }",
            },
            [],
        ),
        ({"probe": "{ request: /a, response: /b, callback: c, service: /s }"}, ["FS511", "FS511"]),
        ({"probe": "{ response: /b }"}, ["FS512"]),
        ({"probe": "{ service: /s, timeout: 2s }", "more": ROS}, []),
        ({"probe": "{ action: /a, via: preload }", "more": ROS}, []),
        ({"probe": "{ bag: run, request: /a, response: /b, success: 'len(poses) > 0' }", "more": ROS}, []),
        ({"probe": "{ bag: run, request: /a, response: /b, match: order }", "more": ROS}, ["FS525"]),
        ({"probe": "{ bag: run }"}, ["FS512"]),
        ({"probe": "{ bag: run, callback: c }"}, ["FS511"]),
        ({"probe": "{ bag: run, request: /a, response: /b, via: preload }", "more": ROS}, ["FS525"]),
        ({"probe": "{ callback: c, via: preload }"}, ["FS525"]),
        ({"probe": "{ service: /s, via: rclpy }", "more": ROS}, ["FS525"]),
        ({"probe": "{ service: /s, success: a == 1 }", "more": ROS}, ["FS525"]),
        (
            {
                "probe": "{ service: /s, success: a == 1 }",
                "benchmark": "{ budget: $1, workload: { bag: calls } }",
                "more": ROS,
            },
            [],
        ),
        ({"probe": "{ action: /s, success: a == 1 }", "more": ROS}, ["FS525"]),
        ({"probe": "{ request: /a, response: /b, match: first_request, via: preload }", "more": ROS}, ["FS525"]),
        ({"probe": "{ request: /a, response: /b, success: a == 1, via: preload }", "more": ROS}, ["FS525"]),
        ({"probe": "{ request: /a, response: /b, success: a = 1 }", "more": ROS}, ["FS305"]),
        ({"probe": "{ service: /s }", "benchmark": "{ budget: $1, workload: { bag: d, rate: 5/s } }", "more": ROS}, []),
        ({"benchmark": "{ budget: $1, workload: { bag: d } }"}, ["FS526"]),
        ({"benchmark": "{ budget: $1, workload: { rate: 5/s } }"}, ["FS526"]),
        (
            {
                "probe": "{ service: /s }",
                "benchmark": "{ budget: $1, workload: { bag: d, node: { cmd: [x] } } }",
                "more": ROS,
            },
            ["FS526"],
        ),
        ({"benchmark": "{ machines: [local/1cpu-1gib, local/2cpu-2gib] }"}, []),
        ({"benchmark": "{ machines: [local/1cpu-1gib, c6i.large] }"}, ["FS522"]),
        ({"benchmark": "{ budget: $0 }"}, ["FS522"]),
        ({"benchmark": "{ budget: $1, stop: { requests: null } }"}, []),
        ({"cloud": "{ package: a, executable: b }"}, ["FS503"]),
        ({"cloud": "{ cmd: [python3, nodes/../plan.py, ..., ./x, 'a ../b', --in=x] }"}, []),
        ({"cloud": "{ cmd: [python3, ../nodes/plan.py] }"}, ["FS507"]),
        ({"benchmark": "{ budget: $1, workload: { node: { cmd: [python3, a/../../client.py] } } }"}, ["FS507"]),
        ({"more": "  robot: [{ cmd: [python3, ../camera.py] }]"}, []),
        ({"cloud": "{ package: a, executable: b }", "more": ROS}, []),
        ({"more": "  constraints: { latency: 5min }"}, ["FS520"]),
        ({"more": "  constraints: { latency: 0s }"}, ["FS519"]),
        ({"more": "  objective: { load: { rate: 1/s, sessions: 1/day } }"}, ["FS518"]),
        ({"more": "  objective: { metric: latency }"}, ["FS517"]),
        ({"more": "  constraints: { metrics: { length: 3 } }"}, ["FS517"]),
        ({"more": f"  metrics: {{ m: {{ topic: /t, field: x }} }}\n{ROS}"}, []),
        ({"more": "  metrics: { m: { topic: /t, callback: x } }"}, ["FS515"]),
        ({"more": "  hardware: { gpus: [T4, quantum, 'T4:4', 'A100:0.5', RTX PRO 4500, none] }"}, []),
        (
            {"more": "  hardware: { gpus: ['T4:', ':4', 'T4:0', 'T4:x', 'none:1', ' ', \"T\\u0007\", 'T4:4:4'] }"},
            ["FS532"] * 8,
        ),
        ({"more": "  hardware: { allow: [c6i.*], deny: [c6i.*] }"}, ["FS533"]),
        ({"more": "  hardware: { cpus: 0..0 }"}, ["FS535"]),
        ({"more": "  hardware: { cpus: ..2, memory: 64GiB.., memory_per_cpu: ..8GiB }"}, ["FS535"]),
        ({"more": "  connectivity: { link: zenoh }"}, ["FS541", "FS543"]),
        ({"more": "  connectivity: { link: wireguard, expose: {/tf: topic} }"}, ["FS544"]),
        ({"infra": "[aws, runpod]", "more": ZENOH}, ["FS541"]),
        ({"infra": "[kubernetes/ours]", "more": ZENOH}, ["FS541"]),
        ({"infra": "[aws, gcp]", "more": ZENOH}, []),
    ],
)
def test_rules(change: dict[str, str], codes: list[str]) -> None:
    assert sorted(code for code, _ in said(**change)) == codes


@pytest.mark.parametrize(
    ("entry", "fix"),
    [
        ("us-east-1", "write 'aws/us-east-1'"), ("us-central1", "write 'gcp/us-central1'"),
        ("awss/eu-west-1", "write 'aws/eu-west-1'"), ("k8s/ours", "write 'kubernetes/ours'"),
        ("k8s/arn:aws:eks:us-east-1:1:cluster/ours", "write 'kubernetes/arn:aws:eks:us-east-1:1:cluster/ours'"),
        ("AWS/us-east-1", "write 'aws/us-east-1'"), ("aws us-east-1", "write 'aws/us-east-1'"),
    ],
)  # fmt: skip
def test_infra_is_mended(entry: str, fix: str) -> None:
    content = BASE.format(cloud="{ cmd: [plan] }", probe="{ callback: p }", benchmark="{ budget: $1 }", more="")
    _, wrong = check_text(content.replace("infra: [aws]", f"infra: ['{entry}']").encode(), "spec.yaml")
    assert [(one.code, one.fix) for one in wrong] == [("FS531", fix)]


def test_a_gpu_is_mended_where_only_its_spaces_are_wrong() -> None:
    content = BASE.format(
        cloud="{ cmd: [plan] }", probe="{ callback: p }", benchmark="{ budget: $1 }",
        more="  hardware: { gpus: ['V100: 0.5', 'T4 : x'] }",
    )  # fmt: skip
    assert [one.fix for one in check_text(content.encode(), "spec.yaml")[1]] == [
        "write 'V100:0.5'",
        "write it like T4, or T4:4",
    ]


@pytest.mark.parametrize(
    ("part", "fix"),
    [
        ({"probe": "{ callback: plan() }"}, "write 'plan'"),
        ({"cloud": "{ package: arm/planner }"}, "split it: package: arm, executable: planner"),
        ({"benchmark": "{ budget: $1, stop: { requests: 200 requests } }"}, "write 200"),
    ],
)  # fmt: skip
def test_what_a_new_user_writes_is_mended(part: dict[str, str], fix: str) -> None:
    usual = {"cloud": "{ cmd: [plan] }", "probe": "{ callback: p }", "benchmark": "{ budget: $1 }", "more": ""}
    _, wrong = check_text(BASE.format(**(usual | part)).encode(), "spec.yaml")
    assert fix in [one.fix for one in wrong]
