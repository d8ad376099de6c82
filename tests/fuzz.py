"""Damage files of every kind and hand them to every reader: each returns or raises a ValueError in one line.

    python tests/fuzz.py [--files 20000] [--seed 0] [--batch 1000]

Pictures, depth maps, masks, cameras, scenes, frames in the layouts of the real datasets, weights. Batches run in
processes of their own, so a crash or a hang of one is counted, with the seed that repeats it, and the others go on.
``test_fuzz.py`` tries a few hundred files.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import input_cases
import numpy as np

from ditr_lite import data, datasets, files, pipeline, store
from ditr_lite.config import preset
from ditr_lite.datasets import export

SLOWEST_S = 10.0
PATIENCE_S = 2.0  # a file, on average, before a batch counts as hung
SIZE = (24, 32)
SINGLE = {
    "depth": files.read_depth,
    "container": files.read_depth,
    "colour": files.read_rgb,
    "mask": files.read_mask,
    "camera": lambda path: files.read_intrinsics(path, input_cases.SIZE),
}


class Target(NamedTuple):
    """A file to damage: the files about it, its path among them, and what reads them, given their folder."""

    kind: str
    folder: dict[str, bytes]
    path: str
    read: Callable[[Path], object]


def contents(folder: Path) -> dict[str, bytes]:
    """Return relative path -> bytes of all files in a folder."""
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def sample() -> data.Sample:
    """Return a small scene."""
    rng = np.random.default_rng(0)
    truth = np.tile(np.linspace(0.5, 0.7, SIZE[1], dtype=np.float32), (SIZE[0], 1))
    material = np.zeros(SIZE, np.uint8)
    material[8:16, 10:20] = data.TRANSPARENT
    depth = np.where(rng.random(SIZE) < 0.1, 0, truth + 0.03 * (material > 0)).astype(np.float32)
    rgb = rng.integers(0, 255, (*SIZE, 3), np.uint8)
    more = {"camera": input_cases.CAMERA, "material": material, "instances": material, "meta": {"seed": 1}}
    return data.Sample("val_00000", rgb, depth, truth, material > 0, **more)


def single_files(work: Path) -> Iterator[Target]:
    """Yield a target for every file of the table of inputs that a reader takes."""
    for case in input_cases.table():
        kind = case.name.partition("|")[0]
        if kind not in SINGLE or "absent" in case.name:
            continue
        name = f"m{Path(case.name).suffix}"
        case.write(work / name)
        whole = {name: (work / name).read_bytes()}
        (work / name).unlink()
        yield Target(kind, whole, name, lambda folder, n=name, read=SINGLE[kind]: read(folder / n))


def folders(work: Path) -> Iterator[Target]:
    """Yield a target for every file of a scene, of a frame in every dataset's layout, and of a weights folder."""
    scene = sample()
    data.save_sample(scene, work / "scene")
    kinds = {"scene": (contents(work / "scene"), data.read_sample)}
    for name, reader in datasets.REGISTRY.items():
        export.export(name, work / name, [scene], "val")
        kinds[name] = contents(work / name), lambda folder, reader=reader: reader(folder)[0]
    config = preset("tiny")
    for name in ("region", "detail"):  # the smallest; all parts are read alike
        store.save_part(name, pipeline.build(config)[name].state_dict(), config, work / "weights", {})
    kinds["weights"] = contents(work / "weights"), lambda folder: store.load_part("region", folder)
    for kind, (whole, read) in kinds.items():
        yield from (Target(kind, whole, path, read) for path in whole if "detail" not in path)


def mutated(content: bytes, rng: np.random.Generator) -> bytes:
    """Return bytes with some changed, cut out, put in twice, or replaced by extremes."""
    changed = bytearray(content)
    for _ in range(int(rng.integers(1, 6))):
        if not changed:
            break
        at, length = int(rng.integers(len(changed))), int(rng.integers(1, 1 + min(64, len(changed))))
        kind = rng.integers(5)
        if kind == 0:
            changed[at] = int(rng.integers(256))
        elif kind == 1:
            del changed[at : at + length]
        elif kind == 2:
            changed[at:at] = changed[at : at + length]
        elif kind == 3:
            changed[at : at + 4] = bytes([int(rng.choice([0, 127, 128, 255]))] * 4)
        else:
            del changed[at:]
    return bytes(changed)


def attempt(target: Target, folder: Path, rng: np.random.Generator) -> str:
    """Damage a target's file, read it, and return "read", "refused", or what went wrong."""
    (folder / target.path).write_bytes(mutated(target.folder[target.path], rng))
    begun = time.monotonic()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            target.read(folder)
        outcome = "read"
    except ValueError as error:
        outcome = "refused" if "\n" not in str(error) else f"{target.path}: several lines: {str(error)[:200]!r}"
    except Exception as error:
        outcome = f"{target.path}: {type(error).__name__}: {str(error)[:200]}"
    (folder / target.path).write_bytes(target.folder[target.path])
    took = time.monotonic() - begun
    return outcome if took < SLOWEST_S else f"{target.path}: {took:.0f} s"


def fuzz(count: int, seed: int) -> Counter:
    """Damage ``count`` files in turn and count (kind, outcome)."""
    rng, found = np.random.default_rng(seed), Counter()
    with tempfile.TemporaryDirectory() as work, tempfile.TemporaryDirectory() as place:
        targets = [*single_files(Path(work)), *folders(Path(work))]
        first = int(rng.integers(len(targets)))
        for k in range(first, first + count):
            target = targets[k % len(targets)]
            folder = Path(place) / str(k % len(targets))
            if not folder.exists():
                for path, content in target.folder.items():
                    (folder / path).parent.mkdir(parents=True, exist_ok=True)
                    (folder / path).write_bytes(content)
            found[target.kind, attempt(target, folder, rng)] += 1
    return found


def batch(count: int, seed: int) -> Counter:
    """Do as :func:`fuzz`, in a process of its own; a crash and a hang are outcomes, too."""
    command = [sys.executable, __file__, "--files", str(count), "--seed", str(seed), "--here"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=60 + PATIENCE_S * count)
    except subprocess.TimeoutExpired:
        return Counter({("batch", f"seed {seed}: hung"): 1})
    if done.returncode:
        return Counter({("batch", f"seed {seed}: ended with {done.returncode}: {done.stderr[-200:]}"): 1})
    return Counter({(kind, outcome): n for kind, outcome, n in json.loads(done.stdout)})


def main() -> int:
    """Run the command line and print counts; return 1 where anything went wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--files", type=int, default=20_000, help="damaged files to try (%(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the damage (%(default)s)")
    parser.add_argument("--batch", type=int, default=1000, help="files a process (%(default)s)")
    parser.add_argument("--here", action="store_true", help="in this process; print JSON")
    options = parser.parse_args()
    if options.here:
        print(json.dumps([[*key, n] for key, n in fuzz(options.files, options.seed).items()]))
        return 0
    found = Counter()
    for k, start in enumerate(range(0, options.files, options.batch)):
        found += batch(min(options.batch, options.files - start), options.seed + k)
    kinds = dict.fromkeys(kind for kind, _ in found)
    print(f"{'kind':22}{'read':>8}{'refused':>9}{'wrong':>7}")
    for kind in kinds:
        counts = {outcome: n for (of, outcome), n in found.items() if of == kind}
        good = counts.pop("read", 0), counts.pop("refused", 0)
        print(f"{kind:22}{good[0]:8}{good[1]:9}{sum(counts.values()):7}")
        for outcome, n in counts.items():
            print(f"    {n} x {outcome}")
    wrong = sum(n for (_, outcome), n in found.items() if outcome not in ("read", "refused"))
    print(f"{found.total()} damaged files, {wrong} crashed, hung, or raised anything but one line")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
