"""All that a reader does with this repository, one command each, on Linux, macOS and Windows; make only calls this.

    python tasks.py COMMAND [what the command is given]

`python tasks.py` lists the commands. The environment is built when it is first needed, in .venv; VENV names another
place, and the Python that runs this file (3.11 or newer) is the one it is built from. No command needs an activated
environment, make, or anything but Python's standard library to start.
"""

import hashlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent
VENV = ROOT / (os.environ.get("VENV") or ".venv")
PYTHON = VENV / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
OLDEST = (3, 11)
LIGHT, FULL = "environment-class.txt", "environment.txt"
NBVAL = [
    "--nbval-lax",
    "--nbval-current-env",
    "--nbval-cell-timeout=120",
    "--nbval-sanitize-with=tests/nbval_sanitize.cfg",
]
EXECUTE = ["-m", "nbconvert", "--execute", "--ExecutePreprocessor.record_timing=False"]
EXECUTE += ["--ExecutePreprocessor.timeout=600"]
PAGE = ["--to", "html", "--template", "page_template", "--TemplateExporter.extra_template_basedirs=tools"]
EXTENSIONS = ROOT / "tools" / "labextensions"  # JupyterLab's, which pictures owe their alternative text
NEWS = "@jupyterlab/apputils-extension:announcements"  # would ask the network, and the reader first
QUIET = {"TQDM_DISABLE": "1"}
PROCESSES = 2  # that test at the same time, a thread each: more would not fit into a laptop's memory


# --- the environment --------------------------------------------------------------------------------------------------


def stamp(requirements):
    """Return the file that says that an environment holds a set of packages; another content has another name."""
    content = (ROOT / requirements).read_bytes() + (ROOT / "pyproject.toml").read_bytes()
    return VENV / f".installed-{Path(requirements).stem}-{hashlib.sha256(content).hexdigest()[:12]}"


def install(requirements):
    """Bring the environment to a set of packages, in place; the light set counts as there when the full one is."""
    wanted = [stamp(requirements)] + ([stamp(FULL)] if requirements == LIGHT else [])
    if any(path.exists() for path in wanted):
        return
    if sys.version_info[:2] < OLDEST:
        sys.exit(f"Python 3.11 or newer is needed, this is {sys.version.split()[0]}: make PYTHON=python3.12")
    if not PYTHON.exists():
        call([sys.executable, "-m", "venv", str(VENV)])
    if requirements == LIGHT:
        python("-m", "pip", "install", "--quiet", "--no-compile", "-r", LIGHT)
        python("-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "-e", ".")
        slim()
    else:
        python("-m", "pip", "install", "--quiet", "-r", FULL)
    # `pip install -e` leaves out what pyproject.toml puts there
    shutil.copytree(EXTENSIONS, VENV / "share" / "jupyter" / "labextensions", dirs_exist_ok=True)
    for old in VENV.glob(f".installed-{Path(requirements).stem}-*"):
        old.unlink()
    stamp(requirements).touch()


def slim():
    """Remove what PyTorch brings for C++ programmers, and the tests of packages: 0.2 GB that no notebook uses."""
    for torch in VENV.glob("**/site-packages/torch"):
        for folder in ("include", "test"):
            shutil.rmtree(torch / folder, ignore_errors=True)
        for program in [*torch.glob("bin/*test*"), *torch.glob("bin/*Test*"), *torch.glob("bin/protoc*")]:
            program.unlink()
    for package in ("numpy", "scipy", "skimage", "sympy"):
        for folder in [*VENV.glob(f"**/site-packages/{package}/**/tests")]:
            shutil.rmtree(folder, ignore_errors=True)


# --- running ----------------------------------------------------------------------------------------------------------


def surroundings(extra=None):
    """Return the environment variables of everything that is run."""
    variables = {"OMP_NUM_THREADS": "2", **os.environ, **(extra or {})}
    variables.pop("MPLBACKEND", None)  # notebooks draw inline, everything else finds out that there is no display
    return variables


def call(command, extra=None, **options):
    """Run a command in the repository's root; end this process with its exit code when it fails."""
    code = subprocess.run(command, cwd=ROOT, env=surroundings(extra), **options).returncode
    if code:
        sys.exit(code)


def python(*arguments, extra=None):
    """Run the environment's Python."""
    call([str(PYTHON), *map(str, arguments)], extra)


def in_container():
    """Return whether this is a container: there, being root is usual and harms nobody."""
    return "container" in os.environ or any(map(os.path.exists, ("/.dockerenv", "/run/.containerenv")))


def notebooks():
    """Return all notebooks, in reading order."""
    return sorted(path.relative_to(ROOT) for path in ROOT.glob("notebooks/*.ipynb"))


# --- the commands -----------------------------------------------------------------------------------------------------


def setup(arguments):
    """Build the environment, with everything in it."""
    install(FULL)


def light(arguments):
    """Build the light environment of a class: notebooks 00-04, 06 and 07, without training, tests and simulator."""
    install(LIGHT)


def lab(arguments):
    """Open the notebooks in JupyterLab; ARGS may name another one, such as a student copy."""
    install(LIGHT if stamp(LIGHT).exists() else FULL)
    disable = [str(PYTHON), "-m", "jupyterlab.labextensions", "disable", "--level=sys_prefix", NEWS]
    subprocess.run(disable, cwd=ROOT, stderr=subprocess.DEVNULL)
    is_root = hasattr(os, "geteuid") and os.geteuid() == 0
    allowed = ["--allow-root"] if is_root and in_container() else []
    first = [] if any(word.endswith(".ipynb") for word in arguments) else ["notebooks/00_start_here.ipynb"]
    python("-m", "jupyterlab", "--notebook-dir=.", *allowed, *first, *arguments)


def demo(arguments):
    """Run the whole pipeline notebook, then print the score table of the first LIMIT test scenes."""
    install(FULL)
    python(*EXECUTE, *PAGE, "--output-dir", "outputs", "notebooks/06_full_pipeline.ipynb")
    limit = os.environ.get("LIMIT") or "16"
    python("-m", "ditr_lite", "bench", "--split", "test", "--limit", limit, "--json", "outputs/demo.json", *arguments)


def test(arguments):
    """Check everything: lint, unit tests, every notebook cell by cell."""
    lint([])
    shared = ["--numprocesses", PROCESSES, "--dist", "loadfile"]  # the cells of a notebook stay in one kernel
    threads = {"OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", "1")}
    python("-m", "pytest", *NBVAL, *shared, *arguments, extra=QUIET | threads)


def mutants(arguments):
    """Plant a mistake in every formula, one at a time: a test must notice (many minutes)."""
    install(FULL)
    python("tests/mutants.py", *arguments)


def lint(arguments):
    """Check ruff's rules and format, notebooks included."""
    install(FULL)
    python("-m", "ruff", "check", ".")
    python("-m", "ruff", "format", "--check", ".")


def execute(arguments):
    """Execute all notebooks in place, in order."""
    install(FULL)
    python(*EXECUTE, "--to", "notebook", "--inplace", *notebooks(), *arguments, extra=QUIET)


def students(arguments):
    """Write copies of the notebooks without the solutions, into outputs/student."""
    install(LIGHT)
    python("tools/student_copy.py", *arguments)


def grade(arguments):
    """Run the notebooks in a folder that students handed in, and write what the checkers say as CSV."""
    install(LIGHT)
    python("tools/grade.py", *arguments)


def slides(arguments):
    """Write a deck of slides for each notebook, into outputs/slides."""
    install(LIGHT)
    python("tools/slides.py", *arguments)


def timings(arguments):
    """Measure seconds and memory of each notebook on two cores, and write the tables."""
    install(FULL)
    python("tools/timings.py", *arguments)


def book(arguments):
    """Write all notebooks, a reference and more as a site that needs no network, into outputs/book."""
    install(FULL)
    python("book/build.py", *arguments)


def offline_kit(arguments):
    """Pack packages, repository, book and slides into one archive that installs without a network, in outputs."""
    install(FULL)
    python("tools/offline_kit.py", *arguments)


def samples(arguments):
    """Render the shipped scenes again, into outputs/samples."""
    install(FULL)
    python("-m", "ditr_lite", "simulate", "--out", "outputs/samples", *arguments)


def train(arguments):
    """Train every part from the rendered scenes, into outputs/weights/lite or where --out says."""
    install(FULL)
    python("-m", "ditr_lite", "train", "--part", "all", *arguments)


def bench(arguments):
    """Score the shipped weights and every baseline on the whole test split."""
    install(FULL)
    python("-m", "ditr_lite", "bench", "--split", "test", "--json", "outputs/bench.json", *arguments)


def soak(arguments):
    """Put the system through large frames, full disks, damaged files and kills, and print the table (15 minutes)."""
    install(FULL)
    python("tools/soak.py", "--json", "outputs/soak.json", *arguments)


def clean(arguments):
    """Remove what is quickly made again; rendered scenes, training, copies for students and the environment stay."""
    for pattern in ("book", "slides", "*.html", "*.json"):
        for path in ROOT.glob(f"outputs/{pattern}"):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    for name in (".pytest_cache", ".ruff_cache", ".hypothesis"):
        shutil.rmtree(ROOT / name, ignore_errors=True)


COMMANDS = {
    "setup": setup,
    "class": light,
    "lab": lab,
    "demo": demo,
    "test": test,
    "mutants": mutants,
    "lint": lint,
    "notebooks": execute,
    "students": students,
    "grade": grade,
    "slides": slides,
    "timings": timings,
    "book": book,
    "offline-kit": offline_kit,
    "samples": samples,
    "train": train,
    "bench": bench,
    "soak": soak,
    "clean": clean,
}


def main(arguments):
    """Run one command, or list all."""
    name, *rest = arguments or ["help"]
    if name in ("help", "-h", "--help"):
        print("\n".join(f"{known:<13}{function.__doc__}" for known, function in COMMANDS.items()))
        return
    if name not in COMMANDS:
        sys.exit(f"tasks: no command {name!r}; there are: {', '.join(COMMANDS)}")
    COMMANDS[name](rest)


if __name__ == "__main__":
    main(sys.argv[1:])
