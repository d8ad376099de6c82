"""Put the badges of Binder, Colab and CI into the README, for the place where this repository is published.

    python tools/badges.py [OWNER/NAME]

Without a name, it is that of the GitHub repository from which this clone comes. Run it once after publishing.
"""

import argparse
import os
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
BEGIN, END = "<!-- badges: tools/badges.py -->", "<!-- end of badges -->"
BADGES = """\
[![test](https://github.com/{name}/actions/workflows/test.yml/badge.svg)](https://github.com/{name}/actions)
[![Open in Binder](https://mybinder.org/badge_logo.svg)](https://mybinder.org/v2/gh/{name}/main?labpath=notebooks%2F00_start_here.ipynb)
[![Open in Colab](https://colab.research.google.com/assets/colab-badge.svg)](https://colab.research.google.com/github/{name}/blob/colab/00_start_here.ipynb)"""


def origin() -> str | None:
    """Return OWNER/NAME of the GitHub repository that this clone comes from, or None."""
    command = ["git", "remote", "get-url", "origin"]
    address = subprocess.run(command, cwd=ROOT, capture_output=True, text=True).stdout.strip()
    found = re.search(r"github\.com[:/]([\w.-]+/[\w.-]+?)(?:\.git)?$", address)
    return found.group(1) if found else None


def with_badges(page: str, name: str) -> str:
    """Return a page with the badges between its two marks.

    Raises:
        ValueError: for a name that is not OWNER/NAME, and for a page without the marks.
    """
    if not re.fullmatch(r"[\w.-]+/[\w.-]+", name):
        raise ValueError(f"OWNER/NAME is wanted, got {name!r}")
    if page.count(BEGIN) != 1 or page.count(END) != 1:
        raise ValueError(f"README.md should have {BEGIN} and {END}, once each")
    before, rest = page.split(BEGIN)
    return f"{before}{BEGIN}\n{BADGES.format(name=name)}\n{END}{rest.split(END)[1]}"


def main(arguments: list[str]) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", nargs="?", metavar="OWNER/NAME", help="of the repository (where this clone comes from)")
    name = parser.parse_args(arguments).name or origin()
    if name is None:
        print("badges: this clone comes from no GitHub repository; give OWNER/NAME", file=sys.stderr)
        return 2
    readme = ROOT / "README.md"
    try:
        page = with_badges(readme.read_text(encoding="utf-8"), name)
    except (OSError, ValueError) as error:
        print(f"badges: {error}", file=sys.stderr)
        return 2
    part = readme.with_suffix(".part")
    part.write_text(page, encoding="utf-8")
    os.replace(part, readme)
    print(f"README.md has the badges of {name}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
