"""The repository's own rules: who imports whom, public names, pins, no pickles."""

import ast
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import NamedTuple

import nbformat
import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

import ditr_lite

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "ditr_lite"
SOURCES = {p.relative_to(PACKAGE).as_posix(): p.read_text(encoding="utf-8") for p in sorted(PACKAGE.rglob("*.py"))}
PYTHON = sorted(p for folder in (PACKAGE, ROOT / "tests", ROOT / "tools") for p in folder.rglob("*.py"))
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
BESIDE = {path.stem for folder in ("tests", "tools") for path in (ROOT / folder).glob("*.py")}  # on pytest's path
CLOSED = ("exercises", "peers", "cli")  # rooms that no other place of the package imports, save __main__
# Where the name that is imported is not the one that is installed; drjit comes with mitsuba, which pins it.
DISTRIBUTIONS = {
    "PIL": "pillow",
    "kubernetes_validate": "kubernetes-validate",
    "yaml": "pyyaml",
    "cv2": "opencv-python-headless",
    "drjit": "mitsuba",
    "skimage": "scikit-image",
}


def faults(check, paths):
    """Return {file: what ``check(path)`` found in it} for the files in which it found something."""
    found = {path.relative_to(ROOT).as_posix(): check(path) for path in paths}
    return {name: wrong for name, wrong in found.items() if wrong}


# --- the package ------------------------------------------------------------------------------------------------------


class Import(NamedTuple):
    """One import of something of the package: by which file, of which module, which name of it (None: the module)."""

    file: str
    module: str
    name: str | None


def dotted(file):
    """Return the module that a file of the package is: viz/grids.py is viz.grids, viz/__init__.py is viz."""
    return file.removesuffix(".py").replace("/", ".").removesuffix("__init__").removesuffix(".")


def imports(file, files):
    """Yield every :class:`Import` of ``file``, wherever in it; relative ones counted from where it stands."""
    modules = {dotted(name) for name in files}
    for node in ast.walk(ast.parse(files[file])):
        if isinstance(node, ast.Import):
            yield from (
                Import(file, alias.name.removeprefix("ditr_lite").removeprefix("."), None)
                for alias in node.names
                if alias.name.split(".")[0] == "ditr_lite"
            )
        elif isinstance(node, ast.ImportFrom) and (node.level or node.module.split(".")[0] == "ditr_lite"):
            base = file.split("/")[: -node.level] if node.level else []
            inner = (node.module or "").split(".") if node.level else node.module.split(".")[1:]
            source = ".".join([*base, *filter(None, inner)])
            for alias in node.names:
                module = f"{source}.{alias.name}".lstrip(".")
                yield Import(file, module, None) if module in modules else Import(file, source, alias.name)


def is_relative(tree):
    """Return whether a syntax tree names the package by its absolute name in no import."""
    nodes = list(ast.walk(tree))
    names = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    names += [node.module for node in nodes if isinstance(node, ast.ImportFrom) and not node.level]
    return "ditr_lite" not in {name.split(".")[0] for name in names}


def private_uses(tree):
    """Return the names with a leading underscore that a syntax tree takes from another file of the package."""
    own = [n for n in ast.walk(tree) if isinstance(n, ast.ImportFrom) and (n.level or n.module.startswith("ditr_lite"))]
    aliases = [alias for node in own for alias in node.names]
    found = [alias.name for alias in aliases if is_private(alias.name)]
    local = {alias.asname or alias.name for alias in aliases}
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in local:
            found += [node.attr] * is_private(node.attr)
    return found


def is_private(name):
    return name.startswith("_") and not name.startswith("__")


def cycle(graph):
    """Return modules that import each other in a circle, or [] when there are none."""
    left = dict(graph)
    while free := [module for module, used in left.items() if not used & left.keys()]:
        for module in free:
            del left[module]
    return sorted(left)


def broken_rules(files, order):
    """Return a sentence for everything in ``files`` (path -> source) that the import rule forbids.

    A place is a file on top or a folder, a room. A file imports only from places that stand before its own in
    ``order``, or from its own room, in which imports make no circle. Nothing but ``__main__`` imports a closed room.
    """
    order, wrong = (*order, "__main__"), []
    within = {dotted(file): set() for file in files}
    for file, source in files.items():
        module, tree = dotted(file), ast.parse(source)
        place = module.split(".")[0]
        if not is_relative(tree):
            wrong.append(f"{file} imports the package by its absolute name")
        wrong += [f"{file} uses the private {name} of another file" for name in private_uses(tree)]
        if place and place not in order:
            wrong.append(f"{file} is in no place: add {place!r} to ditr_lite.MODULES, after everything that it imports")
            continue
        for _, target, _ in imports(file, files):
            other = target.split(".")[0]
            before = order[: order.index(place)] if place else ()
            if other == place and "/" in file:
                within[module].add(target)
            elif other not in before:
                wrong.append(f"{file} imports {target or 'the package'}, which does not stand before it")
            elif other in CLOSED and place != "__main__":
                wrong.append(f"{file} imports {target}, a closed room")
    circle = cycle(within)
    return wrong + [f"imports in a circle: {', '.join(circle)}"] * bool(circle)


TOY = {"__init__.py": "", "before.py": "", "here.py": "", "after.py": "", "room/__init__.py": "from .a import x"}
TOY |= {"room/a.py": "", "room/b.py": "from .a import x\nfrom . import a\nfrom ..here import y\nfrom .. import before"}
TOY |= {"late/__init__.py": "", "late/c.py": "from ..room.b import x\nfrom ..room import a\nimport numpy"}
TOY |= {"cli/__init__.py": "from ..late import c", "__main__.py": "from .cli import main"}
PLACES = ("before", "here", "after", "room", "late", "cli")


def test_a_house_in_order_breaks_no_rule():
    assert broken_rules(TOY, PLACES) == []


@pytest.mark.parametrize(
    ("file", "line", "message"),
    [
        ("here.py", "from .after import x", "here.py imports after, which does not stand before"),
        ("here.py", "from . import after", "here.py imports after, which does not stand before"),
        ("here.py", "from .here import x", "here.py imports here, which does not stand before"),
        ("here.py", "from . import x", "here.py imports the package"),
        ("here.py", "def f():\n    from .after import x", "here.py imports after"),
        ("here.py", "from .room.a import x", "here.py imports room.a, which does not stand before"),  # top: no room
        ("__init__.py", "from .before import x", "__init__.py imports before"),
        ("room/a.py", "from ..late.c import x", "room/a.py imports late.c, which does not stand before"),
        ("room/a.py", "from .. import late", "room/a.py imports late, which does not stand before"),
        ("room/a.py", "from .b import x", "in a circle: room, room.a, room.b"),
        ("room/a.py", "from . import x", "in a circle: room, room.a"),
        ("late/c.py", "from ..cli.d import x", "late/c.py imports cli.d, which"),
        ("here.py", "from ditr_lite.before import x", "here.py imports the package by its absolute name"),
        ("here.py", "import numpy, ditr_lite.before as m", "here.py imports the package by its absolute name"),
        ("here.py", "from .before import _x", "here.py uses the private _x"),
        ("here.py", "from . import before\nbefore._x()", "here.py uses the private _x"),
        ("new.py", "", "new.py is in no place: add 'new'"),
    ],
)
def test_a_planted_violation_is_noticed(file, line, message):
    wrong = broken_rules({**TOY, file: line}, PLACES)
    assert any(message in sentence for sentence in wrong), wrong


def test_a_closed_room_is_entered_by_main_only():
    wrong = broken_rules({**TOY, "later.py": "from .cli import main"}, (*PLACES, "later"))
    assert wrong == ["later.py imports cli, a closed room"]


def test_imports_run_one_way():
    assert broken_rules(SOURCES, ditr_lite.MODULES) == []


def test_a_newcomer_meets_at_most_thirty_names():
    """Counted is what there is to read: not the face, the two lines of ``__main__`` or the weights, which are data."""
    found = {path.stem for path in PACKAGE.iterdir()} - {"__init__", "__main__", "__pycache__", "weights"}
    assert found == set(ditr_lite.MODULES) and len(ditr_lite.MODULES) == len(found) <= 30


# What may stand in two files, and why.
SHARED = {
    "load": {"boundary/learned.py", "boundary/sam.py"},  # what every boundary backend offers
    "add_arguments": {"cli/compare.py", "cli/complete.py", "cli/simulate.py"},  # what every command offers
    "run": {"cli/compare.py", "cli/complete.py", "cli/simulate.py"},  # likewise
}


def namesakes(files):
    """Return {name: files} of the public functions and classes that are defined at the top of more than one file."""
    homes = {}
    for file, source in files.items():
        for node in ast.parse(source).body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and not is_private(node.name):
                homes.setdefault(node.name, set()).add(file)
    return {name: places for name, places in homes.items() if len(places) > 1}


def test_a_public_name_means_one_thing():
    twice = "def fit(): ...\nclass Plan: ..."
    toy = {"a.py": twice, "b.py": "def fit(): ...\ndef _own(): ...", "c.py": "def _own(): ...\nx = 1"}
    assert namesakes(toy) == {"fit": {"a.py", "b.py"}}
    assert namesakes(SOURCES) == SHARED


# What a learner studies: the method, in the paper's order.
STUDIED = ("conditioning.py", "region/", "boundary/maps.py", "autoencoder.py", "schedule.py", "diffusion.py", "unet.py")
STUDIED += ("stage_two.py", "pipeline.py")
COMPREHENSIONS = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)


def dense(source):
    """Return the lines of ``source`` with an assignment inside an expression, or a comprehension in another one."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.NamedExpr):
            found.add(node.lineno)
        if isinstance(node, COMPREHENSIONS):
            inner = [part for part in ast.walk(node) if part is not node and isinstance(part, COMPREHENSIONS)]
            found |= {part.lineno for part in inner}
    return sorted(found)


def test_the_method_is_short_and_read_one_operation_at_a_time():
    assert dense("a = [x for x in y]\nb = {k: [x for x in v] for k, v in c}\nif (d := a):\n    pass") == [2, 3]
    studied = {file: source for file, source in SOURCES.items() if file.startswith(STUDIED)}
    assert {file: dense(source) for file, source in studied.items()} == dict.fromkeys(studied, [])
    assert len(studied) == 11 and sum(source.count("\n") for source in studied.values()) <= 2150


def test_no_tool_takes_a_private_name():
    tools = [p for p in PYTHON if ROOT / "tools" in p.parents]
    assert tools and faults(lambda path: private_uses(ast.parse(path.read_text(encoding="utf-8"))), tools) == {}


def test_import_is_lazy_and_unknown_names_are_refused():
    code = (
        "import sys, ditr_lite as dl; assert not {'torch', 'cv2', 'numpy'} & set(sys.modules); dl.load_sample; dl.data"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)
    with pytest.raises(AttributeError, match="no attribute 'no_such_name'"):
        _ = ditr_lite.no_such_name


def test_public_names_resolve():
    for name in ditr_lite.__all__:
        assert getattr(ditr_lite, name) is not None and name in dir(ditr_lite), name


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


def test_no_file_on_top_is_called_like_an_option():
    assert [path.name for path in ROOT.iterdir() if path.name.startswith("-")] == []  # `grep x *` would take it for one


def test_no_pickle():
    # tests may make a bad file to see it refused
    shipped = [p for p in (*PYTHON, *NOTEBOOKS) if ROOT / "tests" not in p.parents]
    assert len(shipped) > len(NOTEBOOKS) > 0 and faults(lambda path: unsafe_loading(source_of(path)), shipped) == {}


def test_weights_are_safetensors():
    files = [p for p in (PACKAGE / "weights").glob("*") if p.is_file() and not p.name.endswith(".part")]
    assert [p.name for p in files if p.suffix not in {".safetensors", ".json", ".md"} and p.name != "NOTICE"] == []


# --- the environment --------------------------------------------------------------------------------------------------


def pins():
    lines = (line.strip() for line in (ROOT / "environment.txt").read_text().splitlines())
    return [line for line in lines if line and not line.startswith(("#", "-e"))]


def ranges():
    """Return {name: version range} of everything that environment.txt must pin."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    pinned = ("notebooks", "simulate", "sam", "logs", "book", "dev")
    declared = [*project["dependencies"], *(line for extra in pinned for line in extras[extra])]
    return {requirement.name: requirement.specifier for requirement in map(Requirement, declared)}


def test_pins_are_exact_and_in_range():
    declared = ranges()
    for line in pins():
        assert re.fullmatch(r"[\w.-]+==\d[\w.]*", line), f"{line}: pin as name==version"
        name, version = line.split("==")
        assert name in declared, f"{line}: declare it in pyproject.toml as well"
        assert declared[name].contains(version), f"{line} is outside {declared[name]}"


def test_every_declared_dependency_is_pinned():
    assert {line.split("==")[0] for line in pins()} == set(ranges())


def third_party_imports(source):
    roots = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            roots |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            roots.add(node.module.split(".")[0])
    return roots - sys.stdlib_module_names - BESIDE - {"ditr_lite", "tasks"}


def test_every_third_party_import_is_declared():
    known = set(ranges()) | {"pyrealsense2"}  # extra "live", for a device that the tests do not have
    known |= {root for root, name in DISTRIBUTIONS.items() if name in known}
    assert third_party_imports("import numpy, torch.nn, os\nfrom PIL import Image\nfrom . import x") <= known
    assert third_party_imports("import no_such_package.part") - known == {"no_such_package"}
    assert faults(lambda path: third_party_imports(path.read_text(encoding="utf-8")) - known, PYTHON) == {}


OPTIONAL = ("accelerate", "jupyterlab", "IPython", "ipywidgets", "plotly", "psutil", "diffusers", "transformers")
OPTIONAL += ("mitsuba", "drjit", "pyrealsense2", "tensorboard")


def without_extras(code):
    """Run Python code in a process in which nothing can be imported that only an extra installs."""
    block = f"import sys; sys.modules.update(dict.fromkeys({OPTIONAL}))"  # None: ImportError
    command = [sys.executable, "-c", f"{block}\n{code}"]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True)


def test_every_module_is_imported_without_any_extra():
    modules = sorted({f"ditr_lite.{dotted(file)}".rstrip(".") for file in SOURCES} - {"ditr_lite.__main__"})
    done = without_extras(f"import importlib\nfor name in {modules}: importlib.import_module(name)\nprint('all')")
    assert done.stdout == "all\n", done.stderr
    for missing in ("plotly", "transformers"):  # the block blocks
        assert "ModuleNotFoundError" in without_extras(f"import {missing}").stderr


def test_a_frame_is_completed_without_any_extra():
    code = "import ditr_lite as dl; s = dl.load_sample(dl.list_samples('test')[0]); ditr = dl.Ditr.from_pretrained()\n"
    done = without_extras(code + "print((ditr(s.rgb, s.depth).depth > 0).all())")
    assert done.stdout == "True\n", done.stderr


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
