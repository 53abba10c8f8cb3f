from pathlib import Path

from fogspec.base.layout import Layout


def test_an_application_is_found_by_its_name_wherever_init_wrote_its_spec(tmp_path: Path) -> None:
    for place in ("arm.yaml", "arm/arm.yaml"):
        (tmp_path / "specs" / place).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "specs" / place).touch()
        for name in ("arm", "arm@prod"):
            layout = Layout.named(tmp_path, name)
            assert (layout.spec, layout.name, layout.root) == (tmp_path / "specs" / place, name, tmp_path)
    assert Layout.named(tmp_path, "gone").spec == tmp_path / "specs" / "gone.yaml"
