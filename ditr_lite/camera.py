"""The camera between pixels and metres: its intrinsics on disk, unprojection, point clouds as PLY."""

from pathlib import Path

import numpy as np

from .data import Camera
from .files import check_depth, read_array, written_whole

KEYS = ("fx", "fy", "cx", "cy", "xres", "yres")


def read_intrinsics(path: Path | str, size: tuple[int, int] | None = None) -> Camera:
    """Read a pinhole camera.

    Args:
        path: a 3x3 matrix as text or .npy, or lines ``fx: ...`` with fx, fy, cx, cy and perhaps xres, yres (.yaml).
        size: (height, width) of the picture; needed where the file does not say it, checked where it does.

    Raises:
        ValueError: for a file of another kind, an unknown or contradictory size, a number that is not finite, or a
            focal length <= 0.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"no file {path}")
    values = _yaml(path) if path.suffix in (".yaml", ".yml") else _matrix(path)
    missing = {"fx", "fy", "cx", "cy"} - set(values)
    if missing:
        raise ValueError(f"{path} lacks {', '.join(sorted(missing))}: expected fx, fy, cx and cy in pixels")
    wrong = [f"{key} {values[key]}" for key in KEYS if not np.isfinite(values.get(key, 0))]
    if wrong:
        raise ValueError(f"{path} should hold finite numbers, got {', '.join(wrong)}")
    if not (values["fx"] > 0 and values["fy"] > 0):
        raise ValueError(f"{path} should have positive focal lengths, got fx {values['fx']}, fy {values['fy']}")
    own = (int(values["yres"]), int(values["xres"])) if {"xres", "yres"} <= set(values) else None
    if own is None and size is None:
        raise ValueError(f"{path} does not say its picture's size: pass size=(height, width)")
    if own and size and own != tuple(size):
        raise ValueError(f"{path} is for pictures of {own} (height, width), not {tuple(size)}: use Camera.resized")
    height, width = own or size
    return Camera(values["fx"], values["fy"], values["cx"], values["cy"], int(width), int(height))


def write_ply(path: Path | str, depth_m: np.ndarray, rgb: np.ndarray, camera: Camera) -> int:
    """Write the valid pixels as a coloured point cloud (binary PLY) and return how many there are.

    Coordinates are the camera's own: metres, x right, y down, z forward.

    Raises:
        ValueError: when depth, RGB and camera differ in size.
    """
    points = unproject(depth_m, camera)
    if rgb.shape != (*depth_m.shape, 3) or rgb.dtype != np.uint8:
        raise ValueError(f"rgb should be {(*depth_m.shape, 3)} uint8 like the depth map, got {rgb.shape} {rgb.dtype}")
    fields = [(name, "<f4") for name in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")]
    vertices = np.empty(len(points), dtype=fields)
    for k, (name, _) in enumerate(fields):
        vertices[name] = points[:, k] if k < 3 else rgb[depth_m > 0][:, k - 3]
    header = ["ply", "format binary_little_endian 1.0", "comment metres, camera frame: x right, y down, z forward"]
    header += [f"element vertex {len(points)}"]
    header += [f"property {'float' if kind == '<f4' else 'uchar'} {name}" for name, kind in fields]
    with written_whole(path) as part:
        part.write_bytes(("\n".join(header) + "\nend_header\n").encode("ascii") + vertices.tobytes())
    return len(points)


def unproject(depth_m: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the 3-D points of the valid pixels, row by row: x = (u - cx) z / fx, y = (v - cy) z / fy.

    Args:
        depth_m: (H, W) float metres, 0 = missing.
        camera: of the same size.

    Returns:
        (N, 3) float64 metres, N = number of pixels with depth > 0; x right, y down, z forward.

    Raises:
        ValueError: when the camera's size is not the map's, or the map is not a depth map.
    """
    depth_m = check_depth(depth_m)
    if depth_m.shape != (camera.height, camera.width):
        raise ValueError(
            f"the camera is for {(camera.height, camera.width)} (height, width), the depth map is {depth_m.shape}: "
            "use Camera.resized"
        )
    v, u = np.nonzero(depth_m > 0)
    z = depth_m[v, u].astype(np.float64)
    return np.stack([(u - camera.cx) * z / camera.fx, (v - camera.cy) * z / camera.fy, z], axis=1)


def _yaml(path: Path) -> dict[str, float]:
    """Return the ``name: number`` lines of a file; all that a camera file needs of YAML."""
    values = {}
    for line in path.read_text().splitlines():
        key, _, value = line.partition("#")[0].partition(":")
        try:
            values[key.strip()] = float(value)
        except ValueError:
            continue  # a comment, a heading, a camera's name
    return values


def _matrix(path: Path) -> dict[str, float]:
    try:
        k = read_array(path) if path.suffix == ".npy" else np.loadtxt(_rows(path))
    except ValueError as error:
        raise ValueError(f"cannot read {path} as a 3x3 camera matrix: {error}") from None
    if k.shape != (3, 3) or not np.allclose(k[2], [0, 0, 1]):
        raise ValueError(f"{path} should hold a 3x3 camera matrix with last row 0 0 1, got shape {k.shape}")
    return {"fx": float(k[0, 0]), "fy": float(k[1, 1]), "cx": float(k[0, 2]), "cy": float(k[1, 2])}


def _rows(path: Path) -> list[str]:
    """Return the lines of a file of numbers, without commas and comments."""
    lines = (line.partition("#")[0].replace(",", " ").strip() for line in path.read_text().splitlines())
    rows = [line for line in lines if line]
    if not rows:  # NumPy would warn and return an empty array
        raise ValueError("it holds no numbers")
    return rows
