"""The repository's own rules: file length, import direction, public names, pins, no pickles."""

import ast
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import nbformat
import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

import ditr_lite

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "ditr_lite"
SOURCES = sorted(PACKAGE.glob("*.py"))
PYTHON = sorted(p for folder in (PACKAGE, ROOT / "tests", ROOT / "tools") for p in folder.glob("*.py"))
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
MAX_LINES = 250
# Where the name that is imported is not the one that is installed; drjit comes with mitsuba, which pins it.
DISTRIBUTIONS = {"PIL": "pillow", "cv2": "opencv-python-headless", "drjit": "mitsuba", "skimage": "scikit-image"}


def per_file(paths):
    return pytest.mark.parametrize("path", paths, ids=lambda p: p.name)


# --- the package ------------------------------------------------------------------------------------------------------


def imported_modules(tree):
    """Yield the modules of ditr_lite that a syntax tree imports, wherever in the file it does so."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name.split(".")[1] for alias in node.names if alias.name.startswith("ditr_lite."))
        elif isinstance(node, ast.ImportFrom):
            parts = (node.module or "").split(".")
            if node.level == 0 and parts[0] != "ditr_lite":
                continue
            inner = parts[1:] if node.level == 0 else [part for part in parts if part]
            yield from inner[:1] or (alias.name for alias in node.names if not alias.name.startswith("__"))


def backward_imports(name, source, order):
    """Return what module ``name`` imports although it does not stand before it in ``order``."""
    before = order[: order.index(name)]
    return [module for module in imported_modules(ast.parse(source)) if module not in before]


@pytest.mark.parametrize(
    "line",
    [
        "from ditr_lite.MODULE import x",
        "from .MODULE import x",
        "from . import MODULE",
        "from ditr_lite import MODULE",
        "import ditr_lite.MODULE",
        "import numpy, ditr_lite.MODULE as m",
        "def f():\n    from .MODULE import x",
    ],
)
def test_backward_import_is_noticed(line):
    order = ("before", "here", "after")
    assert backward_imports("here", line.replace("MODULE", "before"), order) == []
    assert backward_imports("here", line.replace("MODULE", "here"), order) == ["here"]
    assert backward_imports("here", line.replace("MODULE", "after"), order) == ["after"]


@per_file(SOURCES)
def test_imports_run_one_way(path):
    if path.stem == "__init__":
        assert not list(imported_modules(ast.parse(path.read_text()))), "the package itself loads its modules lazily"
        return
    order = (*ditr_lite.MODULES, "__main__")
    assert path.stem in order, f"add {path.stem!r} to ditr_lite.MODULES, after everything that it imports"
    assert backward_imports(path.stem, path.read_text(), order) == []


@per_file(SOURCES)
def test_file_is_short(path):
    lines = path.read_text().count("\n")
    assert lines <= MAX_LINES


def test_import_is_lazy_and_unknown_names_are_refused():
    code = (
        "import sys, ditr_lite as dl; assert not {'torch', 'cv2', 'numpy'} & set(sys.modules); dl.load_sample; dl.data"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)
    with pytest.raises(AttributeError, match="no attribute 'no_such_name'"):
        _ = ditr_lite.no_such_name


@pytest.mark.parametrize(
    "name", [n for n in ditr_lite.__all__ if (PACKAGE / f"{ditr_lite._HOME.get(n, n)}.py").exists()]
)
def test_public_name_resolves(name):
    assert getattr(ditr_lite, name) is not None and name in dir(ditr_lite)


# --- no pickles -------------------------------------------------------------------------------------------------------


def unsafe_loading(source):
    """Return what in ``source`` could run code hidden in a data file."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else [node.module or ""]
            found += [n for n in names if n.split(".")[0] in {"pickle", "cloudpickle", "dill", "joblib", "shelve"}]
        if isinstance(node, ast.Call):
            safe = {k.arg for k in node.keywords if isinstance(k.value, ast.Constant) and k.value.value is True}
            call = ast.unparse(node.func)
            if call == "torch.load" and "weights_only" not in safe:
                found.append("torch.load without weights_only=True")
            if "allow_pickle" in safe:
                found.append(f"{call}(allow_pickle=True)")
    return found


@pytest.mark.parametrize(
    "source",
    ["import pickle", "from pickle import loads", "torch.load(p)", "torch.load(p, weights_only=False)"]
    + ["np.load(p, allow_pickle=True)"],
)
def test_unsafe_loading_is_noticed(source):
    assert unsafe_loading(source)
    assert not unsafe_loading("torch.load(p, weights_only=True)\nsafetensors.torch.load_file(p)\nnp.load(p)")


def source_of(path):
    """Return the Python of a file; of a notebook that of its code cells, with magics and shell commands taken out."""
    if path.suffix == ".py":
        return path.read_text()
    cells = [cell.source for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "code"]
    cells = [cell for cell in cells if not cell.startswith("%%")]
    return re.sub(r"^(\s*)[%!].*$", r"\1pass", "\n".join(cells), flags=re.MULTILINE)


@per_file([p for p in (*PYTHON, *NOTEBOOKS) if p.parent.name != "tests"])  # tests may make a bad file to see it refused
def test_no_pickle(path):
    assert unsafe_loading(source_of(path)) == []


def test_weights_are_safetensors():
    files = [p for p in (PACKAGE / "weights").glob("*") if p.is_file() and not p.name.endswith(".part")]
    assert [p.name for p in files if p.suffix not in {".safetensors", ".json", ".md"}] == []


# --- the environment --------------------------------------------------------------------------------------------------


def pins():
    lines = (line.strip() for line in (ROOT / "environment.txt").read_text().splitlines())
    return [line for line in lines if line and not line.startswith(("#", "-e"))]


def ranges():
    """Return {name: version range} of everything that environment.txt must pin."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    declared = [*project["dependencies"], *extras["simulate"], *extras["sam"], *extras["book"], *extras["dev"]]
    return {requirement.name: requirement.specifier for requirement in map(Requirement, declared)}


@pytest.mark.parametrize("line", pins())
def test_pin_is_exact_and_in_range(line):
    assert re.fullmatch(r"[\w.-]+==\d[\w.]*", line), "pin as name==version"
    name, version = line.split("==")
    assert name in ranges(), "declare it in pyproject.toml as well"
    assert ranges()[name].contains(version)


def test_every_declared_dependency_is_pinned():
    assert {line.split("==")[0] for line in pins()} == set(ranges())


def third_party_imports(source):
    roots = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            roots |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            roots.add(node.module.split(".")[0])
    beside = {path.stem for path in (ROOT / "tests").glob("*.py")}  # what pytest puts on the path
    return roots - sys.stdlib_module_names - beside - {"ditr_lite"}


@per_file(PYTHON)
def test_every_third_party_import_is_declared(path):
    names = {DISTRIBUTIONS.get(root, root) for root in third_party_imports(path.read_text())}
    # pyrealsense2: extra "live", for a device that the tests do not have
    assert names - set(ranges()) - {"pyrealsense2"} == set()


def test_environment_installs_the_package_and_no_torchvision():
    text = (ROOT / "environment.txt").read_text()
    assert "\n-e .\n" in text
    assert "torchvision" not in text + (ROOT / "pyproject.toml").read_text()


def test_python_range_fits_this_interpreter():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert SpecifierSet(project["requires-python"]).contains(".".join(map(str, sys.version_info[:3])))


def test_ci_runs_the_test_target():
    script = ROOT / ".ci" / "run"
    assert os.access(script, os.X_OK) and "make test" in script.read_text()
