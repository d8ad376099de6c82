"""Pack what a class needs into one archive that installs with no network: packages, repository, book and slides.

    python tools/offline_kit.py [--full] [--for PLATFORM PYTHON] [--out FILE.zip]

The kit is for this machine's system and Python, or with ``--for win_amd64 3.12`` (pip's names of platforms) for others.
It holds the light set of environment-class.txt, with ``--full`` that of environment.txt; the repository as it was last
committed; the book and the slides where they have been built (``make book slides``). Unpacked, it is installed with

    python install.py
"""

import argparse
import io
import os
import platform
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from email.parser import BytesParser
from pathlib import Path

from packaging.markers import default_environment
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name, parse_wheel_filename

ROOT = Path(__file__).resolve().parents[1]
TOP = "ditr_lite_offline"
PAGES = ("book", "slides")
SAFELY = {"filter": "data"} if hasattr(tarfile, "data_filter") else {}  # of extractall; Python before 3.11.4 has none
SYSTEMS = {  # how pip's names of platforms begin -> os.name, sys.platform, platform.system()
    "win": ("nt", "win32", "Windows"),
    "macosx": ("posix", "darwin", "Darwin"),
    "manylinux": ("posix", "linux", "Linux"),
    "linux": ("posix", "linux", "Linux"),
}
INSTALL = '''"""Install ditr_lite from this folder, without a network, into ditr_lite/.venv: python install.py"""

import os
import subprocess
import sys
from pathlib import Path

here = Path(__file__).resolve().parent
if sys.version_info[:2] != {python}:
    sys.exit("this kit is for Python {version}, and this is " + sys.version.split()[0])
offline = {{"PIP_NO_INDEX": "1", "PIP_FIND_LINKS": (here / "wheels").as_uri(), "PIP_DISABLE_PIP_VERSION_CHECK": "1"}}
command = [sys.executable, str(here / "ditr_lite" / "tasks.py"), "{task}"]
code = subprocess.run(command, env={{**os.environ, **offline}}).returncode
print("now:  cd ditr_lite  and  " + Path(sys.executable).name + " tasks.py lab" if code == 0 else "not installed")
sys.exit(code)
'''
README = """ditr_lite without a network, for Python {version} on {platform}

1. Unpack this archive.         2. python install.py         3. cd ditr_lite; python tasks.py lab

wheels/     the packages that install.py takes
ditr_lite/  the repository; its README says more
book/       the notebooks as web pages: open index.html (if it was built)
slides/     a deck for each notebook (if they were built)
"""


def download(requirements: Path, folder: Path, target: tuple[str, str] | None) -> None:
    """Fetch the wheels of a requirements file, and of all that these need, into ``folder``.

    Raises:
        OSError: when pip fails; what it says goes to the screen.
    """
    # Without "-e .": the package itself is in the kit as its repository.
    lines = [line for line in requirements.read_text(encoding="utf-8").splitlines() if not line.startswith("-e")]
    wanted = folder / "wanted.txt"
    wanted.write_text("\n".join([*lines, "setuptools>=77"]) + "\n", encoding="utf-8")
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--only-binary=:all:"]
    if target:
        command += ["--platform", target[0], "--python-version", target[1]]
    asked = ["-r", str(wanted)]
    try:
        while asked:
            subprocess.run([*command, "--dest", str(folder), *asked], check=True)
            asked = still_missing(folder, target) if target else []
    except subprocess.CalledProcessError as error:
        raise OSError(f"pip could not fetch all packages (exit code {error.returncode})") from None
    finally:
        wanted.unlink()


def system_of(name: str) -> tuple[str, str, str]:
    """Return os.name, sys.platform and platform.system() of one of pip's platforms, such as win_amd64.

    Raises:
        ValueError: for an unknown one.
    """
    for begin, system in SYSTEMS.items():
        if name.startswith(begin):
            return system
    raise ValueError(f"--for: expected a platform that begins with {', '.join(SYSTEMS)}, got {name!r}")


def still_missing(folder: Path, target: tuple[str, str]) -> list[str]:
    """Return what the wheels of a folder need on another system and is not there.

    pip asks the system that it runs on what a package needs: a kit for Windows would lack what only Windows needs.
    """
    system = system_of(target[0])
    there = default_environment() | dict(zip(("os_name", "sys_platform", "platform_system"), system, strict=True))
    there |= {"python_version": target[1], "python_full_version": f"{target[1]}.0", "extra": ""}
    wheels = {parse_wheel_filename(path.name)[0]: path for path in folder.glob("*.whl")}
    missing = {}
    for path in wheels.values():
        with zipfile.ZipFile(path) as archive:
            name = next(name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
            needs = BytesParser().parsebytes(archive.read(name)).get_all("Requires-Dist", [])
        for need in map(Requirement, needs):
            here = need.marker is None or need.marker.evaluate(there)
            if here and canonicalize_name(need.name) not in wheels:
                missing[canonicalize_name(need.name)] = f"{need.name}{need.specifier}"
    return sorted(missing.values())


def repository(folder: Path) -> None:
    """Write the repository as it was last committed into ``folder``.

    Raises:
        OSError: outside a clone.
    """
    done = subprocess.run(["git", "archive", "HEAD"], cwd=ROOT, capture_output=True)
    if done.returncode:
        raise OSError(f"the kit is made from a clone: {done.stderr.decode(errors='replace').strip()}")
    with tarfile.open(fileobj=io.BytesIO(done.stdout)) as archive:
        archive.extractall(folder, **SAFELY)


def pack(files: dict[str, Path | str], target: Path) -> None:
    """Write a zip file of name -> file or text; what is compressed already is only stored."""
    part = target.with_name(target.name + ".part")
    with zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, source in files.items():
            if isinstance(source, str):
                archive.writestr(f"{TOP}/{name}", source)
                continue
            is_packed = source.suffix in {".whl", ".png", ".jpg", ".safetensors"}
            archive.write(source, f"{TOP}/{name}", zipfile.ZIP_STORED if is_packed else zipfile.ZIP_DEFLATED)
    os.replace(part, target)


def below(folder: Path, name: str) -> dict[str, Path]:
    """Return all files below a folder, by their names in the kit, where the folder is called ``name``."""
    found = sorted(path for path in folder.rglob("*") if path.is_file())
    return {f"{name}/{path.relative_to(folder).as_posix()}": path for path in found}


def build(target: Path, full: bool, foreign: tuple[str, str] | None) -> None:
    """Collect everything in a temporary folder and pack it.

    Raises:
        OSError: when a package or the repository cannot be had.
        ValueError: for an unknown platform.
    """
    if foreign:
        system_of(foreign[0])  # before anything is fetched
    version = foreign[1] if foreign else f"{sys.version_info.major}.{sys.version_info.minor}"
    words = {
        "version": version,
        "python": tuple(map(int, version.split("."))),
        "platform": foreign[0] if foreign else f"{platform.system()} {platform.machine()}",
        "task": "setup" if full else "class",
    }
    with tempfile.TemporaryDirectory() as temporary:
        wheels, clone = Path(temporary, "wheels"), Path(temporary, "ditr_lite")
        wheels.mkdir()
        repository(clone)
        download(ROOT / ("environment.txt" if full else "environment-class.txt"), wheels, foreign)
        files: dict[str, Path | str] = {"README.txt": README.format(**words), "install.py": INSTALL.format(**words)}
        files |= below(wheels, "wheels") | below(clone, "ditr_lite")
        for page in PAGES:
            files |= below(ROOT / "outputs" / page, page)
        target.parent.mkdir(parents=True, exist_ok=True)
        pack(files, target)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--full", action="store_true", help="everything of environment.txt, not only the light set")
    parser.add_argument("--for", nargs=2, dest="foreign", metavar=("PLATFORM", "PYTHON"), help="win_amd64 3.12")
    parser.add_argument("--out", type=Path, help=f"default: outputs/{TOP}.zip")
    options = parser.parse_args(arguments)
    target = options.out or ROOT / "outputs" / f"{TOP}.zip"
    try:
        build(target, options.full, options.foreign and tuple(options.foreign))
    except (OSError, ValueError) as error:
        print(f"offline_kit: {error}", file=sys.stderr)
        return 1
    for page in PAGES:
        if not (ROOT / "outputs" / page).is_dir():
            print(f"without the {page}: `make {page}` was not run")
    print(f"{target}: {target.stat().st_size / 1e6:.0f} MB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
