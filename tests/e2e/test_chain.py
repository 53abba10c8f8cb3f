"""verify, diff and attest: the chain behind a manifest, where it breaks, and what would change."""

import base64
import dataclasses
import gzip
import hashlib
import json
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from fogspec.base import digest
from fogspec.base.text import markdown
from fogspec.results.schema import Results, Timings, with_checksum
from fogspec.spec.loader import read_document
from tests.support.files import write_yaml
from tests.support.running import CATALOG, Shell, measure, project, shell  # noqa: F401

AT = ("--catalog", "offers.csv")
MANIFEST = "compiled/demo/manifest.yaml"
LINKS = ["spec", "catalog", "lock", "plan", "results", "timings", "models", "menu", "manifest", "deployment"]


@pytest.fixture
def done(shell: Shell) -> Shell:
    project(shell)
    measure(shell)
    shell("compile", "specs/demo.yaml", *AT)
    return shell


def broken(shell: Shell, code: int = 3) -> dict[str, list[str]]:
    said = json.loads(shell("verify", MANIFEST, *AT, "-o", "json", code=code).out)
    return {link["name"]: link["breaks"] for link in said["links"] if link["breaks"]}


def edit(shell: Shell, name: str, change: Callable[[str], str]) -> None:
    before = shell.read(name)
    assert change(before) != before
    shell.write(name, change(before))


def test_a_chain_that_holds(done: Shell) -> None:
    said = json.loads(done("verify", MANIFEST, *AT, "-o", "json").out)
    assert said["holds"]
    assert [link["name"] for link in said["links"]] == LINKS
    assert said["digest"] == digest.of_bytes((done.folder / MANIFEST).read_bytes())
    assert "holds" in done("verify", MANIFEST, *AT).out


@pytest.mark.parametrize(
    ("name", "change", "links", "says"),
    [
        ("specs/demo.yaml", lambda t: t.replace("alpha: 0.5", "alpha: 0.9"), {"spec", "manifest"}, "spec.objective changed"),
        ("offers.csv", lambda t: t.replace("0.40", "0.41"), {"catalog", "plan", "manifest"}, "another catalog"),
        ("compiled/demo/plan.yaml", lambda t: t.replace("requests: 20", "requests: 21"), {"plan"}, "spec.requests: 21 -> 20"),
        ("compiled/demo/models.yaml", lambda t: t.replace("p: ", "p: 1"), {"models"}, "models.yaml"),
        ("compiled/demo/manifest.yaml", lambda t: t.replace("$0.4/h", "$0.2/h"), {"manifest"}, "$0.2/h -> $0.4/h"),
        ("compiled/demo/menu.yaml", lambda t: t + "# mine\n", {"menu"}, "its text was edited"),
        ("compiled/demo/deploy.sky.yaml", lambda t: t.replace("a.large", "a.huge"), {"deployment"}, "reviewed"),
        ("compiled/demo/tasks/aws-r1-a-small.sky.yaml", lambda t: t + "# mine\n", {"plan"}, "aws-r1-a-small"),
        ("specs/demo.yaml", lambda t: t.replace("work.py", "other.py"), {"results"}, "measured something else"),
    ],
)  # fmt: skip
def test_which_link_breaks_and_how(
    done: Shell, name: str, change: Callable[[str], str], links: set[str], says: str
) -> None:
    edit(done, name, change)
    found = broken(done)
    assert links <= found.keys()
    assert any(says in line for lines in found.values() for line in lines), found
    assert "the chain breaks at" in done("verify", MANIFEST, *AT, code=3).err


def test_results_that_were_edited(done: Shell) -> None:
    edit(done, "results/demo.yaml", lambda text: text.replace("requests: 20", "requests: 21"))
    assert "integrity check failed" in broken(done)["results"][0]


def with_timings(shell: Shell, latencies_s: list[float]) -> Path:
    """Raw timings for the first sample, and its record as it follows from them; the rest is compiled anew."""
    path = shell.folder / "results/demo.yaml"
    results = read_document(path, Results)
    first, *others = results.spec.samples
    lines = [
        {"name": "plan", "start_s": n, "latency_s": s, "ok": True, "metrics": {}}
        for n, s in enumerate([9.0, *latencies_s])
    ]
    raw = shell.folder / f"results/demo/timings/{first.id}.jsonl.gz"
    raw.parent.mkdir(parents=True, exist_ok=True)
    raw.write_bytes(gzip.compress("".join(json.dumps(line) + "\n" for line in lines).encode(), mtime=0))
    mean = sum(latencies_s) / len(latencies_s)
    sd = (sum((s - mean) ** 2 for s in latencies_s) / (len(latencies_s) - 1)) ** 0.5
    latency = first.latency.model_copy(update={"mean": mean, "sd": sd, "p50": sorted(latencies_s)[1]})
    update = {"requests": len(latencies_s), "latency": latency,
              "timings": Timings(path=f"demo/timings/{raw.name}", digest=digest.of_bytes(raw.read_bytes()))}  # fmt: skip
    body = results.spec.model_copy(update={"samples": [first.model_copy(update=update), *others]})
    write_yaml(path, with_checksum(results.metadata, body).model_dump(mode="json", exclude_none=True), "a test")
    shell("compile", "specs/demo.yaml", *AT)
    return raw


def test_records_are_recomputed_from_raw_timings(done: Shell) -> None:
    raw = with_timings(done, [2.0, 2.1, 2.2])
    done("verify", MANIFEST, *AT)
    raw.write_bytes(raw.read_bytes() + b"\0")
    assert "is not what was recorded" in broken(done)["timings"][0]
    raw.unlink()
    assert "is missing" in broken(done)["timings"][0]


def test_a_record_that_does_not_follow_from_its_timings(done: Shell) -> None:
    with_timings(done, [2.0, 2.1, 2.2])
    path = done.folder / "results/demo.yaml"
    results = read_document(path, Results)
    first, *others = results.spec.samples
    better = first.model_copy(update={"latency": first.latency.model_copy(update={"mean": 1.0})})
    body = results.spec.model_copy(update={"samples": [better, *others]})
    write_yaml(path, with_checksum(results.metadata, body).model_dump(mode="json", exclude_none=True), "a test")
    done("compile", "specs/demo.yaml", *AT)
    (line,) = broken(done)["timings"]
    assert "latency" in line


@pytest.mark.parametrize(
    ("content", "path", "says"),
    [
        (b"no gzip", None, "it is not a complete gzip file"),
        (gzip.compress(b"{}\n" * 1000, mtime=0)[:-9], None, "it is not a complete gzip file"),
        (gzip.compress(b"", mtime=0)[:10] + b"\xff" * 20, None, "it is not a complete gzip file"),
        (None, "../specs/demo.yaml", "lies outside of"),
    ],
)
def test_raw_timings_that_are_none(done: Shell, content: bytes | None, path: str | None, says: str) -> None:
    raw = with_timings(done, [2.0, 2.1, 2.2])
    raw.write_bytes(content or raw.read_bytes())
    file = done.folder / "results/demo.yaml"
    results = read_document(file, Results)
    first, *others = results.spec.samples
    timings = Timings(path=path or f"demo/timings/{raw.name}", digest=digest.of_bytes(raw.read_bytes()))
    body = results.spec.model_copy(update={"samples": [first.model_copy(update={"timings": timings}), *others]})
    write_yaml(file, with_checksum(results.metadata, body).model_dump(mode="json", exclude_none=True), "a test")
    done("compile", "specs/demo.yaml", *AT)
    assert says in broken(done)["timings"][0]
    said = done("verify", MANIFEST, *AT, code=3).err
    assert "fogspec bench specs/demo.yaml" in said, "compiling again would not mend it"
    (done.folder / "results").rename(done.folder / "old")
    replay = ("bench", "specs/demo.yaml", "--runner", "replay", "--from", "old/demo.yaml", "--yes")
    assert says in done(*replay, code=1).err


def test_a_manifest_by_any_path(done: Shell) -> None:
    done("verify", str(done.folder / MANIFEST), *AT)
    done("verify", f"./compiled/../{MANIFEST}", *AT)


def test_a_manifest_elsewhere_and_none(done: Shell) -> None:
    done.write("copy.yaml", done.read(MANIFEST))
    assert "must stand at" in done("verify", "copy.yaml", *AT, code=1).err
    done("verify", "compiled/none/manifest.yaml", code=1)
    edit(done, MANIFEST, lambda text: text[: len(text) // 2])
    done("verify", MANIFEST, *AT, code=1)


def test_diff_says_what_and_why_and_what_it_costs(done: Shell) -> None:
    assert "the manifest is what compile would write" in done("diff", *AT, "--exit-code").out
    edit(done, "offers.csv", lambda text: text.replace("a.large,,,8,16,0.40", "a.large,,,8,16,0.44"))
    (said,) = json.loads(done("diff", *AT, "-o", "json").out)
    assert said["differs"]
    assert said["costs"]["price_usd_per_hour"]["before"] == 0.4
    assert any(reason.startswith("catalog:") for reason in said["why"])
    assert (said["to_measure"], said["running"]) == ([], None)
    assert "no benchmark needed" in done("diff", *AT, "--exit-code", code=3).out


def test_diff_names_the_samples_to_measure(done: Shell) -> None:
    edit(done, "specs/demo.yaml", lambda text: text.replace("cpus: 2..8", "cpus: 2..32"))
    (said,) = json.loads(done("diff", *AT, "-o", "json").out)
    assert said["to_measure"] == ["aws-r1-a-huge", "aws-r1-b-huge"]
    assert said["measuring_usd_at_most"] > 0
    assert "spec.hardware.cpus: 2..8 -> 2..32" in done("diff", *AT).out


@pytest.mark.parametrize("content", ["", "- 1\n", "a: [\n", "\0\n"])
def test_a_manifest_that_is_none_is_damage_not_a_bug(done: Shell, content: str) -> None:
    done.write(MANIFEST, content)
    for verb in ("status", "diff"):
        assert done(verb, "specs/demo.yaml", *AT).err == "", "compile mends it"
    for verb in ("verify", "attest", "apply"):
        assert "error[FS" in done(verb, MANIFEST, *AT, code=1).err


def test_diff_before_anything_and_when_nothing_meets(shell: Shell) -> None:
    project(shell)
    assert "there is no manifest" in shell("diff", *AT).out
    measure(shell)
    assert "a new manifest" in shell("diff", *AT, "--exit-code", code=3).out
    shell("compile", "specs/demo.yaml", *AT)
    edit(shell, "specs/demo.yaml", lambda text: text.replace("latency: 10s", "latency: 1ms"))
    assert "no machine meets the limits" in shell("diff", *AT, "--exit-code", code=3).out


def test_diff_shows_no_secrets(shell: Shell) -> None:
    shell.monkeypatch.setenv("MY_OWN", "hunter2-hunter2")
    nodes = "[{cmd: [python3, work.py, hunter2-hunter2], env: {API_TOKEN: abc-def-ghi}}]"
    project(shell, cloud=nodes, secrets="[MY_OWN]")
    measure(shell)
    for form in ("text", "json", "markdown"):
        said = shell("diff", *AT, "-o", form).out
        assert "hunter2" not in said
        assert "abc-def-ghi" not in said


def test_markdown_cannot_be_broken_out_of(done: Shell) -> None:
    edit(done, "offers.csv", lambda text: text.replace("a.large,,,8,16,0.40", "a.large,,,8,16,0.44"))
    said = done("diff", *AT, "-o", "markdown").out
    assert "| machine | $0.40/h | $0.44/h | +10% |" in said
    assert markdown("a|b`<img>\n") == "a\\|b\\`\\<img\\>\\\\n", "an end of line is shown, and ends no row"


def test_the_statement_is_in_toto_and_the_same_each_time(done: Shell) -> None:
    with_timings(done, [2.0, 2.1, 2.2])
    first, second = (done("attest", MANIFEST, *AT).out for _ in range(2))
    assert first == second
    said = json.loads(first)
    assert (said["_type"], said["predicateType"]) == (
        "https://in-toto.io/Statement/v1",
        "https://slsa.dev/provenance/v1",
    )
    subjects = {one["name"]: one["digest"]["sha256"] for one in said["subject"]}
    for name, value in subjects.items():
        path = (done.folder / "compiled/demo" / name) if name.startswith("..") else done.folder / name
        assert digest.of_bytes(path.read_bytes()) == f"sha256:{value}"
    assert {MANIFEST, "compiled/demo/deploy.sky.yaml", "compiled/agent.pyz"} <= subjects.keys()
    definition = said["predicate"]["buildDefinition"]
    materials = definition["resolvedDependencies"]
    assert [one["name"] for one in materials] == ["spec", "plan", "results", "timings", "models", "catalog"]
    for one in materials[:-1]:
        content = (done.folder / one["uri"]).read_bytes()
        assert hashlib.sha256(content).hexdigest() == one["digest"]["sha256"], "as any tool would check it"
    assert {"buildType", "externalParameters", "resolvedDependencies"} <= definition.keys()
    assert said["predicate"]["runDetails"]["builder"]["id"]


def test_a_pinned_image_is_a_material(done: Shell) -> None:
    from fogspec.audit.attest import materials
    from fogspec.compile.bundle import open_bundle

    opened = open_bundle(done.folder / MANIFEST)
    image = "ghcr.io/team/robot@sha256:" + "ab" * 32
    spec = opened.manifest.spec.model_copy(update={"image": image})
    pinned = dataclasses.replace(opened, manifest=opened.manifest.model_copy(update={"spec": spec}))
    assert materials(pinned)[-1] == {
        "name": "image",
        "uri": "oci://ghcr.io/team/robot",
        "digest": {"sha256": "ab" * 32},
    }


def test_what_breaks_is_not_attested(done: Shell) -> None:
    edit(done, MANIFEST, lambda text: text.replace("$0.4/h", "$0.2/h"))
    ended = done("attest", MANIFEST, *AT, "--out", "statement.json", code=3)
    assert "not attested" in ended.err
    assert not (done.folder / "statement.json").exists()


@pytest.fixture
def keys(done: Shell) -> Shell:
    for name in ("mine", "other"):
        subprocess.run(
            ["openssl", "genpkey", "-algorithm", "ed25519", "-out", f"{name}.pem"], cwd=done.folder, check=True
        )
        subprocess.run(
            ["openssl", "pkey", "-in", f"{name}.pem", "-pubout", "-out", f"{name}.pub"], cwd=done.folder, check=True
        )
    return done


def test_a_signed_statement_is_checked(keys: Shell) -> None:
    pytest.importorskip("securesystemslib", reason="signing needs securesystemslib: pip install 'fogspec[attest]'")
    keys("attest", MANIFEST, *AT, "--key", "mine.pem", "--out", "signed.json")
    envelope = json.loads(keys.read("signed.json"))
    assert envelope["payloadType"] == "application/vnd.in-toto+json"
    assert "PRIVATE" not in keys.read("signed.json")
    check = ("verify", MANIFEST, *AT, "--attestation", "signed.json", "--key")
    assert "signed with mine.pub" in keys(*check, "mine.pub").out
    assert "not signed with other.pub" in keys(*check, "other.pub", code=3).out
    keys(*check, "mine.pem", code=1)
    statement = base64.b64decode(envelope["payload"]).replace(b'"name": "spec"', b'"name": "sqec"')
    keys.write("signed.json", json.dumps({**envelope, "payload": base64.b64encode(statement).decode()}))
    assert "not signed with mine.pub" in keys(*check, "mine.pub", code=3).out
    keys.write("signed.json", "{}")
    keys(*check, "mine.pub", code=3)


def openssl(keys: Shell, *words: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(["openssl", *words], cwd=keys.folder, capture_output=True, text=True)


@pytest.mark.parametrize(
    "kind", [["RSA", "-pkeyopt", "rsa_keygen_bits:2048"], ["EC", "-pkeyopt", "ec_paramgen_curve:P-256"]]
)
def test_a_signature_is_what_openssl_verifies(keys: Shell, kind: list[str]) -> None:
    """DSSE's own definition, apart from any of its libraries: the signature is over PAE(type, body)."""
    pytest.importorskip("securesystemslib", reason="signing needs securesystemslib: pip install 'fogspec[attest]'")
    assert openssl(keys, "genpkey", "-algorithm", *kind, "-out", "key.pem").returncode == 0
    assert openssl(keys, "pkey", "-in", "key.pem", "-pubout", "-out", "key.pub").returncode == 0
    keys("attest", MANIFEST, *AT, "--key", "key.pem", "--out", "signed.json")
    envelope = json.loads(keys.read("signed.json"))
    (signature,) = envelope["signatures"]
    body, kind_of = base64.b64decode(envelope["payload"]), envelope["payloadType"]
    whole = f"DSSEv1 {len(kind_of)} {kind_of} {len(body)} ".encode() + body
    (keys.folder / "signed").write_bytes(whole)
    (keys.folder / "sig").write_bytes(base64.b64decode(signature["sig"]))
    # Without -sigopt, openssl verifies PKCS#1 v1.5 for RSA.
    assert (
        openssl(keys, "dgst", "-sha256", "-verify", "key.pub", "-signature", "sig", "signed").stdout == "Verified OK\n"
    )
    (keys.folder / "signed").write_bytes(whole.replace(b"demo", b"dem0"))
    assert openssl(keys, "dgst", "-sha256", "-verify", "key.pub", "-signature", "sig", "signed").returncode != 0
    check = ("verify", MANIFEST, *AT, "--attestation", "signed.json", "--key")
    assert "signed with key.pub" in keys(*check, "key.pub").out
    if kind[0] == "RSA":
        # What was signed with PSS before counts on.
        from cryptography.hazmat.primitives import serialization
        from securesystemslib import dsse, signer

        private = serialization.load_pem_private_key((keys.folder / "key.pem").read_bytes(), None)
        former = dsse.Envelope(body, kind_of, {})
        former.sign(signer.CryptoSigner(private))
        keys.write("signed.json", json.dumps(former.to_dict()))
        assert "signed with key.pub" in keys(*check, "key.pub").out


def test_apply_requires_a_statement_of_exactly_these_files(keys: Shell) -> None:
    pytest.importorskip("securesystemslib", reason="signing needs securesystemslib: pip install 'fogspec[attest]'")
    apply = ("apply", MANIFEST, *AT, "--dry-run", "--resolve-image", "--require-attestation", "mine.pub")
    assert "no lock pins them" in keys(*apply, code=5).err
    keys("lock", *AT)
    keys("compile", "specs/demo.yaml")
    where = "compiled/demo/attestation.json"
    said = keys(*apply, code=5).err
    assert f"is not attested: there is no {where}" in said
    assert f"fogspec attest {MANIFEST} --key PRIVATE.pem --out {where}" in said
    keys("attest", MANIFEST, "--key", "other.pem", "--out", where)
    assert "not signed with mine.pub" in keys(*apply, code=5).err
    keys("attest", MANIFEST, "--key", "mine.pem", "--out", where)
    assert "demo: attested by a statement signed with mine.pub" in keys(*apply).err
    # Another choice, compiled and reviewed, is not what was signed; neither is a statement of more than these files.
    edit(keys, "specs/demo.yaml", lambda text: text.replace("alpha: 0.5", "alpha: 0.9"))
    keys("compile", "specs/demo.yaml")
    assert f"{MANIFEST} is not what was attested" in keys(*apply, code=5).err
    keys("attest", MANIFEST, "--key", "mine.pem", "--out", "elsewhere.json")
    keys(*apply, "--attestation", "elsewhere.json")
    assert "--attestation needs --require-attestation" in keys("apply", MANIFEST, "--attestation", "x", code=2).err
    # Node code that changed is in the lock, and so in the statement.
    keys.write("specs/work.py", "print('other')\n")
    keys(*apply, "--attestation", "elsewhere.json", code=3)
    keys("lock")
    keys("compile", "specs/demo.yaml", code=None)
    keys(*apply, "--attestation", "elsewhere.json", code=5)


def test_an_attestation_of_another_manifest_does_not_count(keys: Shell) -> None:
    pytest.importorskip("securesystemslib", reason="signing needs securesystemslib: pip install 'fogspec[attest]'")
    keys("attest", MANIFEST, *AT, "--key", "mine.pem", "--out", "signed.json")
    edit(keys, "specs/demo.yaml", lambda text: text.replace("alpha: 0.5", "alpha: 0.9"))
    keys("compile", "specs/demo.yaml", *AT)
    said = keys("verify", MANIFEST, *AT, "--attestation", "signed.json", "--key", "mine.pub", code=3).out
    assert f"{MANIFEST} is not what was attested" in said


def test_verify_wants_both_or_neither(done: Shell) -> None:
    done("verify", MANIFEST, *AT, "--key", "mine.pub", code=2)
