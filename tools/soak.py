"""Put the system through what breaks programs, and print a table: large frames, a full disk, damaged files, kills.

    python tools/soak.py [--only WORD] [--seed N] [--json FILE]

``make soak`` runs it whole, within a quarter of an hour on two idle cores. A check is a function in
:data:`CHECKS` that is given a folder of its own and a generator, and returns how often it tried, how often what
happened was right, and what was measured. The exit code is 1 where anything was wrong.
"""

import argparse
import math
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

import numpy as np
import psutil
import torch
from safetensors.torch import load_file
from torch import nn

import ditr_lite as dl
from ditr_lite.boundary import get_backend
from ditr_lite.cli.video import Steady
from ditr_lite.config import preset
from ditr_lite.data import list_samples, load_sample, read_sample, save_sample
from ditr_lite.datasets.export import export
from ditr_lite.evaluation import results
from ditr_lite.evaluation.timing import enlarged, peak_mb
from ditr_lite.files import DEPTH, read_json, write_depth, write_json, write_ply
from ditr_lite.pipeline import build
from ditr_lite.store import load_parts, save_part
from ditr_lite.training.kept_maps import KeptMaps
from ditr_lite.training.loop import Recipe, fit
from ditr_lite.training.readers import RealFrames
from ditr_lite.training.scenes import checksum, every

COMMAND = [sys.executable, "-m", "ditr_lite"]
LARGE = ((3000, 4000), (6000, 8000))  # height, width
LIMIT_MB = 1000  # that a large frame may take, beyond what the process and the frame take
FLICKER_MM, FLICKER_SHARE, LAG = 4.0, 0.05, 0.1  # limits of video; of the first beyond 1 m, mm a metre
STILL = ("test_00000", "test_00003", "rooms_00006")  # scenes that are copied with noise
KILLS = 3
DAMAGES = 60
PATIENCE_S = 600  # that nothing takes which is not stuck, on a machine that is busy with other things, too
TRAINING_KILLS = 10
PART = "all"  # of the training that is killed
STEPS, EVERY = 60, 10  # of every part, and between its checkpoints
SMALL = Recipe(steps=12, batch=1, lr=0.05, warmup=3, decay=0.9)  # of a training of milliseconds


class Row(NamedTuple):
    """What a check found."""

    tried: int
    right: int
    measured: str = ""


def row(outcomes: list[bool], measured: str = "") -> Row:
    """Return a row of what was right or not."""
    return Row(len(outcomes), sum(map(bool, outcomes)), measured)


# --- memory and video -------------------------------------------------------------------------------------------------


def large(size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return colour and depth of a scene at a size (H, W)."""
    frame = enlarged(load_sample("test_00003"), size)
    return frame.rgb, frame.depth


def grown(call: Callable[[], object]) -> float:
    """Return by how many MB the process grows at the most during a call."""
    before = psutil.Process().memory_info().rss / 1e6
    return peak_mb(call) - before


def memory_of_large_frames(folder: Path, rng: np.random.Generator) -> Row:
    """A frame of 12 and of 48 megapixels takes at most 1 GB beyond the process and the frame."""
    ditr, taken = dl.Ditr.from_pretrained(), []
    ditr(*large((192, 256)))
    for size in LARGE:
        rgb, depth = large(size)
        taken.append(grown(lambda rgb=rgb, depth=depth: ditr(rgb, depth)))
    sizes = (f"{w} x {h}: {mb:.1f} MB" for (h, w), mb in zip(LARGE, taken, strict=True))
    return row([mb <= LIMIT_MB for mb in taken], ", ".join(sizes))


def memory_of_samples(folder: Path, rng: np.random.Generator) -> Row:
    """Sixteen samples take at most a tenth more memory than four."""
    ditr, frame = dl.Ditr.from_pretrained(), large((720, 1280))
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
    """Start a command of the package in a session of its own.

    It has one thread, for the same bits whoever else computes. It keeps no compiled modules: a full disk cuts them off.
    """
    pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True, "start_new_session": True}
    surroundings = {**os.environ, "TQDM_DISABLE": "1", "OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}
    return subprocess.Popen([*COMMAND, *map(str, arguments)], env=surroundings, **pipes)


@contextmanager
def listening_to_ctrl_c() -> Iterator[None]:
    """Start processes that Ctrl-C ends: what a shell runs in its background, it and its children, ignores that."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


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
    return psutil.wait_procs(children, timeout=PATIENCE_S)[1]


def simulation_killed(folder: Path, rng: np.random.Generator) -> Row:
    """A simulation that is killed leaves whole scenes only and no worker, and goes on where it was."""
    outcomes = []
    for _ in range(KILLS):
        left = end_at_random(simulation(folder, 2), signal.SIGKILL, rng, 12)
        outcomes.append(not left and whole_scenes(folder))
    last = simulation(folder, 2)
    last.communicate(timeout=PATIENCE_S)
    names = sorted(p.parent.name for p in (folder / "train").glob("train_*/meta.json"))
    return row([*outcomes, last.returncode == 0 and whole_scenes(folder) and len(names) >= 2])


def workers_end(folder: Path, rng: np.random.Generator) -> Row:
    """SIGTERM and Ctrl-C end a simulation and a training with their exit codes and leave no worker."""
    outcomes = []
    scenes = few_scenes(folder / "scenes")
    for sent, code in ((signal.SIGTERM, 143), (signal.SIGINT, 130)):
        for name in ("simulation", "training"):
            with listening_to_ctrl_c():
                here = folder / f"{name}-{code}"
                process = simulation(here, 40) if name == "simulation" else training(scenes, here, "--workers", 2)
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


# --- training ---------------------------------------------------------------------------------------------------------


def few_scenes(folder: Path) -> Path:
    """Put four scenes to train on and one to validate on into a folder, and return it."""
    for k, name in enumerate(list_samples("val")[:5]):
        save_sample(load_sample(name), folder / ("train" if k < 4 else "val") / name)
    return folder


def training(scenes: Path, folder: Path, *more: object) -> subprocess.Popen:
    """Start to train :data:`PART` of the tiny preset, with checkpoints every few steps; ``more`` overrules."""
    frames = ("--data", scenes / "train", "--val", scenes / "val")
    folders = ("--out", folder / "weights", "--work", folder / "work")
    recipe = ("--preset", "tiny", "--part", PART, "--steps", STEPS, "--every", EVERY, "--batch", 2)
    return started("train", *recipe, *frames, *folders, *more)


def ended(process: subprocess.Popen) -> int:
    """Wait for a process and return its exit code."""
    process.communicate(timeout=PATIENCE_S)
    return process.returncode


def bits(folder: Path) -> dict[str, bytes]:
    """Return name -> bytes of every tensor of the checkpoints and weights of a training, leftovers of writers aside."""
    found = {}
    for path in sorted(folder.rglob("[!.]*.safetensors")):
        found |= {f"{path.name} {name}": tensor.numpy().tobytes() for name, tensor in load_file(path).items()}
    return found


def checkpoints_in(folder: Path) -> int:
    """Return how many checkpoints a training has written so far: each adds a row to a log."""
    return sum(len(path.read_text().splitlines()) for path in folder.glob("work/*.jsonl"))


def training_killed(folder: Path, rng: np.random.Generator) -> Row:
    """A training that is killed at a random moment leaves no worker and ends, resumed, in the same bits."""
    scenes, straight = few_scenes(folder / "scenes"), folder / "straight"
    process = training(scenes, straight, "--workers", 1)  # all with one: without, the last bits may be others
    begun = appeared(straight / "work", process)
    finished = ended(process) == 0
    seconds, wanted, total = time.monotonic() - begun, bits(straight), checkpoints_in(straight)

    def killed_and_resumed(at: float) -> tuple[bool, int]:
        here = folder / f"killed at {at}"
        process = training(scenes, here, "--workers", 1)
        appeared(here / "work", process)
        time.sleep(at)
        children = psutil.Process(process.pid).children(recursive=True) if process.poll() is None else []
        process.kill()
        ended(process)
        left, written = psutil.wait_procs(children, timeout=PATIENCE_S)[1], checkpoints_in(here)
        again = ended(training(scenes, here, "--workers", 1))
        return finished and not left and again == 0 and bits(here) == wanted, written

    with ThreadPoolExecutor(2) as pool:
        found = list(pool.map(killed_and_resumed, rng.uniform(0, seconds, TRAINING_KILLS)))
    written = ", ".join(str(count) for _, count in sorted(found, key=lambda x: x[1]))
    return row([right for right, _ in found], f"killed after {written} of {total} checkpoints")


def appeared(path: Path, process: subprocess.Popen) -> float:
    """Wait until a path is there or a process has ended, and return when that was."""
    while not path.exists() and process.poll() is None:
        time.sleep(0.05)
    return time.monotonic()


def two_trainings(folder: Path, rng: np.random.Generator) -> Row:
    """Two trainings in one folder: of one seed they end in its bits, of two in those of one, and one may be refused."""
    scenes = few_scenes(folder / "scenes")

    def together(name: str, *seeds: int) -> tuple[list[int], dict[str, bytes]]:
        how = ("--part", "autoencoder", "--seed")
        codes = [ended(p) for p in [training(scenes, folder / name, *how, seed) for seed in seeds]]
        return codes, bits(folder / name / "weights")

    alone = [together(f"alone-{seed}", seed)[1] for seed in (0, 1)]
    codes, same = together("same", 0, 0)
    others, other = together("other", 0, 1)
    outcomes = [codes == [0, 0] and same == alone[0], other in alone and alone[0] != alone[1]]
    return row([*outcomes, 0 in others and set(others) <= {0, 2}])


def small_training(folder: Path, spoil: Callable[[int], float] = lambda step: 1.0) -> dict[str, bytes]:
    """Train two layers for a moment, with a checkpoint every 3 steps, and return their bits.

    Args:
        folder: for checkpoints and log.
        spoil: called with every step; the loss is multiplied by what it returns.
    """
    torch.manual_seed(1)
    model = nn.Sequential(nn.Linear(30, 90), nn.Tanh(), nn.Linear(90, 1))

    def loss(step: int) -> dict[str, torch.Tensor]:
        x = torch.randn(8, 30)
        return {"total": spoil(step) * ((model(x) - x.sum(1, keepdim=True)) ** 2).mean()}

    fit("small", model, loss, SMALL, folder, every=3, progress=False)
    return {name: tensor.numpy().tobytes() for name, tensor in model.state_dict().items()}


def stopping_at(at: int) -> Callable[[int], float]:
    """Return a factor of the loss that pulls the plug at a step."""

    def spoil(step: int) -> float:
        if step == at:
            raise KeyboardInterrupt
        return 1.0

    return spoil


def training_not_finite(folder: Path, rng: np.random.Generator) -> Row:
    """A loss that is not finite stops with part, step and last good checkpoint, from which training goes on."""
    wanted, outcomes = small_training(folder / "straight"), []
    for k, factor in enumerate(2 * [math.nan, math.inf, -math.inf]):
        here, at = folder / str(k), int(rng.integers(3, SMALL.steps))
        try:
            small_training(here, lambda step, at=at, factor=factor: factor if step == at else 1.0)
            told = ""
        except ValueError as error:
            told = str(error)
        last = f"of step {at // 3 * 3}, is {here / 'small.checkpoint.safetensors'}"
        named = f"small stopped at step {at + 1}:" in told and last in told
        outcomes.append(named and small_training(here) == wanted)
    return row(outcomes)


def training_damaged(folder: Path, rng: np.random.Generator) -> Row:
    """A checkpoint that was cut or of which a bit was turned is refused; a damaged log does not stop the resume."""
    wanted, stopped, outcomes = small_training(folder / "straight"), folder / "stopped", []
    raises(KeyboardInterrupt, small_training, stopped, stopping_at(10))
    for k, path in enumerate(damaged(stopped, rng)):
        here = folder / str(k)
        shutil.copytree(stopped, here)
        if path.suffix == ".jsonl":
            outcomes.append(small_training(here) == wanted)
        else:
            outcomes.append(raises(ValueError, small_training, here))
    return row(outcomes)


def training_on_full_disk(folder: Path, rng: np.random.Generator) -> Row:
    """A training whose disk is full stops with exit code 2 and keeps its last checkpoint, from which it goes on."""
    wanted, outcomes = small_training(folder / "straight"), []
    for size in (1, 1000, 10000):
        here = folder / str(size)
        raises(KeyboardInterrupt, small_training, here, stopping_at(7))
        before = contents(here)
        with full_disk(size):
            failed = raises(OSError, small_training, here)
        kept = {p: data for p, data in contents(here).items() if not p.endswith(".jsonl")}  # the log may be ahead
        outcomes.append(failed and kept.items() <= before.items() and small_training(here) == wanted)
    scenes = few_scenes(folder / "scenes")
    with full_disk(1000):
        process = training(scenes, folder / "whole")
    outcomes.append(refused(process) and not bits(folder / "whole"))
    return row(outcomes)


def training_read_only(folder: Path, rng: np.random.Generator) -> Row:
    """A training that may not write into its folders stops with exit code 2 and one line."""
    scenes, outcomes = few_scenes(folder / "scenes"), []
    with read_only(folder) as place:
        for name in ("--work", "--out"):
            outcomes.append(refused(training(scenes, folder / "other", name, place / "there")))
    return row(outcomes)


def refused(process: subprocess.Popen) -> bool:
    """Return whether a command ends with exit code 2 and a line that says why."""
    _, told = process.communicate(timeout=PATIENCE_S)
    last = (told.strip().splitlines() or [""])[-1]
    return process.returncode == 2 and last.startswith("ditr_lite: error: ") and "Traceback" not in told


def caches_damaged(folder: Path, rng: np.random.Generator) -> Row:
    """Boundary maps and decoded frames that were cut or of which a bit was turned are made again, or refused."""
    scene, backend = load_sample("test_00003"), get_backend("classical")
    images, maps = (scene.rgb, scene.depth), folder / "maps"
    wanted = [backend(image) for image in images]
    kept = KeptMaps(backend, maps)

    def maps_are_right() -> bool:
        return all(np.array_equal(kept(image), true) for image, true in zip(images, wanted, strict=True))

    assert maps_are_right()
    outcomes = [maps_are_right() for _ in damaged(maps, rng)]
    export("folder", folder / "data", [scene])
    real = RealFrames("folder", folder / "data", cache=folder / "frames")

    def frames() -> str:
        [group] = real.scenes("optical", preset("tiny"), None)
        return checksum(every(group, [0]))

    first = frames()
    for _ in damaged(folder / "frames", rng):
        try:
            outcomes.append(frames() == first)
        except ValueError:
            outcomes.append(True)
    return row(outcomes)


# --- disks and damage -------------------------------------------------------------------------------------------------


@contextmanager
def full_disk(size: int) -> Iterator[None]:
    """Let no file grow beyond ``size`` bytes, as on a disk that is full, in this process and those it starts."""
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
    depth = {f"depth{suffix}": lambda path: write_depth(path, scene.depth) for suffix in DEPTH}
    return depth | {
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
    with read_only(folder) as place:
        return row([raises(OSError, write, place / "there" / name) for name, write in writers().items()])


@contextmanager
def read_only(folder: Path) -> Iterator[Path]:
    """Yield a folder in which nothing can be written, this one where permissions count."""
    if os.geteuid() == 0:  # whom permissions do not stop
        yield Path("/proc")
        return
    folder.chmod(0o555)
    try:
        yield folder
    finally:
        folder.chmod(0o755)


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
    """Yield files below a folder, each while it is damaged: every other time cut, else one bit turned."""
    files = sorted(p for p in folder.rglob("*") if p.is_file() and not p.name.startswith("."))
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
    training_killed,
    training_not_finite,
    training_damaged,
    training_on_full_disk,
    training_read_only,
    two_trainings,
    caches_damaged,
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
    rows, chosen = [], [check for check in CHECKS if args.only in check.__name__]
    if not chosen:
        parser.error(f"no check is called like {args.only!r}; there are {', '.join(c.__name__ for c in CHECKS)}")
    for check in chosen:
        rows.append(run(check, args.seed))
        found = rows[-1]
        print(
            f"{found['right']:3} of {found['tried']:3} right, {found['seconds']:6.1f} s  {check.__name__}  "
            f"{found['measured']}",
            flush=True,
        )
    if args.json:
        results.write(args.json, results.head(results.tool_command("soak", words)), {"checks": rows})
    return 0 if all(r["right"] == r["tried"] for r in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
