"""tools/badges.py: the README gets the badges of the place where it is published, and nothing else changes."""

import badges
import pytest

PAGE = f"# Title\n\n{badges.BEGIN}\n{badges.END}\n\nText.\n"


def test_badges_stand_between_the_marks_and_can_be_changed():
    page = badges.with_badges(PAGE, "someone/ditr_lite")
    assert page.startswith("# Title\n") and page.endswith("\n\nText.\n") and "/blob/colab/00_start_here.ipynb" in page
    assert badges.with_badges(page, "other/x") == badges.with_badges(PAGE, "other/x") and "someone" in page


@pytest.mark.parametrize(("page", "name"), [(PAGE, "no slash"), (PAGE, "https://github.com/a/b"), ("# Title", "a/b")])
def test_what_has_no_place_is_refused(page, name):
    with pytest.raises(ValueError, match=r"OWNER/NAME is wanted|once each"):
        badges.with_badges(page, name)


@pytest.mark.parametrize("address", ["https://github.com/a/b.git", "git@github.com:a/b.git", "https://github.com/a/b"])
def test_the_place_is_known_from_the_clone(address, monkeypatch):
    answer = badges.subprocess.CompletedProcess([], 0, stdout=address + "\n")
    monkeypatch.setattr(badges.subprocess, "run", lambda *_, **__: answer)
    assert badges.origin() == "a/b"


def test_the_readme_has_the_marks(monkeypatch, tmp_path):
    page = (badges.ROOT / "README.md").read_text(encoding="utf-8")
    (tmp_path / "README.md").write_text(page, encoding="utf-8")
    monkeypatch.setattr(badges, "ROOT", tmp_path)
    assert badges.main(["a/b"]) == 0 and "gh/a/b/main" in (tmp_path / "README.md").read_text(encoding="utf-8")
    assert badges.main(["a b"]) == 2
