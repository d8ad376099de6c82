"""Rendered scenes as arrays in memory, and the batches that training draws from them."""

import hashlib
import zipfile
import zlib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from tqdm.auto import tqdm

from ..boundary import Backend, boundary_maps, get_backend
from ..conditioning import depth_bounds, fit, to_tensor
from ..data import read_sample
from ..files import written_whole
from .augment import colours, lose_readings

MAPS = ("rgb", "depth", "depth_gt", "material")  # what every scene has


@dataclass(frozen=True)
class Scenes:
    """N scenes of one size.

    Attributes:
        names: of the scenes.
        rgb: (N, H, W, 3) uint8.
        depth, depth_gt: (N, H, W) uint16 millimetres, 0 = missing or unknown.
        material: (N, H, W) uint8, 0 opaque, 1 transparent, 2 reflective.
        guides: (N, 2, H, W) uint8, M_RGB and M_DA; None unless asked for.
    """

    names: list[str]
    rgb: np.ndarray
    depth: np.ndarray
    depth_gt: np.ndarray
    material: np.ndarray
    guides: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.names)


def load_scenes(
    folder: Path | str, limit: int | None = None, boundary: str | None = None, cache: Path | str | None = None
) -> Scenes:
    """Read the scenes of a folder that ``simulate`` wrote.

    Args:
        folder: e.g. ``outputs/scenes/train``.
        limit: read only the first ones.
        boundary: backend whose maps to add; they are computed once.
        cache: file in which the maps are kept; by default one beside the folder.

    Raises:
        ValueError: when there is no scene, or one without ground truth or material, or for a limit below 1.
    """
    if limit is not None and limit < 1:
        raise ValueError(f"the limit (--limit) should be at least 1 scene, got {limit}")
    folder = Path(folder)
    paths = sorted(p.parent for p in folder.glob("*/meta.json") if not p.parent.name.endswith(".part"))[:limit]
    if not paths:
        raise ValueError(f"no scenes in {folder}: make them with `make samples` or `python -m ditr_lite simulate`")
    samples = [read_sample(p) for p in tqdm(paths, desc="reading scenes", unit="scene", leave=False)]
    for s in samples:
        if missing := [name for name in ("depth_gt", "material") if getattr(s, name) is None]:
            raise ValueError(f"{folder / s.name} has no {' and no '.join(missing)}, which training needs")
    millimetres = [[np.rint(d * 1000).astype(np.uint16) for d in (s.depth, s.depth_gt)] for s in samples]
    guides = None
    if boundary is not None:
        store = Path(cache) if cache else folder.parent / f"{folder.name}-{boundary}.npz"
        guides = _guides(paths, boundary, store)
    return Scenes(
        names=[s.name for s in samples],
        rgb=np.stack([s.rgb for s in samples]),
        depth=np.stack([m[0] for m in millimetres]),
        depth_gt=np.stack([m[1] for m in millimetres]),
        material=np.stack([s.material for s in samples]),
        guides=guides,
    )


def shrink(scenes: Scenes, size: tuple[int, int], boundary: str = "classical") -> Scenes:
    """Return scenes at a working size, brought there as the system brings a frame there, with guides found there."""
    frame, backend = fit(scenes.depth.shape[1:], size), get_backend(boundary)
    small = {name: np.stack([frame.into(image) for image in getattr(scenes, name)]) for name in MAPS}
    metres = small["depth"].astype(np.float32) / 1000
    pairs = zip(small["rgb"], metres, strict=True)
    maps = [frame.on_picture(boundary_maps, rgb, depth, backend=backend) for rgb, depth in pairs]
    guides = np.stack([np.stack([m_rgb, m_da]) for m_rgb, _, m_da in maps]).astype(np.uint8)
    return Scenes(names=scenes.names, guides=guides, **small)


def join(groups: list[Scenes]) -> Scenes:
    """Return groups of scenes of one size, all with guides, as one."""
    maps = {name: np.concatenate([getattr(g, name) for g in groups]) for name in (*MAPS, "guides")}
    return Scenes(names=[name for g in groups for name in g.names], **maps)


def first(scenes: Scenes, count: int | None) -> Scenes:
    """Return the first ``count`` scenes, all for None."""
    maps = {name: getattr(scenes, name)[:count] for name in (*MAPS, "guides") if getattr(scenes, name) is not None}
    return Scenes(names=scenes.names[:count], **maps)


def checksum(scenes: Scenes) -> str:
    """Return the SHA-256 of all that a network can see of the scenes, and of their names."""
    digest = hashlib.sha256("\n".join(scenes.names).encode())
    for name in (*MAPS, "guides"):
        if (maps := getattr(scenes, name)) is not None:
            digest.update(f"{name} {maps.shape}".encode())
            digest.update(np.ascontiguousarray(maps).ravel())
    return digest.hexdigest()


def _guides(paths: list[Path], boundary: str, store: Path) -> np.ndarray:
    backend = get_backend(boundary)
    keys = {p: _content(p, getattr(backend, "fingerprint", "")) for p in paths}
    known = _cached(store)
    missing = [p for p in paths if keys[p] not in known]
    if missing:
        with ThreadPoolExecutor(2) as pool:  # no processes: forked after torch has run they would wait for ever
            jobs = pool.map(_guide, missing, [backend] * len(missing))
            for path, bits in zip(missing, tqdm(jobs, total=len(missing), desc="boundary maps"), strict=True):
                known[keys[path]] = bits
        with written_whole(store) as part, open(part, "wb") as file:
            wanted = list(dict.fromkeys(keys.values()))  # maps of older pictures may be of another size
            np.savez_compressed(file, names=np.array(wanted), bits=np.stack([known[key] for key in wanted]))
    height, width = read_sample(paths[0]).depth.shape
    count = 2 * height * width  # the last byte may be filled up
    return np.stack([np.unpackbits(known[keys[p]], count=count).reshape(2, height, width) for p in paths])


def _cached(store: Path) -> dict[str, np.ndarray]:
    """Return the packed maps of a cache by key: none from one that is absent or damaged."""
    try:
        with np.load(store) as saved:
            return dict(zip(saved["names"].tolist(), saved["bits"], strict=True))
    except (OSError, EOFError, KeyError, ValueError, zipfile.BadZipFile, zlib.error):  # computed anew, then replaced
        return {}


def _content(path: Path, fingerprint: str) -> str:
    """Return a key of what the maps are computed from, so that new pictures or new weights do not get old maps."""
    digest = hashlib.sha1((path / "rgb.jpg").read_bytes() + (path / "depth.png").read_bytes() + fingerprint.encode())
    return f"{path.name}:{digest.hexdigest()}"


def _guide(path: Path, backend: Backend) -> np.ndarray:
    sample = read_sample(path)
    m_rgb, _, m_da = boundary_maps(sample.rgb, sample.depth, backend)
    return np.packbits(np.stack([m_rgb, m_da]))


@dataclass(frozen=True)
class Batch:
    """Tensors of B frames in network units: rgb (B, 3, H, W) in [-1, 1], all others (B, 1, H, W)."""

    rgb: Tensor
    depth_n: Tensor  # raw, 0 where missing
    valid: Tensor
    gt_n: Tensor  # ground truth, 0 where unknown
    gt_known: Tensor
    material: Tensor  # (B, H, W) int64
    scale_m: Tensor  # (B, 1, 1, 1) metres per network unit
    guide_rgb: Tensor | None
    guide_da: Tensor | None
    index: np.ndarray  # (B,) which scenes
    flipped: np.ndarray  # (B,) bool


def draw(
    scenes: Scenes, index: np.ndarray, rng: np.random.Generator, augment: bool = True, colour: bool = True
) -> Batch:
    """Return the frames ``index`` as a batch; ``augment`` flips them and varies colour and dropouts.

    Everything random comes from ``rng``, so a step can be drawn again when training resumes. ``colour`` False leaves
    the images as they are, which is faster where nothing looks at them.
    """
    return draw_each(scenes, index, [rng] * len(index), augment, colour)


def draw_each(
    scenes: Scenes, index: np.ndarray, rngs: list[np.random.Generator], augment: bool = True, colour: bool = True
) -> Batch:
    """Return the same as :func:`draw`, with a generator for each frame."""
    frames = [_frame(scenes, i, rng, augment, colour) for i, rng in zip(index, rngs, strict=True)]
    stacked = {k: np.stack([f[k] for f in frames]) for k in frames[0] if frames[0][k] is not None}
    maps = {
        k: torch.from_numpy(v)[:, None].float()
        for k, v in stacked.items()
        if k not in ("rgb", "material", "scale_m", "flipped")
    }
    return Batch(
        rgb=to_tensor(stacked["rgb"]),
        material=torch.from_numpy(stacked["material"].astype(np.int64)),
        scale_m=torch.from_numpy(stacked["scale_m"]).float().view(-1, 1, 1, 1),
        guide_rgb=maps.pop("guide_rgb", None),
        guide_da=maps.pop("guide_da", None),
        index=np.asarray(index),
        flipped=stacked["flipped"],
        **maps,
    )


def _frame(
    scenes: Scenes, i: int, rng: np.random.Generator, augment: bool, colour: bool
) -> dict[str, np.ndarray | None]:
    rgb, material = scenes.rgb[i], scenes.material[i]
    depth, gt = scenes.depth[i].astype(np.float32) / 1000, scenes.depth_gt[i].astype(np.float32) / 1000
    guides = scenes.guides[i] if scenes.guides is not None else (None, None)
    bounds, flipped = depth_bounds(depth), False
    if augment:
        rgb = colours(rgb, rng) if colour else rgb
        depth = lose_readings(depth, rng)
        flipped = bool(rng.random() < 0.5)
        if flipped:
            rgb, material, depth, gt = (np.ascontiguousarray(a[:, ::-1]) for a in (rgb, material, depth, gt))
            guides = [None if g is None else np.ascontiguousarray(g[:, ::-1]) for g in guides]
    valid, known = depth > 0, gt > 0
    return {
        "rgb": rgb,
        "depth_n": np.where(valid, bounds.normalise(depth), 0),
        "valid": valid,
        "gt_n": np.where(known, bounds.normalise(gt), 0),
        "gt_known": known,
        "material": material,
        "scale_m": np.float32((bounds.high - bounds.low) / 2),
        "guide_rgb": guides[0],
        "guide_da": guides[1],
        "flipped": np.bool_(flipped),
    }
