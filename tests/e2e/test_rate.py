"""A declared rate is what the latency is bounded at, through the command line."""

from pathlib import Path

from tests.support import scenes
from tests.support.scenes import Scene

WORK = """\
import itertools, time
import fogspec_probe
for n in itertools.count():
    fogspec_probe.start("work")
    time.sleep(0.004 if n % 5 else 0.074)  # 18 ms on average
    fogspec_probe.stop("work")
"""
SPEC = (
    scenes.SPEC.replace("latency: 1s, cost: $1/request", "latency: 36ms")
    .replace("  infra: [aws/us-east-1]", "  infra: [local]\n  objective: {load: {rate: 50/s}}")
    .replace(", allow: [c6i.*, m6i.*, c7i.*]", "")
    .replace(", local/2cpu-1gib", "")
    .replace("requests: 10,", "requests: 100,")
)


def test_requests_that_would_wait_for_one_another_take_longer(tmp_path: Path) -> None:
    scene = Scene.made(tmp_path / "scene", WORK, SPEC)
    assert scene.bench().returncode == 0
    busy = scene.run("compile")
    assert busy.returncode != 0
    said = " ".join((busy.stdout + busy.stderr).split())
    ever = "1cpu-1gib: at 50/s, requests come faster than it answers them, and wait ever longer"
    assert "1cpu-1gib: at 50/s, evenly spaced, requests wait for one another: " in said or ever in said
    scene.spec.write_text(SPEC.replace("50/s", "80/s"))
    assert ever.replace("50/s", "80/s") in " ".join(scene.run("compile").stdout.split()), "18 ms each"
    for rate, waits in (("2/s", False), ("20/s", True)):
        scene.spec.write_text(SPEC.replace("36ms", "500ms").replace("50/s", rate))
        calm = scene.run("compile")
        assert calm.returncode == 0, "another rate needs no other measurement"
        assert ("requests wait for one another" in calm.stdout) is waits
        models = scene.document(scene.folder / "compiled" / "tiny" / "models.yaml")
        assert models["spec"]["inputs"]["spec.objective.load.rate"] == float(rate.removesuffix("/s"))
        assert scene.run("check").returncode == 0
    for path in (scene.results / "timings").iterdir():
        path.unlink()
    lost = scene.run("compile")
    assert (
        "how long requests wait at 20/s is not known for local-1cpu-1gib: no raw timings of them tell it" in lost.stdout
    )
