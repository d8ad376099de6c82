"""Build the book: notebooks, reference and results as a static site that asks no network and runs nothing.

    python book/build.py [--out outputs/book] [notebook ...]

The pages are gathered in a folder of their own, which Sphinx then reads: notebooks as they were saved, but for what
``notebook_pages`` says; pages of ``book/``; and what ``generated_pages`` makes of the repository's own files.
"""

import argparse
import shutil
import sys
import tempfile
from pathlib import Path

import generated_pages
import notebook_pages

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent


def gather(source: Path, notebooks: list[Path]) -> None:
    """Write every page of the book into the folder ``source``, which is empty.

    Raises:
        ValueError: for a notebook whose solution markers do not pair up, naming it.
    """
    for page in sorted(HERE.glob("*.md")):
        shutil.copy(page, source / page.name)
    for path in notebooks:
        notebook_pages.write(path, source)
    for path in sorted((ROOT / "notebooks").glob("*.md")):  # pages for the person who teaches
        text = notebook_pages.book_links(path.read_text(encoding="utf-8"))
        (source / "notebooks" / path.name).write_text(text, encoding="utf-8")
    generated_pages.write_all(ROOT, source, [path.stem for path in notebooks])


def build(out: Path, notebooks: list[Path]) -> int:
    """Build the site at ``out``, replacing what is there only when all went well; return Sphinx's exit status.

    Raises:
        ValueError: for a notebook whose solution markers do not pair up, naming it.
    """
    from sphinx.cmd.build import build_main  # half a second: not for --help

    part = out.with_name(out.name + ".part")
    shutil.rmtree(part, ignore_errors=True)
    with tempfile.TemporaryDirectory() as folder:
        source, doctrees = Path(folder) / "source", Path(folder) / "doctrees"
        source.mkdir()
        gather(source, notebooks)
        options = ["-q", "-W", "--keep-going", "-c", str(HERE), "-d", str(doctrees)]
        status = build_main([*options, str(source), str(part / "book")])  # MyST-NB writes beside it
    if status == 0:
        shutil.rmtree(out, ignore_errors=True)
        (part / "book").rename(out)
        shutil.rmtree(part)
    return status


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("notebooks", nargs="*", type=Path, help="default: all in notebooks/")
    parser.add_argument("--out", type=Path, default=ROOT / "outputs" / "book", help="default: outputs/book")
    options = parser.parse_args(arguments)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    try:
        status = build(options.out, options.notebooks or sorted((ROOT / "notebooks").glob("*.ipynb")))
    except (OSError, ValueError) as error:
        print(f"book: {error}", file=sys.stderr)
        return 1
    if status:
        print(f"book: Sphinx complained (above); {options.out} is as it was", file=sys.stderr)
        return 1
    print(f"open {options.out / 'index.html'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
