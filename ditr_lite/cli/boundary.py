"""What ``train-boundary`` and ``bench-boundary`` of ``python -m ditr_lite`` do, given their parsed arguments."""

from argparse import Namespace

from .commands import check_scenes, check_target, chosen_frames, command_line


def train_boundary(args: Namespace) -> None:
    """Train the learned boundary backend and write its weights and its entry in the card."""
    from ..store import WEIGHTS
    from ..training import boundary as boundary_training

    check_scenes(args)
    out = args.out or WEIGHTS
    changes = {k: getattr(args, k) for k in ("steps", "batch", "lr") if getattr(args, k) is not None}
    notes = boundary_training.train_boundary(
        args.data, args.val, out, args.work, args.limit, args.seed, command_line(args), **changes
    )
    figures = "; ".join(f"{m} F {notes[m]['val_f']:.3f} at threshold {notes[m]['threshold']}" for m in ("rgb", "depth"))
    print(f"{out / 'boundary'}.safetensors: {figures} (validation)")


def bench_boundary(args: Namespace) -> None:
    """Score every boundary backend against the exact outlines of rendered scenes, and print the table."""
    check_target(args.json, ".json")
    from ..evaluation import boundary as boundary_scoring

    _, frames = chosen_frames(args)
    _, tuning = chosen_frames(Namespace(split="train", root=args.root, limit=None))
    results = boundary_scoring.bench(frames, tuning, args.tolerance, args.weights, args.sam)
    print(boundary_scoring.format_table(results["summary"]))
    if args.json:
        from ..files import write_json

        write_json(args.json, {"command": command_line(args), "split": args.split, **results})
