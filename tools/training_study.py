"""What the training loop promises, measured: processes, kills, real readers, fine-tuning, the model of its time.

    python tools/training_study.py processes|readers|finetune|cost [--json FILE] [...]

Each is a command of minutes on two cores, and says how busy the machine was: times by the clock mean nothing beside
other work. The networks are small on purpose; what is measured is the loop, not the method.

=========  ========================================================================================================
processes  two processes against one, the same steps: held-out loss, and frames a second
readers    trained on scenes, and on the same scenes in ClearGrasp's layout through its reader: the same error?
finetune   the shipped optical branch on a few frames of another sensor: better there, and not worse at home?
cost       the model of the time, fitted to small steps, on a size that was left out
=========  ========================================================================================================
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import numpy as np
import torch

import ditr_lite as dl
from ditr_lite.boundary.learned import build_nets
from ditr_lite.config import override, preset
from ditr_lite.data import SAMPLES
from ditr_lite.datasets.export import export
from ditr_lite.evaluation import results, training_costs
from ditr_lite.evaluation.compare import compare_weights, format_weights
from ditr_lite.evaluation.statistics import format_interval, paired_bootstrap
from ditr_lite.files import write_json
from ditr_lite.store import WEIGHTS, copy_weights, load_part, read_card, read_config, sha256
from ditr_lite.training import adapt, boundary, loop, parts, readers, scenes

ROOT = Path(__file__).resolve().parents[1]
SENSOR = "structure"
BATCH = 32  # crops a step of the outlines: with few, gradients travel longer than they take to compute


def crops_of(split: str):
    """Return what draws crops of a shipped split."""
    found = scenes.load_scenes(SAMPLES / split)
    return partial(boundary.draw_outlines, "depth", found, boundary.exact_outlines(found)["depth"], BATCH, 0)


def outlines(steps: int, watch) -> dict:
    """Train the network that finds outlines in depth on shipped scenes, and score it on others."""
    torch.manual_seed(0)
    net = build_nets()["depth"].to(memory_format=torch.channels_last)
    recipe = loop.Recipe(steps=steps, batch=BATCH, lr=3e-3, warmup=min(10, steps), decay=0.9)
    score = partial(boundary.score_crops, net)

    def validate() -> dict[str, float]:
        held_out = loop.Step(crops_of("val"), score)
        return {"val": float(np.mean([float(held_out(k)["total"]) for k in range(8)]))}

    how = {"watch": watch, "engine": loop.Engine(cpu=True), "progress": False}
    return loop.fit("outlines", net, loop.Step(crops_of("train"), score), recipe, None, validate, **how)


# --- processes --------------------------------------------------------------------------------------------------------


def processes(options: argparse.Namespace) -> dict:
    """Train with one process and with two, in turns, and compare."""
    rows = {1: [], 2: []}
    for _ in range(options.rounds):
        for count in rows:
            rows[count].append(_started(count, options.steps))
            print(f"{count} process(es): {rows[count][-1]['frames_per_s']:.2f} frames a second", flush=True)
    val = {count: found[0]["val"] for count, found in rows.items()}
    speed = {count: float(np.median([r["frames_per_s"] for r in found])) for count, found in rows.items()}
    apart, faster = val[2] / val[1] - 1, speed[2] / speed[1]
    print(f"held-out loss {val[1]:.6f} with one, {val[2]:.6f} with two: {100 * apart:+.3f} %")
    print(f"throughput with two processes: {faster:.2f} times that of one, median of {options.rounds} rounds")
    return {"val": val, "difference": apart, "frames_per_s": speed, "ratio": faster, "rounds": rows}


def _started(count: int, steps: int) -> dict:
    """Train in ``count`` new processes of one thread each and return what the first one wrote."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "found.json"
        launcher = ["-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={count}"]
        command = [sys.executable, *launcher, __file__, "worker", "--steps", str(steps), "--json", str(file)]
        paths = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
        subprocess.run(command, env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": paths}, check=True)
        return dl.files.read_json(file)


def worker(options: argparse.Namespace) -> dict:
    """Be one process of :func:`processes`: time all steps but the first three, which warm up."""
    moments: list[float] = []
    notes = outlines(options.steps, lambda *_: moments.append(time.monotonic()))
    if not loop.is_first():
        loop.leave()
        return {}
    loop.leave()
    frames = BATCH * (len(moments) - 4)
    return {"val": notes["curve"][-1]["val"], "frames_per_s": frames / (moments[-1] - moments[3])}


# --- readers ----------------------------------------------------------------------------------------------------------


def through_readers(options: argparse.Namespace) -> dict:
    """Train both branches of the tiny preset on scenes and on their export; score both through the reader."""
    config, found = preset("tiny"), {}
    with tempfile.TemporaryDirectory() as folder:
        home = Path(folder)
        for split in ("train", "val"):
            names = dl.list_samples(split)[: options.limit]
            export("cleargrasp", home / split, [dl.load_sample(name) for name in names])
        own = scenes.load_scenes(SAMPLES / "train", options.limit)
        recipe = loop.Recipe(steps=options.steps, batch=4, lr=2e-3, warmup=10, decay=0.9)
        parts.train_on("autoencoder", config, [own], None, home / "scenes", home / "work", recipe)
        copy_weights(home / "scenes", home / "reader")
        for branch in ("optical", "geometric"):
            real = {s: readers.RealFrames("cleargrasp", home / s, cache=home / "cache") for s in ("train", "val")}
            pools = {"scenes": [own], "reader": real["train"].pool(branch, config, [])}
            held_out = real["val"].scenes(branch, config, None)[0]
            errors = {}
            for source, pool in pools.items():
                parts.train_on(branch, config, pool, None, home / source, home / f"{source}-work", recipe)
                nets = _nets(config, home / source)
                score = adapt.errors_of(branch, nets, config, "classical")
                errors[source] = adapt.model_errors(nets[branch], score, held_out)
            found[branch] = _difference(
                f"{branch}: through the reader minus scenes", errors["reader"], errors["scenes"]
            )
    return found


def _nets(config, folder: Path):
    nets = dl.pipeline.build(config)
    for name in read_card(folder)["parts"]:
        nets[name].load_state_dict(load_part(name, folder))
    return nets.eval()


def _difference(name: str, a: np.ndarray, b: np.ndarray) -> dict:
    """Print and return the paired difference of errors, a - b, and both means."""
    rows = [(x, y) for x, y in zip(a.tolist(), b.tolist(), strict=True) if x == x and y == y]
    first, second = map(list, zip(*rows, strict=True))
    difference = paired_bootstrap(first, second)
    means = float(np.mean(first)), float(np.mean(second))
    print(f"{name}: {format_interval(difference, 1, '+.4f')} ({means[0]:.4f}, {means[1]:.4f}; {len(rows)} frames)")
    return {"difference": difference, "means": means, "frames": len(rows)}


# --- fine-tuning ------------------------------------------------------------------------------------------------------


def finetune(options: argparse.Namespace) -> dict:
    """Fine-tune the shipped optical branch on 16 frames of another sensor, and score it there and at home."""
    from ditr_lite.simulator.simulate import simulate_many

    home = Path(options.work)
    for split, seed in (("train", 70_000), ("val", 80_000)):
        simulate_many(home / SENSOR, split, options.frames, seed, 1, 0, SENSOR)
    config, out = read_config(WEIGHTS), home / "weights"
    shutil.rmtree(out, ignore_errors=True)
    own, held_out = (scenes.load_scenes(home / SENSOR / split) for split in ("train", "val"))
    pool = adapt.mixed([own], [scenes.load_scenes(SAMPLES / "train")], 0.5)
    recipe = loop.Recipe(**{**vars(adapt.RECIPES["optical"]), "steps": options.steps})
    notes = adapt.adapt("optical", config, pool, held_out, WEIGHTS, out, home / "training", recipe)
    judged = {k: np.array([np.nan if e is None else e for e in notes["judged"][k]]) for k in ("before", "after")}
    found = {"kept": notes["judged"]["kept"], "best_step": notes["best_step"]}
    found["sensor"] = _difference(f"{SENSOR}, after minus before", judged["after"], judged["before"])
    test = [dl.load_sample(name) for name in dl.list_samples("test")[: options.limit]]
    at_home = compare_weights(WEIGHTS, out, test, given_region=True)
    print(format_weights(at_home, "shipped", "fine-tuned"))
    return found | {"weights": sha256(out / "optical.safetensors"), "test": at_home}


# --- cost -------------------------------------------------------------------------------------------------------------


def cost(options: argparse.Namespace) -> dict:
    """Fit the model of the time to steps of small denoisers and predict one that was left out."""
    own, rows = scenes.load_scenes(SAMPLES / "train", 4), []
    sizes = [(8, 2), (8, 8), (16, 2), (16, 4), (24, 2), (24, 4), (16, 8)]
    for width, batch in sizes:
        config = override(preset("tiny"), **{"unet.width": width})
        rows.append(training_costs.measure_step("geometric", config, own, batch, options.rounds))
    gflop, gb, seconds = map(list, zip(*rows, strict=True))
    model = training_costs.fit_time(gflop[:-1], gb[:-1], seconds[:-1])
    predicted = [model.seconds(*row) for row in zip(gflop, gb, strict=True)]
    for (width, batch), real, told in zip(sizes, seconds, predicted, strict=True):
        print(f"width {width:2d}, batch {batch}: {1000 * real:6.0f} ms measured, {1000 * told:6.0f} ms by the model")
    off = predicted[-1] / seconds[-1] - 1
    print(f"the last was left out of the fit: {100 * off:+.0f} %")
    return {"sizes": sizes, "seconds": seconds, "predicted": predicted, "off": off, "model": vars(model)}


STUDIES = {"processes": processes, "readers": through_readers, "finetune": finetune, "cost": cost}
STEPS = {"processes": 40, "readers": 150, "finetune": 300, "cost": 1, "worker": 40}


def main() -> None:
    """Run one study."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("study", choices=[*STUDIES, "worker"])
    parser.add_argument("--steps", type=int, help="of a training")
    parser.add_argument("--rounds", type=int, default=3, help="of processes and cost (%(default)s)")
    parser.add_argument("--frames", type=int, default=16, help="of the other sensor, to train on; as many to judge")
    parser.add_argument("--limit", type=int, help="use only the first scenes, or test scenes")
    parser.add_argument("--work", type=Path, default=Path("outputs/training_study"), help="for what finetune renders")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    options = parser.parse_args()
    options.steps = options.steps or STEPS[options.study]
    if options.study == "worker":
        if found := worker(options):
            write_json(options.json, found)
        return
    load = os.getloadavg() if hasattr(os, "getloadavg") else ()
    print(f"{os.cpu_count()} cores; load before: {', '.join(f'{x:.1f}' for x in load) or 'unknown'}", flush=True)
    found = STUDIES[options.study](options)
    if options.json:
        begin = results.head(results.tool_command("training_study", sys.argv[1:]), load=list(load))
        results.write(options.json, begin, {options.study: found})


if __name__ == "__main__":
    main()
