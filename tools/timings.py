"""Measure how long each notebook computes and how much memory it takes on two cores; put the table where it is read.

    python tools/timings.py [--check | --tables] [notebook ...]

Each notebook runs in a fresh kernel on two cores; its file stays as it is. Seconds and the peak of the kernel's memory
(resident, sampled ten times a second) go into notebooks/timings.json, and from there into the tables of README.md and
notebooks/INSTRUCTOR.md. ``--tables`` only writes the tables again, ``--check`` only says whether they are up to date.
"""

import argparse
import json
import os
import platform
import re
import sys
import threading
import time
from pathlib import Path

import nbformat
import psutil
from nbclient import NotebookClient

ROOT = Path(__file__).resolve().parents[1]
CORES = 2
BUSY = 20  # per cent of all cores, above which other programs spoil the times
PAGES = ("README.md", "notebooks/INSTRUCTOR.md")
BEGIN, END = "<!-- timings: tools/timings.py -->", "<!-- end of timings -->"
HEADING = re.compile(r"^#+ +(.+)$", re.MULTILINE)


class PeakMemory(threading.Thread):
    """Watch the resident memory of all processes that this one starts from now on; ``peak`` is their largest sum."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.peak, self._ended = 0, threading.Event()
        self._others = {process.pid for process in psutil.Process().children(recursive=True)}

    def run(self) -> None:
        """Sample until ``stop`` is called."""
        while not self._ended.wait(0.1):
            started = [p for p in psutil.Process().children(recursive=True) if p.pid not in self._others]
            self.peak = max(self.peak, sum(map(_resident, started)))

    def stop(self) -> int:
        """End the watch and return the peak in bytes."""
        self._ended.set()
        self.join()
        return self.peak


def _resident(process: psutil.Process) -> int:
    try:
        return process.memory_info().rss
    except psutil.Error:  # it has just ended
        return 0


def measure(path: Path) -> dict:
    """Run a notebook and return its seconds, peak memory in MB, and the part of it that takes longest.

    Raises:
        nbclient.exceptions.CellExecutionError: when a cell raises.
    """
    notebook = nbformat.read(path, as_version=4)
    parts: dict[str, float] = {}
    heading, began = [""], [0.0]

    def start(cell, cell_index):
        found = [HEADING.findall(c.source) for c in notebook.cells[:cell_index] if c.cell_type == "markdown"]
        heading[0] = next((names[-1] for names in reversed(found) if names), "")
        began[0] = time.perf_counter()

    def note(cell, cell_index, **_):
        parts[heading[0]] = parts.get(heading[0], 0) + time.perf_counter() - began[0]

    place = {"metadata": {"path": str(path.parent)}}
    watch = PeakMemory()
    watch.start()
    try:
        client = NotebookClient(notebook, timeout=600, resources=place, on_cell_start=start, on_cell_executed=note)
        client.execute()
    finally:
        peak = watch.stop()
    slowest = max(parts, key=parts.get)
    return {
        "seconds": round(sum(parts.values()), 1),
        "peak_memory_mb": round(peak / 1e6),
        "slowest_part": slowest,
        "slowest_part_seconds": round(parts[slowest], 1),
    }


def table(timings: dict) -> str:
    """Return the table of all notebooks in Markdown, with a line that says where and how it was measured."""
    if not timings["notebooks"]:
        return "Not measured yet: `make timings`."
    lines = ["| notebook | seconds | peak memory | longest wait |", "|---|---:|---:|---|"]
    for name, row in sorted(timings["notebooks"].items()):
        wait = f"{row['slowest_part']}, {row['slowest_part_seconds']:.0f} s"
        lines.append(f"| {name} | {row['seconds']:.0f} | {row['peak_memory_mb']:,} MB | {wait} |")
    machine = timings["machine"]
    lines += ["", f"Computing only, on {CORES} cores of {machine['processor']}, {machine['python']}: `make timings`."]
    return "\n".join(lines)


def with_table(page: str, timings: dict) -> str:
    """Return a page with what stands between the two marks replaced by the table.

    Raises:
        ValueError: for a page without the two marks.
    """
    if page.count(BEGIN) != 1 or page.count(END) != 1 or page.index(BEGIN) > page.index(END):
        raise ValueError(f"the page should have {BEGIN} and {END}, once each and in this order")
    before, rest = page.split(BEGIN)
    return f"{before}{BEGIN}\n{table(timings)}\n{END}{rest.split(END)[1]}"


def outdated(timings: dict, write: bool) -> list[str]:
    """Return the pages whose table is not that of ``timings``; with ``write`` put it there."""
    found = []
    for name in PAGES:
        path = ROOT / name
        page = path.read_text(encoding="utf-8")
        wanted = with_table(page, timings)
        if wanted == page:
            continue
        found.append(name)
        if write:
            _write(path, wanted)
    return found


def _write(path: Path, text: str) -> None:
    part = path.with_name(path.name + ".part")
    part.write_text(text, encoding="utf-8")
    os.replace(part, path)


def _processor() -> str:
    """Return the processor's name as the system gives it."""
    try:
        found = re.search(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    except OSError:  # not Linux
        found = None
    return found.group(1) if found else platform.processor() or platform.machine()


def _on_two_cores() -> None:
    """Confine this process, and the kernels that it starts, to two cores, where the system can."""
    process = psutil.Process()
    if hasattr(process, "cpu_affinity"):  # not on macOS
        process.cpu_affinity(process.cpu_affinity()[:CORES])
    os.environ |= {"OMP_NUM_THREADS": str(CORES), "TQDM_DISABLE": "1"}


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("notebooks", nargs="*", type=Path, help="default: all in notebooks/")
    parser.add_argument("--check", action="store_true", help="only say whether the tables are up to date")
    parser.add_argument("--tables", action="store_true", help="only write the tables again")
    options = parser.parse_args(arguments)
    stored = ROOT / "notebooks" / "timings.json"
    timings = json.loads(stored.read_text(encoding="utf-8")) if stored.exists() else {"notebooks": {}}
    if not (options.check or options.tables):
        _on_two_cores()
        busy = psutil.cpu_percent(interval=1)
        if busy > BUSY:
            print(f"timings: the machine is busy ({busy:.0f} %), the times will be too long", file=sys.stderr)
        machine = {"processor": _processor(), "python": f"Python {platform.python_version()}"}
        if options.notebooks and timings.get("machine", machine) != machine:
            parser.error(f"the other times are of {timings['machine']}: name no notebook, to measure all on this one")
        timings["machine"] = machine
        for path in options.notebooks or sorted((ROOT / "notebooks").glob("*.ipynb")):
            timings["notebooks"][path.stem] = measure(path)
            print(path.stem, timings["notebooks"][path.stem], flush=True)
            _write(stored, json.dumps(timings, indent=1, ensure_ascii=False) + "\n")
    changed = outdated(timings, write=not options.check)
    if options.check and changed:
        print(f"timings: out of date, write it with --tables: {', '.join(changed)}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
