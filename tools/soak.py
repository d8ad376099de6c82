"""Put the system through what breaks programs, and print a table: large frames, a full disk, damaged files, kills.

    python tools/soak.py [--only WORD] [--seed N] [--json FILE]

``make soak`` runs it whole, within a quarter of an hour on two idle cores. A check is a function in
:data:`CHECKS` that is given a folder of its own and a generator, and returns how often it tried, how often what
happened was right, and what was measured. The exit code is 1 where anything was wrong.
"""

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import psutil

import ditr_lite as dl
from ditr_lite.cli.video import Steady
from ditr_lite.config import preset
from ditr_lite.data import load_sample, read_sample, save_sample
from ditr_lite.evaluation import results
from ditr_lite.evaluation.timing import peak_mb
from ditr_lite.files import read_json, write_depth, write_json, write_ply
from ditr_lite.pipeline import build
from ditr_lite.store import load_parts, save_part

COMMAND = [sys.executable, "-m", "ditr_lite"]
LARGE = ((3000, 4000), (6000, 8000))  # height, width
LIMIT_MB = 1000  # that a large frame may take, beyond what the process and the frame take
FLICKER_MM, FLICKER_SHARE, LAG = 4.0, 0.05, 0.1  # limits of video; of the first beyond 1 m, mm a metre
STILL = ("test_00000", "test_00003", "rooms_00006")  # scenes that are copied with noise
KILLS = 3
DAMAGES = 60
PATIENCE_S = 120


class Row(NamedTuple):
    """What a check found."""

    tried: int
    right: int
    measured: str = ""


def row(outcomes: list[bool], measured: str = "") -> Row:
    """Return a row of what was right or not."""
    return Row(len(outcomes), sum(map(bool, outcomes)), measured)


# --- memory and video -------------------------------------------------------------------------------------------------


def enlarged(size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return colour and depth of a scene at a size (H, W)."""
    scene = load_sample("test_00003")
    rgb = cv2.resize(scene.rgb, size[::-1], interpolation=cv2.INTER_CUBIC)
    return rgb, cv2.resize(scene.depth, size[::-1], interpolation=cv2.INTER_NEAREST)


def grown(call: Callable[[], object]) -> float:
    """Return by how many MB the process grows at the most during a call."""
    before = psutil.Process().memory_info().rss / 1e6
    return peak_mb(call) - before


def memory_of_large_frames(folder: Path, rng: np.random.Generator) -> Row:
    """A frame of 12 and of 48 megapixels takes at most 1 GB beyond the process and the frame."""
    ditr, taken = dl.Ditr.from_pretrained(), []
    ditr(*enlarged((192, 256)))
    for size in LARGE:
        rgb, depth = enlarged(size)
        taken.append(grown(lambda rgb=rgb, depth=depth: ditr(rgb, depth)))
    sizes = (f"{w} x {h}: {mb:.0f} MB" for (h, w), mb in zip(LARGE, taken, strict=True))
    return row([mb <= LIMIT_MB for mb in taken], ", ".join(sizes))


def memory_of_samples(folder: Path, rng: np.random.Generator) -> Row:
    """Sixteen samples take at most a tenth more memory than four."""
    ditr, frame = dl.Ditr.from_pretrained(), enlarged((720, 1280))
    ditr(*frame, samples=1)
    few, many = (peak_mb(lambda n=n: ditr(*frame, samples=n)) for n in (4, 16))
    return row([many <= 1.1 * few], f"peak {few:.0f} MB of 4, {many:.0f} MB of 16")


def copies(scene, count: int, rng: np.random.Generator, step: int = 0):
    """Yield noisy copies of a scene, each moved by ``step`` pixels more than the one before."""
    for k in range(count):
        rgb, depth = (np.roll(a, k * step, axis=1) for a in (scene.rgb, scene.depth))
        noisy = np.clip(rgb + rng.normal(0, 2, rgb.shape).round(), 0, 255).astype(np.uint8)
        lost = rng.random(depth.shape) < 0.01
        yield noisy, np.where(lost, 0, depth * (1 + rng.normal(0, 0.003, depth.shape))).astype(np.float32)


def video_holds_still(folder: Path, rng: np.random.Generator) -> Row:
    """Thirty noisy copies of a still scene: at most 4 mm of flicker in the region, and 5 % of it comes and goes."""
    ditr, outcomes, measured = dl.Ditr.from_pretrained(), [], []
    for name in STILL:
        steady = Steady(ditr)
        outs = [steady(*frame) for frame in copies(load_sample(name), 30, rng)]
        depth, region = np.array([o.depth for o in outs]), np.array([o.region for o in outs])
        ever = region.any(axis=0)
        flicker, far = 1000 * depth.std(axis=0)[ever].mean(), float(np.median(depth[:, ever]))
        share = 1 - region.all(axis=0).sum() / ever.sum()
        outcomes += [flicker <= FLICKER_MM * max(1, far), share <= FLICKER_SHARE]
        measured.append(f"{name} {flicker:.1f} mm at {far:.1f} m, {share:.1%}")
    return row(outcomes, "; ".join(measured))


def video_does_not_lag(folder: Path, rng: np.random.Generator) -> Row:
    """A scene that moves by 1 or 3 pixels a frame is completed as well as its frames are one by one, within a tenth."""
    scene, ditr = load_sample(STILL[0]), dl.Ditr.from_pretrained()
    outcomes, measured = [], []
    for step in (1, 3):
        steady, errors = Steady(ditr), {"video": [], "alone": []}
        for k, frame in enumerate(copies(scene, 8, rng, step)):
            truth, region = (np.roll(a, step * k, axis=1) for a in (scene.depth_gt, scene.region))
            for name, system in (("video", steady), ("alone", ditr)):
                scores = dl.metrics.evaluate(system(*frame).depth, truth, region, frame[1])
                errors[name].append(1000 * scores["optical"]["rmse"])
        moving, alone = (float(np.mean(errors[name][1:])) for name in ("video", "alone"))
        outcomes.append(moving <= (1 + LAG) * alone)
        measured.append(f"{step} pixels: optical RMSE {moving:.1f} mm, frame by frame {alone:.1f} mm")
    return row(outcomes, "; ".join(measured))


# --- processes that end early -----------------------------------------------------------------------------------------


def started(*arguments: object) -> subprocess.Popen:
    """Start a command of the package in a session of its own."""
    pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True, "start_new_session": True}
    return subprocess.Popen([*COMMAND, *map(str, arguments)], env={**os.environ, "TQDM_DISABLE": "1"}, **pipes)


def simulation(folder: Path, count: int) -> subprocess.Popen:
    """Start to render scenes with two workers."""
    return started("simulate", "--split", "train", "--count", count, "--workers", 2, "--out", folder)


def whole_scenes(folder: Path) -> bool:
    """Return whether every scene of a folder that counts as finished can be read."""
    for path in (folder / "train").glob("train_*/meta.json"):
        read_sample(path.parent)
    return True


def end_at_random(process: subprocess.Popen, sent: int, rng: np.random.Generator, longest_s: float) -> list:
    """Send a signal at a random moment, wait, and return what is left of the process's children."""
    parent, children = psutil.Process(process.pid), []
    until = time.monotonic() + rng.uniform(1, longest_s)
    while time.monotonic() < until and process.poll() is None:
        children = parent.children(recursive=True) or children
        time.sleep(0.1)
    if process.poll() is None:
        process.send_signal(sent)
    process.communicate(timeout=PATIENCE_S)
    return psutil.wait_procs(children, timeout=30)[1]


def simulation_killed(folder: Path, rng: np.random.Generator) -> Row:
    """A simulation that is killed leaves whole scenes only and no worker, and goes on where it was."""
    outcomes = []
    for _ in range(KILLS):
        left = end_at_random(simulation(folder, 2), signal.SIGKILL, rng, 12)
        outcomes.append(not left and whole_scenes(folder))
    last = simulation(folder, 2)
    last.communicate(timeout=5 * PATIENCE_S)
    names = sorted(p.parent.name for p in (folder / "train").glob("train_*/meta.json"))
    return row([*outcomes, last.returncode == 0 and whole_scenes(folder) and len(names) >= 2])


def workers_end(folder: Path, rng: np.random.Generator) -> Row:
    """SIGTERM and Ctrl-C end a simulation with its exit code and leave no worker."""
    outcomes = []
    for sent, code in ((signal.SIGTERM, 143), (signal.SIGINT, 130)):
        process = simulation(folder, 40)
        left = end_at_random(process, sent, rng, 9)
        outcomes.append(not left and process.returncode in (code, -sent))  # -sent: before Python could listen
    return row(outcomes)


def evaluation_killed(folder: Path, rng: np.random.Generator) -> Row:
    """An evaluation that is killed leaves its results file as it was, or whole."""
    path, outcomes = folder / "e.json", []
    write_json(path, {"command": "an older one"})
    for _ in range(KILLS):
        end_at_random(started("evaluate", "--limit", 2, "--json", path), signal.SIGKILL, rng, 15)
        outcomes.append("command" in read_json(path) and not [p for p in folder.iterdir() if p != path])
    return row(outcomes)


def two_runs(folder: Path, rng: np.random.Generator) -> Row:
    """Two runs that write into one folder leave every scene and every part whole."""
    scene = load_sample("test_00003")
    config = preset("tiny")
    parts = build(config)

    def write(k: int) -> None:
        save_sample(scene, folder / "scene")
        name = list(parts)[k % len(parts)]
        save_part(name, parts[name].state_dict(), config, folder / "weights", {})

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(write, range(12)))
    _, states = load_parts(folder / "weights")
    found = read_sample(folder / "scene")
    return row([set(states) == set(parts), np.array_equal(found.depth, scene.depth)])


# --- disks and damage -------------------------------------------------------------------------------------------------


@contextmanager
def full_disk(size: int):
    """Let no file grow beyond ``size`` bytes, as on a disk that is full."""
    resource = import_module("resource")  # not on Windows, where the other checks run all the same
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, before)


def writers() -> dict[str, Callable[[Path], object]]:
    """Return name -> what writes a result at a path."""
    scene, config = load_sample("test_00003"), preset("tiny")
    region = build(config)["region"].state_dict()
    return {
        "depth.png": lambda path: write_depth(path, scene.depth),
        "depth.exr": lambda path: write_depth(path, scene.depth),
        "cloud.ply": lambda path: write_ply(path, scene.depth, scene.rgb, scene.camera),
        "results.json": lambda path: write_json(path, {"numbers": list(range(9999))}),
        "scene": lambda path: save_sample(scene, path),
        "weights": lambda path: save_part("region", region, config, path, {}),
    }


def disk_is_full(folder: Path, rng: np.random.Generator) -> Row:
    """On a full disk a writer raises, and what was there stays, with nothing beside it."""
    outcomes = []
    for name, write in writers().items():
        path = folder / name
        write(path)
        before = contents(folder)
        for size in (1, 1000, 10000):
            with full_disk(size):
                outcomes.append(raises(OSError, write, path) and contents(folder) == before)
    return row(outcomes)


def folder_is_read_only(folder: Path, rng: np.random.Generator) -> Row:
    """Where nothing can be written a writer raises an OSError."""
    place = folder
    if os.geteuid() == 0:  # whom permissions do not stop
        place = Path("/proc")
    else:
        folder.chmod(0o555)
    outcomes = [raises(OSError, write, place / "there" / name) for name, write in writers().items()]
    folder.chmod(0o755)
    return row(outcomes)


def weights_damaged(folder: Path, rng: np.random.Generator) -> Row:
    """Weights that were cut or of which a bit was turned are refused; in their card, refused or read the same."""
    config = preset("tiny")
    for name, part in build(config).items():
        save_part(name, part.state_dict(), config, folder, {})
    wanted, _ = load_parts(folder)

    def refused_or_same(path: Path) -> bool:
        try:
            found, _ = load_parts(folder)
        except ValueError:
            return True
        return path.suffix == ".json" and found == wanted

    return row([refused_or_same(path) for path in damaged(folder, rng)])


def scene_damaged(folder: Path, rng: np.random.Generator) -> Row:
    """A scene whose files were cut or turned by a bit is refused, or read with the same depth and labels."""
    scene = load_sample("test_00003")
    save_sample(scene, folder / "scene")
    outcomes, unnoticed = [], 0
    for path in damaged(folder / "scene", rng):
        try:
            found = read_sample(folder / "scene")
        except ValueError:
            outcomes.append(True)
            continue
        same = all(np.array_equal(getattr(found, k), getattr(scene, k)) for k in ("depth", "depth_gt", "material"))
        outcomes.append(same)
        unnoticed += path.suffix == ".jpg"
    return row(outcomes, f"JPEG has no checksum: {unnoticed} turned bits of rgb.jpg went unnoticed")


def damaged(folder: Path, rng: np.random.Generator):
    """Yield files of a folder, each while it is damaged: every other time cut, else one bit turned."""
    files = sorted(p for p in folder.iterdir() if p.is_file() and not p.name.startswith("."))
    for k in range(DAMAGES):
        path = files[k // 2 % len(files)]
        whole = path.read_bytes()
        data = bytearray(whole)
        at = int(rng.integers(len(data)))
        if k % 2:
            data[at] ^= 1 << int(rng.integers(8))
        else:
            del data[at:]
        path.write_bytes(data)
        yield path
        path.write_bytes(whole)


def raises(kind: type[Exception], call: Callable, *arguments: object) -> bool:
    """Return whether a call raises an error of a kind."""
    try:
        call(*arguments)
    except kind:
        return True
    return False


def contents(folder: Path) -> dict[str, bytes]:
    """Return path -> bytes of all files below a folder."""
    return {str(p): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


CHECKS = (
    memory_of_large_frames,
    memory_of_samples,
    video_holds_still,
    video_does_not_lag,
    simulation_killed,
    workers_end,
    evaluation_killed,
    two_runs,
    disk_is_full,
    folder_is_read_only,
    weights_damaged,
    scene_damaged,
)


def run(check: Callable[[Path, np.random.Generator], Row], seed: int) -> dict[str, object]:
    """Return a check's row as a results file holds it, an error being wrong."""
    begun = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        try:
            found = check(Path(folder), np.random.default_rng(seed))
        except Exception as error:
            found = Row(1, 0, f"{type(error).__name__}: {' '.join(str(error).split())[:200]}")
    seconds = round(time.perf_counter() - begun, 1)
    return {"check": check.__doc__.rstrip("."), **found._asdict(), "seconds": seconds}


def main(arguments: list[str] | None = None) -> int:
    """Run the checks and print their table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="run only checks whose name contains this")
    parser.add_argument("--seed", type=int, default=0, help="of the moments and places (%(default)s)")
    parser.add_argument("--json", type=Path, help="also write the table, e.g. to ditr_lite/weights/results_soak.json")
    words = sys.argv[1:] if arguments is None else arguments
    args = parser.parse_args(words)
    rows = []
    for check in (c for c in CHECKS if args.only in c.__name__):
        rows.append(run(check, args.seed))
        found = rows[-1]
        print(
            f"{found['right']:3} of {found['tried']:3} right, {found['seconds']:6.1f} s  {check.__name__}  "
            f"{found['measured']}",
            flush=True,
        )
    if args.json:
        results.write(args.json, results.head(results.tool_command("soak", words)), {"checks": rows})
    return 0 if rows and all(r["right"] == r["tried"] for r in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
