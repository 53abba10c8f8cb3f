"""Names of machines say whose they are."""

from dataclasses import replace
from pathlib import Path

import pytest

from fogspec.backends.naming import OWNER_LABEL, ForeignMachine, Owner
from fogspec.backends.protocol import Job

DIGEST = "sha256:" + "0" * 64
OWNER = Owner("forge.test/lab/robots", "default", "demo")
OTHERS = [
    replace(OWNER, repository="forge.test/fork/robots"),
    replace(OWNER, repository="forge.test/lab/robots//sub"),
    replace(OWNER, environment="prod"),
    replace(OWNER, application="demo-two"),
    replace(OWNER, application="dem"),
    *(replace(OWNER, application=name) for name in ("a" * 63, "a" * 62 + "b")),
]
OLD = ("fogspec-demo-01234567-0123ab", "fogspec-01234567-aws-r1-c-large-0a1b2c3d-1")


@pytest.mark.parametrize("owner", [OWNER, *OTHERS])
def test_a_name_belongs_to_one_application_of_one_repository(owner: Owner) -> None:
    names = [owner.deployment_name(DIGEST, "0123ab"), f"{owner.prefix}aws-r1-c-large-0a1b2c3d-1"]
    assert all(owner.has(name) and len(name) <= 68 for name in names)
    assert [owner.has_deployment(name) for name in names] == [True, False]
    assert [owner.has_sample(name) for name in names] == [False, True]
    for other in {OWNER, *OTHERS} - {owner}:
        assert not any(other.has(name) for name in names)
        assert owner.digest != other.digest
    assert not any(
        owner.has(name) for name in (*OLD, owner.prefix, f"{owner.prefix}a/b", f"x{names[0]}", f"{names[0]}\n")
    )


def test_the_labels_name_is_that_of_machines_of_earlier_versions() -> None:
    assert {"fogspec-owner": OWNER.digest}.items() <= OWNER.labels.items()


def test_a_label_of_another_owner_outweighs_the_name() -> None:
    name = OWNER.deployment_name(DIGEST, "0123ab")
    assert OWNER.has(name, OWNER.labels)
    assert OWNER.has(name, {"other": "label"})
    assert not OWNER.has(name, OTHERS[0].labels)
    assert len(OWNER.labels[OWNER_LABEL]) <= 63
    assert OWNER.labels[OWNER_LABEL].isalnum()


def test_no_job_has_the_name_of_another_owners_machine(tmp_path: Path) -> None:
    for name in (OTHERS[0].deployment_name(DIGEST, "0123ab"), *OLD, "Documents", "."):
        with pytest.raises(ForeignMachine, match="not a machine of demo of forge"):
            Job(name=name, owner=OWNER, root=tmp_path, directory=tmp_path)


def test_an_owner_is_named_with_its_environment_where_it_has_one() -> None:
    assert str(Owner("github.com/a/b", "default", "demo")) == "demo of github.com/a/b"
    assert str(Owner("github.com/a/b", "staging", "demo")) == "demo@staging of github.com/a/b"
