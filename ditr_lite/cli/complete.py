"""``complete``: one RGB-D frame of any camera becomes dense depth; on request a point cloud and a picture too."""

from argparse import ArgumentParser, Namespace
from pathlib import Path

from .shared import add_system, check_target, load_system, seed


def add_arguments(p: ArgumentParser) -> None:
    """Add what ``complete`` takes."""
    p.add_argument("--rgb", type=Path, required=True, help="8-bit colour picture (PNG, JPEG) or .npy")
    p.add_argument("--depth", type=Path, required=True, help="16-bit PNG, .npy or .exr, aligned to --rgb, 0 = missing")
    p.add_argument(
        "--depth-scale", type=float, default=0.001, help="metres per unit of a whole-number depth map (%(default)s)"
    )
    p.add_argument("--region", type=Path, help="mask of the transparent and reflective region; else it is found")
    p.add_argument("--out", type=Path, required=True, help="completed depth: .png (mm), .npy or .exr (m)")
    p.add_argument("--ply", type=Path, help="also write a point cloud; needs --intrinsics")
    p.add_argument("--panel", type=Path, help="also write a picture of before and after (.png)")
    p.add_argument("--intrinsics", type=Path, help="3x3 matrix as text or .npy, or .yaml with fx, fy, cx, cy")
    p.add_argument("--seed", type=seed, default=0, help="of the noise (%(default)s)")
    p.add_argument("--adjust", action="store_true", help="let readings outside the region change too")
    add_system(p)


def run(options: Namespace) -> None:
    """Complete one RGB-D frame of any camera and write the depth; on request a point cloud and a picture too."""
    check_target(options.out, ".png", ".npy", ".exr")
    check_target(options.ply, ".ply")
    check_target(options.panel, ".png")
    if options.ply and not options.intrinsics:
        raise ValueError("--ply needs the camera: give --intrinsics FILE (3x3 matrix, or lines fx: cx: ...)")
    from ..files import read_depth, read_intrinsics, read_mask, read_rgb, write_depth, write_ply

    rgb, depth = read_rgb(options.rgb), read_depth(options.depth, options.depth_scale)
    region = read_mask(options.region) if options.region else None
    for path, array in ((options.depth, depth), (options.region, region)):
        if array is not None and array.shape != rgb.shape[:2]:
            raise ValueError(
                f"{path} is {array.shape}, {options.rgb} {rgb.shape[:2]} (height, width): align them first"
            )
    camera = read_intrinsics(options.intrinsics, rgb.shape[:2]) if options.intrinsics else None
    ditr = load_system(options)
    out = ditr(rgb, depth, region, options.steps, options.samples, options.adjust, options.seed)
    write_depth(options.out, out.depth)
    if options.ply:
        write_ply(options.ply, out.depth, rgb, camera)
    if options.panel:
        from ..viz import save_panel

        save_panel(options.panel, rgb, depth, out.depth, out.region, out.std)
    height, width = out.depth.shape
    holes = ((depth == 0) & ~out.region).mean()
    print(
        f"{options.out}: {width} x {height}, {out.depth.min():.3f} to {out.depth.max():.3f} m; "
        f"region {out.region.mean():.1%}, holes filled outside it {holes:.1%}"
    )
