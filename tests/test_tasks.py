"""tasks.py and the Makefile: every command has one home, starts without make, and knows where it is."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import nbformat
import pytest
from nbconvert import HTMLExporter

import tasks

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def ran(monkeypatch, tmp_path):
    """Note commands instead of running them, in an environment that is not there yet."""
    commands = []

    def run(command, **options):
        commands.append((command, options))
        return subprocess.CompletedProcess(command, 0)

    monkeypatch.setattr(tasks.subprocess, "run", run)
    monkeypatch.setattr(tasks, "VENV", tmp_path / "venv")
    monkeypatch.setattr(tasks, "PYTHON", tmp_path / "venv" / "bin" / "python")
    (tmp_path / "venv").mkdir()
    return commands


def words(ran):
    return [" ".join(map(str, command[1:])) for command, _ in ran]


def test_make_knows_the_same_commands():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = re.search(r"^TARGETS := (.*)$", makefile, re.MULTILINE).group(1).split()
    assert {*targets, "grade"} == set(tasks.COMMANDS)


def test_every_command_is_listed_with_what_it_does(capsys):
    tasks.main([])
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == list(tasks.COMMANDS)
    assert all(re.fullmatch(r"[\w-]+ +[A-Z].{20,}\.", line) for line in lines)


def test_an_unknown_command_is_refused_by_name():
    done = subprocess.run([sys.executable, ROOT / "tasks.py", "fly"], capture_output=True, text=True)
    assert done.returncode == 1 and "no command 'fly'; there are: setup, class" in done.stderr


def test_the_environment_is_built_once(ran):
    tasks.main(["setup"])
    assert words(ran) == [f"-m venv {tasks.VENV}", "-m pip install --quiet -r environment.txt"]
    ran.clear()
    tasks.main(["setup"])
    tasks.main(["class"])  # the full set holds the light one
    assert ran == []


def test_the_light_set_installs_the_package_without_what_it_needs_elsewhere(ran):
    torch = tasks.VENV / "lib" / "site-packages" / "torch"
    for name in ("include/torch.h", "test/basic", "bin/test_api", "bin/torch_shm_manager", "lib/libtorch.so"):
        (torch / name).parent.mkdir(parents=True, exist_ok=True)
        (torch / name).touch()
    tasks.main(["class"])
    assert "--no-deps --no-build-isolation -e ." in words(ran)[2] and "-r environment-class.txt" in words(ran)[1]
    left = {path.name for path in torch.rglob("*") if path.is_file()}
    assert left == {"torch_shm_manager", "libtorch.so"}
    ran.clear()
    tasks.main(["lab"])  # and opening the notebooks does not fetch the rest
    assert not any("pip" in line for line in words(ran))


def test_every_way_to_install_brings_the_extension_of_jupyterlab(ran):
    inside = Path("share", "jupyter", "labextensions")
    files = {path.relative_to(tasks.EXTENSIONS) for path in tasks.EXTENSIONS.rglob("*") if path.is_file()}
    tasks.main(["class"])
    assert {path.relative_to(tasks.VENV / inside) for path in (tasks.VENV / inside).rglob("*.js*")} == files
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    listed = project["tool"]["setuptools"]["data-files"]
    placed = {Path(folder, Path(name).name): ROOT / name for folder, names in listed.items() for name in names}
    assert placed == {inside / file: tasks.EXTENSIONS / file for file in files}
    for name in ("Dockerfile", "binder/postBuild"):
        assert "cp -r tools/labextensions" in (ROOT / name).read_text(encoding="utf-8")


def test_a_changed_list_of_packages_is_installed_again(ran, monkeypatch, tmp_path):
    tasks.main(["setup"])
    old = tasks.stamp(tasks.FULL)
    monkeypatch.setattr(tasks, "ROOT", tmp_path)
    (tmp_path / "environment.txt").write_text("new")
    (tmp_path / "pyproject.toml").write_text("new")
    tasks.main(["setup"])
    assert words(ran)[-1].endswith("-r environment.txt") and not old.exists() and tasks.stamp(tasks.FULL).exists()


def test_an_old_python_is_refused_before_anything_is_made(ran, monkeypatch):
    monkeypatch.setattr(tasks, "OLDEST", (9, 0))
    with pytest.raises(SystemExit, match=r"this is \d.*make PYTHON="):
        tasks.main(["setup"])
    assert ran == []


@pytest.mark.parametrize(("user", "boxed", "allowed"), [(0, True, True), (0, False, False), (1000, True, False)])
def test_root_may_open_the_notebooks_only_in_a_container(user, boxed, allowed, ran, monkeypatch):
    monkeypatch.setattr(tasks.os, "geteuid", lambda: user, raising=False)
    monkeypatch.setattr(tasks, "in_container", lambda: boxed)
    tasks.main(["lab", "--no-browser"])
    assert ("--allow-root" in words(ran)[-1]) == allowed and words(ran)[-1].endswith("00_start_here.ipynb --no-browser")


def test_the_page_of_the_demo_asks_no_network(ran):
    tasks.main(["demo"])
    page = next(line for line in words(ran) if "nbconvert" in line)
    name = re.search(r"--execute .*--template (\S+) .*basedirs=tools --output-dir outputs ", page).group(1)
    exporter = HTMLExporter(template_name=name, extra_template_basedirs=[str(ROOT / "tools")])
    cell = nbformat.v4.new_markdown_cell("$x^2$, see [02](02_region_refinement.ipynb)")
    html, _ = exporter.from_notebook_node(nbformat.v4.new_notebook(cells=[cell]))
    assert re.findall(r"""(?:src=|import |from )['"](?:https?:)?//[^'"]+""", html) == []
    [mathjax] = re.findall(r'<script[^>]* src="([^"]+)"', html)
    assert (ROOT / "outputs" / mathjax).resolve().is_file()
    assert 'href="../notebooks/02_region_refinement.ipynb"' in html


def test_a_failed_command_ends_with_its_exit_code(monkeypatch):
    monkeypatch.setattr(tasks, "surroundings", lambda extra: None)
    with pytest.raises(SystemExit) as ended:
        tasks.call([sys.executable, "-c", "raise SystemExit(7)"])
    assert ended.value.code == 7


def test_notebooks_draw_inline_whatever_the_shell_says(monkeypatch):
    monkeypatch.setenv("MPLBACKEND", "Agg")
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    assert "MPLBACKEND" not in tasks.surroundings() and tasks.surroundings()["OMP_NUM_THREADS"] == "2"


def test_cleaning_leaves_what_takes_long_to_make(monkeypatch, tmp_path):
    monkeypatch.setattr(tasks, "ROOT", tmp_path)
    for name in ("book/index.html", "slides/00.html", "demo.json", "student/00.ipynb", "scenes/a.png"):
        (tmp_path / "outputs" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "outputs" / name).touch()
    tasks.main(["clean"])
    assert sorted(p.name for p in (tmp_path / "outputs").iterdir()) == ["scenes", "student"]


def test_tasks_need_nothing_but_the_standard_library():
    code = f"import sys; sys.path.insert(0, {str(ROOT)!r}); import tasks; tasks.main([])"
    subprocess.run([sys.executable, "-I", "-S", "-c", code], check=True, capture_output=True)
