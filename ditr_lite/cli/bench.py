"""What ``bench`` of ``python -m ditr_lite`` does: accuracy, time, memory, operations and training speed."""

from argparse import Namespace
from typing import Any

from .commands import check_target, chosen_frames, command_line, load_system


def bench(args: Namespace) -> None:
    """Score every method on a split, a reader's own included, and measure what each stage costs."""
    check_target(args.json, ".json")
    from ..baselines import REGISTRY
    from ..evaluation import scoring, timing
    from ..evaluation.own_method import find_methods
    from ..files import write_json

    if args.runs < timing.MIN_RUNS:  # now, not after everything has been scored
        raise ValueError(f"--runs should be at least {timing.MIN_RUNS}, got {args.runs}")
    own = find_methods(args.method)
    source, frames = chosen_frames(args)
    ditr = load_system(args)
    results = scoring.run_methods(frames, ditr, {**REGISTRY, **own}, args.given_region, args.steps, args.samples)
    print(f"{source}, region {'given' if args.given_region else 'found by stage one'}")
    print(scoring.format_report(scoring.summary(results)))
    notes = {"source": source, "given_region": args.given_region, "steps": args.steps, "samples": args.samples}
    notes["cost"] = costs(args, ditr, frames[0])
    if args.json:
        write_json(args.json, scoring.to_json(results, command_line(args), args.weights, **notes))


def costs(args: Namespace, ditr, sample) -> dict[str, Any]:
    """Measure and print time, memory and operations at both frame sizes, the yardstick and training speed."""
    from ..evaluation import timing

    found: dict[str, Any] = {"machine": timing.machine(), "runs": args.runs, "frames": []}
    print(f"\na product of two float32 matrices 2048 x 2048 takes {found['machine']['product_ms']:.0f} ms here")
    for frame in (sample, timing.enlarged(sample)):
        height, width = frame.depth.shape
        rows = timing.measure(ditr, frame, args.runs, args.steps, args.samples)
        peaks = timing.stage_peaks(args.weights, frame, args.steps, args.samples)
        rows = [{**row, "peak_mb": peaks[row["stage"]]} for row in rows]
        found["frames"].append({"size": [height, width], "stages": rows})
        print(f"\nmedian of {args.runs} runs, a frame of {width} x {height}, working size {ditr.config.size[::-1]}")
        print(timing.format_latency(rows))
    try:
        found["unets"] = timing.compare_unets(ditr, args.runs)
        print("\none denoising step of one branch, one sample, beside a library's U-Net on latents of the same shape")
        print(timing.format_unets(found["unets"]))
    except ImportError as error:
        print(f"\n{error}")
    found["training"] = speed = timing.throughput(ditr)
    print(
        f"\ntraining the {speed['part']} branch, batch {speed['batch']}: {speed['steps_per_s']:.2f} steps and "
        f"{speed['frames_per_s']:.1f} frames a second"
    )
    return found
