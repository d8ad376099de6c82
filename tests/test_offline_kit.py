"""tools/offline_kit.py: what is in the kit, and that its installer asks no network."""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import offline_kit as kit
import pytest

ROOT = Path(__file__).resolve().parents[1]


def wheel(folder, name, *needs):
    """Write a wheel of nothing that needs other packages."""
    lines = ["Metadata-Version: 2.1", f"Name: {name}", "Version: 1", *(f"Requires-Dist: {need}" for need in needs)]
    with zipfile.ZipFile(folder / f"{name}-1-py3-none-any.whl", "w") as archive:
        archive.writestr(f"{name}-1.dist-info/METADATA", "\n".join(lines) + "\n")


@pytest.fixture
def packed(monkeypatch, tmp_path):
    """Return a function that packs a kit of a small repository; packages are not fetched but named in files."""
    monkeypatch.setattr(kit, "ROOT", tmp_path / "clone")
    slides = tmp_path / "clone" / "outputs" / "slides"
    slides.mkdir(parents=True)
    (slides / "00.html").write_text("a deck")
    for name in ("environment.txt", "environment-class.txt"):
        (tmp_path / "clone" / name).write_text(f"# {name}\n-e .\nnumpy\n")
    monkeypatch.setattr(kit, "repository", lambda folder: (folder.mkdir(), (folder / "tasks.py").write_text("pass")))
    asked = []

    def run(command, check):
        asked.append((command, Path(command[command.index("-r") + 1]).read_text()))
        wheel(Path(command[command.index("--dest") + 1]), "numpy")

    monkeypatch.setattr(kit.subprocess, "run", run)

    def pack(*arguments):
        target = tmp_path / "kit.zip"
        assert kit.main([*arguments, "--out", str(target)]) == 0
        return zipfile.ZipFile(target), asked[-1]

    return pack


def test_the_kit_holds_all_that_it_needs(packed, capsys):
    archive, (command, wanted) = packed()
    names = {name.removeprefix(f"{kit.TOP}/") for name in archive.namelist()}
    assert names == {
        "README.txt",
        "install.py",
        "wheels/numpy-1-py3-none-any.whl",
        "ditr_lite/tasks.py",
        "slides/00.html",
    }
    assert "# environment-class.txt" in wanted and "-e ." not in wanted and "setuptools" in wanted
    assert "without the book" in capsys.readouterr().out and "--platform" not in command
    assert '"class"' in archive.read(f"{kit.TOP}/install.py").decode()


def test_a_kit_for_another_system_and_the_full_set(packed):
    archive, (command, wanted) = packed("--full", "--for", "win_amd64", "3.12")
    assert command[command.index("--platform") :][:4] == ["--platform", "win_amd64", "--python-version", "3.12"]
    assert "# environment.txt" in wanted
    installer = archive.read(f"{kit.TOP}/install.py").decode()
    assert "(3, 12)" in installer and '"setup"' in installer


def test_a_kit_holds_what_only_the_other_system_needs(tmp_path, monkeypatch):
    needs = (
        'on_windows>=2; sys_platform == "win32"',
        'on_linux; sys_platform == "linux"',
        "always",
        'more; extra == "x"',
    )
    wheel(tmp_path, "first", *needs)
    wheel(tmp_path, "always", "First")
    assert kit.still_missing(tmp_path, ("win_amd64", "3.12")) == ["on_windows>=2"]
    assert kit.still_missing(tmp_path, ("manylinux_2_28_x86_64", "3.12")) == ["on_linux"]
    fetched = []

    def run(command, check):
        fetched.append(command[-1])
        wheel(tmp_path, "on_windows" if len(fetched) > 1 else "third", 'old; python_version < "3.11"')

    monkeypatch.setattr(kit.subprocess, "run", run)
    (tmp_path / "list.txt").write_text("first\n")
    kit.download(tmp_path / "list.txt", tmp_path, ("win_amd64", "3.12"))
    assert fetched[1:] == ["on_windows>=2"]


def test_an_unknown_platform_is_refused_before_anything_is_fetched(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(kit.subprocess, "run", None)
    assert kit.main(["--for", "amiga", "3.12", "--out", str(tmp_path / "kit.zip")]) == 1
    assert "expected a platform that begins with win, macosx" in capsys.readouterr().err


def test_the_installer_asks_no_network_and_refuses_another_python(packed, monkeypatch, tmp_path):
    archive, _ = packed()
    monkeypatch.undo()  # what runs from here on runs indeed
    archive.extractall(tmp_path)
    folder = tmp_path / kit.TOP
    noting = "import os, sys; print(sys.argv[1:], os.environ['PIP_NO_INDEX'], os.environ['PIP_FIND_LINKS'])"
    (folder / "ditr_lite" / "tasks.py").write_text(noting)
    done = subprocess.run([sys.executable, folder / "install.py"], check=True, capture_output=True, text=True)
    assert f"['class'] 1 {(folder / 'wheels').as_uri()}" in done.stdout and "tasks.py lab" in done.stdout
    installer = (folder / "install.py").read_text()
    (folder / "install.py").write_text(installer.replace(str(sys.version_info[:2]), "(2, 7)"))
    done = subprocess.run([sys.executable, folder / "install.py"], capture_output=True, text=True)
    assert done.returncode == 1 and "this kit is for Python" in done.stderr


def test_what_cannot_be_had_is_said_and_leaves_no_file(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(kit, "ROOT", tmp_path)  # not a clone
    assert kit.main(["--out", str(tmp_path / "kit.zip")]) == 1
    assert "made from a clone" in capsys.readouterr().err and os.listdir(tmp_path) == []


def test_the_repository_is_what_was_committed(tmp_path):
    if not (ROOT / ".git").exists():
        pytest.skip("not a clone")
    kit.repository(tmp_path / "copy")
    assert (tmp_path / "copy" / "notebooks" / "00_start_here.ipynb").exists()
    assert not (tmp_path / "copy" / "outputs").exists()
