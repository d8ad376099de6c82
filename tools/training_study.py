"""What the training loop promises, measured: processes, kills, real readers, fine-tuning, the model of its time.

    python tools/training_study.py processes|readers|sensors|finetune|cost [--json FILE] [...]

Each is a command of minutes on two cores, and says how busy the machine was: times by the clock mean nothing beside
other work. The networks are small on purpose; what is measured is the loop, not the method.

=========  ========================================================================================================
processes  two processes against one, the same steps: held-out loss, and frames a second
readers    trained on scenes, and on the same scenes in ClearGrasp's layout through its reader: the same error?
sensors    which part of the shipped weights loses how much where the same scenes are seen by another sensor?
finetune   the shipped weights on a few frames of another sensor: better there, and not worse at home?
cost       the model of the time, fitted to small steps, on a size that was left out
=========  ========================================================================================================
"""

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

import ditr_lite as dl
from ditr_lite.boundary.learned import build_nets
from ditr_lite.config import override, preset
from ditr_lite.data import SAMPLES, read_sample
from ditr_lite.datasets.export import export
from ditr_lite.evaluation import results, training_costs
from ditr_lite.evaluation.compare import compare_weights, format_weights
from ditr_lite.evaluation.statistics import format_interval, paired_bootstrap, verdict
from ditr_lite.files import write_json
from ditr_lite.simulator.cameras import PRESETS
from ditr_lite.store import WEIGHTS, copy_weights, load_part, read_card, read_config, sha256
from ditr_lite.training import adapt, boundary, loop, parts, readers, scenes

ROOT = Path(__file__).resolve().parents[1]
DEFAULT = "default"  # the sensor drawn at random for every scene, as the shipped scenes are
SENSOR = "l515"  # the one on which the shipped weights lose most: `sensors`
# At a rate of 3e-4 the geometric branch lost on the frames that choose, and the optical branch on the first test
# scenes, in holes that stage one claims beyond the region: no held-out error watches what it paints there.
PARTS = ("detail",)
LEARNING, CHOOSING = 300_000, 310_000  # first seeds of frames that no other command renders
HELD_OUT = 16  # frames that choose when to stop and what to keep; those of the later seeds judge
HARM = 0.02  # of the error at home that a gain elsewhere may cost
JUDGED = ("whole", "optical", "geometric")  # sets of pixels
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
    for name in nets:
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


def rendered(options: argparse.Namespace, sensor: str | None, split: str, count: int, seed: int) -> list[Path]:
    """Return ``count`` frames of a sensor, None for the random one; those that --work has are not made again."""
    from ditr_lite.simulator.simulate import simulate_many

    root = Path(options.work) / (sensor or DEFAULT)
    return simulate_many(root, split, count, seed, options.workers, 0, sensor)


def errors_by_part(folder: Path, frames: scenes.Scenes, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Return what each named part of a weights folder gets wrong of each frame, (N,); see ``adapt.errors_of``."""
    config = read_config(folder)
    nets = _nets(config, folder)
    found = {}
    for part in names:
        found[part] = adapt.model_errors(nets[part], adapt.errors_of(part, nets, config, "classical"), frames)
    return found


def sensors(options: argparse.Namespace) -> dict:
    """Score each part of the shipped weights on the same scenes seen by every sensor, against the random one."""
    errors, found = {}, {}
    for sensor in (None, *PRESETS):
        folder = rendered(options, sensor, "val", options.frames, CHOOSING)[0].parent
        frames = scenes.load_scenes(folder, options.frames)
        by_part = errors_by_part(WEIGHTS, frames, list(adapt.RECIPES))
        errors[sensor] = {part: dict(zip(frames.names, values, strict=True)) for part, values in by_part.items()}
    for sensor in PRESETS:
        found[sensor] = {}
        for part, here in errors[sensor].items():
            home = errors[None][part]
            both = [name for name in here if name in home]  # a scene that a sensor hardly sees was not rendered
            pair = (np.array([of[name] for name in both]) for of in (here, home))
            found[sensor][part] = _difference(f"{part}, {sensor} minus the random sensor", *pair)
    return found


def three_sets(options: argparse.Namespace) -> dict[str, list[Path]]:
    """Return the frames of a sensor to learn from, those that choose, and those that judge and choose nothing."""
    learn = rendered(options, options.sensor, "train", options.frames, LEARNING)
    others = rendered(options, options.sensor, "val", HELD_OUT + options.judges, CHOOSING)
    return {"learn": learn, "choose": others[:HELD_OUT], "judge": others[HELD_OUT:]}


def finetune(options: argparse.Namespace) -> dict:
    """Fine-tune shipped weights on a few frames of another sensor, and score parts and system there and at home.

    Three sets of frames, of seeds that no other command uses: --frames to learn from; :data:`HELD_OUT`, by which
    ``adapt`` chooses when to stop and whether to keep the result, and by which its recipes were chosen; and --judges,
    which chose nothing and are scored once, here. The test split chose one thing: not to tune the optical branch. Of it
    all scenes judge, or the first --limit.
    What is rendered and trained stays in --work: a stopped run goes on, and new shipped weights are tuned anew.
    """
    sets = three_sets(options)
    learn, choose, judge = (read_scenes(paths) for paths in sets.values())
    names = {name: [path.name for path in paths] for name, paths in sets.items()}
    changed = {"steps": options.steps} if options.steps else {}
    recipes = {part: replace(adapt.RECIPES[part], **changed) for part in options.parts}
    home = options.work / f"{options.sensor}-{key_of(names, recipes)}"
    config, out = read_config(WEIGHTS), home / "weights"
    pool = adapt.mixed([learn], [scenes.load_scenes(SAMPLES / "train")], 0.5)
    found = {"sensor": options.sensor, "sets": names}
    for part, recipe in recipes.items():
        notes = adapt.adapt(part, config, pool, choose, WEIGHTS, out, home / "training", recipe)
        found[part] = {"kept": notes["judged"]["kept"], "best_step": notes["best_step"], "recipe": notes["recipe"]}
    before, after = (errors_by_part(folder, judge, options.parts) for folder in (WEIGHTS, out))
    for part in options.parts:
        name = f"{part}, after minus before, {found[part]['kept']} kept"
        found[part] |= _difference(name, after[part], before[part])
    test = [dl.load_sample(name) for name in dl.list_samples("test")[: options.limit]]
    for where, samples in ((options.sensor, map(read_sample, sets["judge"])), ("test", test)):
        found[where] = compare_weights(WEIGHTS, out, list(samples))
        print(f"{where}\n{format_weights(found[where], 'shipped', 'fine-tuned')}", flush=True)
    print("\n".join(outcome(options.sensor, found)))
    return found | {"weights": {part: sha256(out / f"{part}.safetensors") for part in options.parts}}


def key_of(*settings) -> str:
    """Return what stands for the shipped weights and for settings in a folder's name."""
    start = {name: part["sha256"] for name, part in read_card(WEIGHTS)["parts"].items()}
    told = json.dumps([start, *settings], sort_keys=True, default=vars)
    return hashlib.sha256(told.encode()).hexdigest()[:12]


def read_scenes(paths: Sequence[Path]) -> scenes.Scenes:
    """Return some scenes of one folder."""
    every = scenes.load_scenes(paths[0].parent)
    return scenes.every(every, [every.names.index(path.name) for path in paths])


def outcome(sensor: str, found: dict) -> list[str]:
    """Return in words whether fine-tuning helped on the new sensor and what it cost on the test split."""
    there, home = found[sensor], found["test"]
    lines = [f"{len(there['frames'])} frames of {sensor} that chose nothing, the region as stage one finds it:"]
    lines += [verdict(f"  {key}", there["difference"][key], "before") for key in JUDGED]
    lines.append(f"{len(home['frames'])} frames of the test split:")
    for key in JUDGED:
        ratio, low, high = home["ratio"][key]
        said = "not harmed by more than" if high <= 1 + HARM else "harmed by more than"
        if low <= 1 + HARM < high:
            said = "not decided whether harmed by more than"
        lines.append(f"  {key}: {said} {100 * HARM:.0f} % ({ratio:.3f} [{low:.3f}, {high:.3f}] times the error before)")
    return lines


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


STUDIES = {"processes": processes, "readers": through_readers, "sensors": sensors, "finetune": finetune, "cost": cost}
STEPS = {"processes": 40, "readers": 150, "sensors": 0, "finetune": 0, "cost": 1, "worker": 40}


def main() -> None:
    """Run one study."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("study", choices=[*STUDIES, "worker"])
    parser.add_argument("--steps", type=int, help="of a training")
    parser.add_argument("--rounds", type=int, default=3, help="of processes and cost (%(default)s)")
    parser.add_argument("--frames", type=int, default=16, help="of a sensor, to train on or to compare (%(default)s)")
    parser.add_argument("--judges", type=int, default=48, help="frames of the sensor that judge (%(default)s)")
    parser.add_argument("--sensor", choices=PRESETS, default=SENSOR, help="to fine-tune to (%(default)s)")
    parser.add_argument("--parts", nargs="+", choices=adapt.RECIPES, default=PARTS, help="to fine-tune, in this order")
    parser.add_argument("--workers", type=int, default=2, help="processes that render (%(default)s)")
    parser.add_argument("--limit", type=int, help="use only the first scenes, or test scenes")
    parser.add_argument(
        "--work",
        type=Path,
        default=Path("outputs/training_study"),
        help="for what is rendered and tuned; frames that are there are taken",
    )
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
