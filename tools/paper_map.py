"""Write PAPER_MAP.md, the page that says where each part of the paper is, from ditr_lite/papermap_entries.py.

python tools/paper_map.py [--check]
"""

import argparse
import sys
from pathlib import Path

from ditr_lite import papermap

ROOT = Path(__file__).resolve().parents[1]


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return 1 when an entry is not what it says, or, with --check, the page is out of date."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="write nothing, only say whether all is well")
    options = parser.parse_args(arguments)
    entries, path = papermap.entries(), ROOT / "PAPER_MAP.md"
    problems = [problem for entry in entries for problem in papermap.problems(entry, ROOT)]
    text = papermap.page(entries)
    if not options.check:
        path.write_text(text, encoding="utf-8")
    elif not path.is_file() or path.read_text(encoding="utf-8") != text:
        problems.append("PAPER_MAP.md is out of date; run python tools/paper_map.py")
    print(*problems, sep="\n", end="\n" if problems else "", file=sys.stderr)
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
