"""``complete``: RGB-D frames of any camera, one or a folder of them, become dense depth; also clouds and pictures."""

import os
import re
import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from .shared import add_system, check_distinct, check_target, frame_files, load_system, real, seed, whole

DEPTH = (".png", ".tif", ".tiff", ".npy", ".exr")  # as files.DEPTH, which would import NumPy
FOLDERS = ("rgb_dir", "depth_dir", "out_dir")
MORE_FOLDERS = ("region_dir", "ply_dir", "panel_dir")
SUFFIX, PANEL_WIDTH = ".png", 480


@dataclass(frozen=True)
class Job:
    """One frame: where it is read from and written to."""

    rgb: Path
    depth: Path
    out: Path
    region: Path | None = None
    ply: Path | None = None
    panel: Path | None = None

    @property
    def is_done(self) -> bool:
        """Whether all that is wanted of the frame is there."""
        wanted = [path for path in (self.out, self.ply, self.panel) if path is not None]
        return all(path.exists() for path in wanted)

    def check(self, intrinsics: Path | None) -> None:
        """Refuse targets that cannot be written, or that are inputs, before any work is done."""
        check_target(self.out, *DEPTH)
        check_target(self.ply, ".ply")
        check_target(self.panel, ".png")
        inputs = {"--rgb": self.rgb, "--depth": self.depth, "--region": self.region, "--intrinsics": intrinsics}
        check_distinct({"--out": self.out, "--ply": self.ply, "--panel": self.panel}, inputs)


def add_arguments(p: ArgumentParser) -> None:
    """Add what ``complete`` takes."""
    one = p.add_argument_group("one frame")
    one.add_argument("--rgb", type=Path, help="8-bit colour picture (PNG, JPEG, TIFF ...) or .npy")
    one.add_argument("--depth", type=Path, help="16-bit PNG or TIFF, .npy or .exr, aligned to --rgb, 0 = missing")
    one.add_argument("--out", type=Path, help="completed depth: .png (in the unit of --depth), .tif, .npy or .exr (m)")
    one.add_argument("--region", type=Path, help="mask of the transparent and reflective region; else it is found")
    one.add_argument("--ply", type=Path, help="also write a point cloud; needs --intrinsics")
    one.add_argument("--panel", type=Path, help="also write a picture of before and after (.png)")
    many = p.add_argument_group(
        "many frames, paired by their names; those that are there already are left out, but not with --video"
    )
    many.add_argument("--rgb-dir", type=Path, metavar="DIR", help="folder of colour pictures, or a quoted pattern")
    many.add_argument("--depth-dir", type=Path, metavar="DIR", help="folder of depth maps, or a quoted pattern")
    many.add_argument("--region-dir", type=Path, metavar="DIR", help="folder of masks, or a quoted pattern")
    many.add_argument("--out-dir", type=Path, metavar="DIR", help="folder for completed depth, NAME and --suffix")
    many.add_argument("--ply-dir", type=Path, metavar="DIR", help="folder for point clouds; needs --intrinsics")
    many.add_argument("--panel-dir", type=Path, metavar="DIR", help="folder for pictures of before and after")
    many.add_argument("--suffix", choices=DEPTH, help=f"kind of completed depth ({SUFFIX})")
    many.add_argument(
        "--video",
        action="store_true",
        help="the frames follow each other in time, by the numbers in their names: hold still what does not move; all "
        "are completed, also those that are there already, for each rests on those before it",
    )
    p.add_argument(
        "--depth-scale",
        type=real(0, float("inf"), "metres per unit"),
        help="metres per unit of depth (default: 0.001 where the file holds whole numbers, 1 where floats)",
    )
    p.add_argument(
        "--upsample-depth",
        action="store_true",
        help="depth is aligned, but of lower resolution than colour: keep its readings where they are, fill between",
    )
    p.add_argument("--panel-width", type=whole(100, 4000), help=f"pixels of a picture's maps ({PANEL_WIDTH})")
    p.add_argument(
        "--intrinsics",
        type=Path,
        help="of point clouds: 3x3 matrix as text or .npy, or .yaml or .json with fx, fy, cx, cy (camera_info)",
    )
    p.add_argument("--seed", type=seed, default=0, help="of the noise (%(default)s)")
    p.add_argument("--adjust", action="store_true", help="let readings outside the region change too")
    add_system(p)


def run(options: Namespace) -> int:
    """Complete one frame, or many, and return the exit code: 3 where some of many failed."""
    check_together(options)
    if any(getattr(options, name) for name in (*FOLDERS, *MORE_FOLDERS)):
        return complete_many(options)
    if options.video:
        raise ValueError("--video needs frames that follow each other: give --rgb-dir, --depth-dir and --out-dir")
    if options.suffix:
        raise ValueError("--suffix is of --out-dir; the name of --out says what kind of file it is")
    missing = [f"--{name}" for name in ("rgb", "depth", "out") if getattr(options, name) is None]
    if missing:
        raise ValueError(f"the following arguments are required: {', '.join(missing)} (see `complete --help`)")
    job = Job(options.rgb, options.depth, options.out, options.region, options.ply, options.panel)
    job.check(options.intrinsics)
    frame = read_job(job, options)
    ditr = load_system(options)
    depth = frame[1]
    completion = complete(ditr, frame, options)
    write_job(job, frame, completion, options)
    height, width = depth.shape
    region, out = completion.region, completion.depth
    print(
        f"{job.out}: {width} x {height}, {out.min():.3f} to {out.max():.3f} m; "
        f"region {region.mean():.1%}, holes filled outside it {((depth == 0) & ~region).mean():.1%}"
    )
    return 0


def check_together(options: Namespace) -> None:
    """Refuse arguments that would do nothing without another that is not there."""
    cloud, picture = options.ply or options.ply_dir, options.panel or options.panel_dir
    if cloud and not options.intrinsics:
        name = "--ply" if options.ply else "--ply-dir"
        raise ValueError(f"{name} needs the camera: give --intrinsics FILE (3x3 matrix, or lines fx: cx: ...)")
    if options.intrinsics and not cloud:
        raise ValueError("--intrinsics is of a point cloud: give --ply, or --ply-dir for many frames")
    if (options.region or options.region_dir) and (options.threshold is not None or options.refine is not None):
        name = "--threshold" if options.threshold is not None else "--refine"
        raise ValueError(f"{name} is of stage one, which does not run where the region is given: leave out one of them")
    if options.panel_width and not picture:
        raise ValueError("--panel-width is of a picture: give --panel, or --panel-dir for many frames")


def complete_many(options: Namespace) -> int:
    """Complete the frames of folders or patterns, go on after bad ones, and report those at the end."""
    from tqdm.auto import tqdm

    jobs = jobs_of(options)
    for job in jobs:
        job.check(options.intrinsics)
    waiting = jobs if options.video else [job for job in jobs if not job.is_done]
    failed: list[tuple[Path, str]] = []
    ranges: list[tuple[float, float]] = []
    system = load_system(options) if waiting else None
    if options.video:
        from .video import Steady

        system = Steady(system)
    for job in tqdm(waiting, desc="frames", unit="frame"):
        try:
            frame = read_job(job, options)
            completion = complete(system, frame, options)
            write_job(job, frame, completion, options)
            ranges.append((completion.depth.min(), completion.depth.max()))
        except (ValueError, OSError) as error:
            failed.append((job.depth, " ".join(str(error).split())))
    for path, reason in failed:
        print(f"ditr_lite: {path} failed: {reason}", file=sys.stderr)
    kept, done = len(jobs) - len(waiting), len(waiting) - len(failed)
    print(f"{options.out_dir}: {done} frames completed, {kept} were there already, {len(failed)} failed")
    if ranges:
        print(f"completed depth lies between {min(a for a, _ in ranges):.3f} and {max(b for _, b in ranges):.3f} m")
    if kept:
        print("what was there is kept, whatever settings made it: another --out-dir completes it anew")
    return 3 if failed else 0


def jobs_of(options: Namespace) -> list[Job]:
    """Pair the files of folders or patterns by their names.

    Raises:
        ValueError: for a folder that is missing, arguments of one frame beside those of many, or files without partner.
    """
    if missing := [f"--{name.replace('_', '-')}" for name in FOLDERS if getattr(options, name) is None]:
        raise ValueError(f"many frames need --rgb-dir, --depth-dir and --out-dir; {', '.join(missing)} is missing")
    single = [name for name in ("rgb", "depth", "out", "region", "ply", "panel") if getattr(options, name) is not None]
    if single:
        raise ValueError(f"--{single[0]} is of one frame, --rgb-dir, --depth-dir and --out-dir of many: give either")
    from ..files import COLOUR, MASK

    colour, depth = by_name(options.rgb_dir, COLOUR), by_name(options.depth_dir, DEPTH)
    regions = by_name(options.region_dir, MASK) if options.region_dir else {}
    if len(colour) == len(depth) == 1:  # one of each belong together, whatever they are called
        colour = dict(zip(depth, colour.values(), strict=True))
        regions = dict(zip(depth, regions.values(), strict=True)) if len(regions) == 1 else regions
    elif not colour.keys() & depth.keys():
        colour, depth, regions = (between(found) for found in (colour, depth, regions))
    names = sorted(colour.keys() & depth.keys(), key=in_order)
    if not names:
        raise ValueError(
            f"no picture in {options.rgb_dir} has a depth map of its name in {options.depth_dir}: call both alike"
        )
    alone = len(colour.keys() ^ depth.keys())
    if alone:
        print(f"ditr_lite: {alone} files have no partner and are left out", file=sys.stderr)
    if options.region_dir and (without := [name for name in names if name not in regions]):
        raise ValueError(f"{options.region_dir} has no mask for {without[0]}: give one for every frame, or none")
    clouds, panels = options.ply_dir, options.panel_dir
    return [
        Job(
            rgb=colour[name],
            depth=depth[name],
            out=options.out_dir / f"{depth[name].stem}{options.suffix or SUFFIX}",
            region=regions.get(name),
            ply=clouds / f"{depth[name].stem}.ply" if clouds else None,
            panel=panels / f"{depth[name].stem}.png" if panels else None,
        )
        for name in names
    ]


def by_name(place: Path, endings: Sequence[str]) -> dict[str, Path]:
    """Return stem -> file of a folder or pattern; two files of one stem are refused."""
    found: dict[str, Path] = {}
    for path in frame_files(place, endings):
        if path.stem in found:
            raise ValueError(f"{path} and {found[path.stem].name} have the same name: keep one of them")
        found[path.stem] = path
    return found


def in_order(name: str) -> tuple[list[str | int], str]:
    """Return by what names are sorted as people count: f1, f2, f10."""
    words = re.split(r"(\d+)", name)  # every second one is a number
    return [int(word) if k % 2 else word for k, word in enumerate(words)], name


def between(found: dict[str, Path]) -> dict[str, Path]:
    """Return files by what tells their names apart: color_0001 and color_0002 become 1 and 2."""
    names = list(found)
    if len(names) < 2:
        return found
    start = len(os.path.commonprefix(names))
    while start and names[0][start - 1].isdigit():  # 0001 and 0002 differ in their last digit: keep all four
        start -= 1
    end = len(os.path.commonprefix([name[start:][::-1] for name in names]))
    while end and names[0][len(names[0]) - end].isdigit():
        end -= 1
    return {name[start : len(name) - end]: path for name, path in found.items()}


def read_job(job: Job, options: Namespace):
    """Return rgb, depth, region or None, camera or None, and the metres per unit of a PNG that is written."""
    from ..files import read_depth_and_unit, read_intrinsics, read_mask, read_rgb
    from ..units import upsample_sparse

    rgb, (depth, unit) = read_rgb(job.rgb), read_depth_and_unit(job.depth, options.depth_scale)
    region = read_mask(job.region) if job.region else None
    if options.upsample_depth and depth.shape != rgb.shape[:2]:
        try:
            depth = upsample_sparse(depth, rgb.shape[:2])
        except ValueError as error:
            raise ValueError(f"{job.depth}: {error}") from None
    for path, array in ((job.depth, depth), (job.region, region)):
        if array is not None and array.shape != rgb.shape[:2]:
            small = path == job.depth and all(n < m for n, m in zip(array.shape, rgb.shape[:2], strict=True))
            advice = "if it is aligned, but of lower resolution, give --upsample-depth" if small else "align them first"
            raise ValueError(f"{path} is {array.shape}, {job.rgb} {rgb.shape[:2]} (height, width): {advice}")
    camera = read_intrinsics(options.intrinsics, rgb.shape[:2]) if options.intrinsics else None
    return rgb, depth, region, camera, unit


def complete(system, frame, options: Namespace):
    """Let the system complete a frame."""
    rgb, depth, region, *_ = frame
    how = {"steps": options.steps, "samples": options.samples, "seed": options.seed}
    return system(rgb, depth, region, adjust=options.adjust, **how)


def write_job(job: Job, frame, completion, options: Namespace) -> None:
    """Write what the command line asks for."""
    from ..files import write_depth, write_ply

    rgb, depth, _, camera, unit = frame
    write_depth(job.out, completion.depth, unit)
    if job.ply:
        write_ply(job.ply, completion.depth, rgb, camera)
    if job.panel:
        from ..viz import save_panel

        maps = (depth, completion.depth, completion.region, completion.std)
        save_panel(job.panel, rgb, *maps, width=options.panel_width or PANEL_WIDTH)
