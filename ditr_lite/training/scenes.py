"""Rendered scenes as arrays in memory, and pools of them that training draws from."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from torch import nn
from tqdm.auto import tqdm

from ..config import Config, to_dict
from ..data import read_sample, sample_folders
from ..region import IGNORE
from ..store import fingerprint
from ..units import depth_to_png
from ..windows import fit_frame

MAPS = ("rgb", "depth", "depth_gt", "material", "instances")  # what every scene has


@dataclass(frozen=True)
class Scenes:
    """N scenes of one size.

    Attributes:
        names: of the scenes.
        rgb: (N, H, W, 3) uint8.
        depth, depth_gt: (N, H, W) uint16 millimetres, 0 = missing or unknown.
        material: (N, H, W) uint8, 0 opaque, 1 transparent, 2 reflective.
        instances: (N, H, W) uint8, 0 what stands on nothing (table, walls), otherwise one number a thing.
        key: what stands for the content where the arrays are not in memory; "" has them looked through.
    """

    names: list[str]
    rgb: np.ndarray
    depth: np.ndarray
    depth_gt: np.ndarray
    material: np.ndarray
    instances: np.ndarray
    key: str = ""

    def __len__(self) -> int:
        return len(self.names)


class Pool:
    """Groups of scenes, each drawn with its own share; a group may have a size of its own.

    Args:
        groups: of scenes.
        shares: of the draws, one a group; by default each group counts by its number of scenes.
    """

    def __init__(self, groups: Sequence[Scenes], shares: Sequence[float] | None = None):
        weights = np.array([len(g) for g in groups] if shares is None else shares, dtype=float)
        if len(weights) != len(groups) or not len(groups) or (weights < 0).any() or not weights.sum() > 0:
            raise ValueError(f"expected a share of at least 0 for each of {len(groups)} groups, got {shares}")
        self.groups, self.shares = tuple(groups), weights / weights.sum()

    def __len__(self) -> int:
        return sum(len(g) for g in self.groups)

    def __getitem__(self, place: int) -> tuple[Scenes, int]:
        """Return the group and the place in it of scene ``place`` of all."""
        for group in self.groups:
            if place < len(group):
                return group, place
            place -= len(group)
        raise IndexError(f"the pool has {len(self)} scenes")

    @property
    def even(self) -> bool:
        """Whether every scene is drawn alike often."""
        return np.allclose(self.shares, np.array([len(g) for g in self.groups]) / len(self))

    def pick(self, rng: np.random.Generator) -> tuple[Scenes, int]:
        """Draw a group and a scene of it."""
        group = self.groups[int(rng.choice(len(self.groups), p=self.shares))]
        return group, int(rng.integers(len(group)))


def load_scenes(folder: Path | str, limit: int | None = None) -> Scenes:
    """Read the scenes of a folder that ``simulate`` wrote.

    Args:
        folder: e.g. ``outputs/scenes/train``.
        limit: read only the first ones.

    Raises:
        ValueError: when there is no scene, one without ground truth, material or instances, or for a limit below 1.
    """
    if limit is not None and limit < 1:
        raise ValueError(f"the limit (--limit) should be at least 1 scene, got {limit}")
    folder = Path(folder)
    paths = sample_folders(folder)[:limit]
    if not paths:
        raise ValueError(
            f"no scenes in {folder}: make them with `make samples` or `python -m ditr_lite simulate`; frames of a "
            "dataset or of your own are given by --dataset, --root and --val-root"
        )
    samples = [read_sample(p) for p in tqdm(paths, desc="reading scenes", unit="scene", leave=False)]
    for s in samples:
        missing = [name for name in ("depth_gt", "material", "instances") if getattr(s, name) is None]
        if missing:
            raise ValueError(f"{folder / s.name} has no {' and no '.join(missing)}, which training needs")
    return Scenes(
        names=[s.name for s in samples],
        rgb=np.stack([s.rgb for s in samples]),
        depth=np.stack([depth_to_png(s.depth) for s in samples]),
        depth_gt=np.stack([depth_to_png(s.depth_gt) for s in samples]),
        material=np.stack([s.material for s in samples]),
        instances=np.stack([s.instances for s in samples]),
    )


def shrink(scenes: Scenes, size: tuple[int, int]) -> Scenes:
    """Return scenes at a working size, brought there as the system brings a frame there."""
    frame = fit_frame(scenes.depth.shape[1:], size)
    small = {name: np.stack([frame.into(image) for image in getattr(scenes, name)]) for name in MAPS}
    metres = (depth.astype(np.float32) / 1000 for depth in scenes.depth)  # as floats, sparse readings are pooled
    small["depth"] = np.stack([depth_to_png(frame.into(depth)) for depth in metres])
    small["material"][:, ~frame.picture] = IGNORE
    return Scenes(names=scenes.names, **small)


def first(scenes: Scenes, count: int | None) -> Scenes:
    """Return the first ``count`` scenes, all for None."""
    some = {name: getattr(scenes, name)[:count] for name in MAPS}
    return Scenes(names=scenes.names[:count], **some, key=scenes.key)


def join(groups: Sequence[Scenes], size: tuple[int, int]) -> Scenes:
    """Return groups as one, brought to a working size where their sizes differ."""
    if len(groups) == 1:
        return groups[0]
    if len({group.depth.shape[1:] for group in groups}) > 1:
        groups = [shrink(group, size) for group in groups]
    maps = {name: np.concatenate([np.stack([*getattr(g, name)]) for g in groups]) for name in MAPS}
    return Scenes(names=[name for group in groups for name in group.names], **maps)


def every(scenes: Scenes, places: Sequence[int]) -> Scenes:
    """Return the scenes at these places; what is not in memory stays on disk."""
    places = np.asarray(places, dtype=int)
    some = {name: getattr(scenes, name)[places] for name in MAPS}
    key = f"{scenes.key} {places.tolist()}" if scenes.key else ""
    return Scenes(names=[scenes.names[i] for i in places], **some, key=key)


def described(*groups: Scenes) -> list[dict[str, Any]]:
    """Return of each group how many scenes it has, the first and the last name, and its checksum: for results files."""
    return [
        {"scenes": len(g), "first": g.names[0], "last": g.names[-1], "sha256": checksum(g)} for g in groups if len(g)
    ]


def checksum(*groups: Scenes) -> str:
    """Return the SHA-256 of all that a network can see of groups of scenes, and of their names."""
    digest = hashlib.sha256()
    for scenes in groups:
        digest.update("\n".join(scenes.names).encode())
        if scenes.key:
            digest.update(scenes.key.encode())
            continue
        for name in MAPS:
            maps = getattr(scenes, name)
            digest.update(f"{name} {maps.shape}".encode())
            digest.update(np.ascontiguousarray(maps).ravel())
    return digest.hexdigest()


def checkpoint_key(config: Config, groups: Sequence[Scenes], given: Mapping[str, nn.Module]) -> str:
    """Return what a checkpoint must agree on, beside recipe and seed, to be gone on with: the ``key`` of ``loop.fit``.

    Args:
        config: sizes.
        groups: of scenes that are trained on.
        given: name -> network that is trained already and that the new one builds on.
    """
    built_on = {name: fingerprint(network) for name, network in given.items()}
    return json.dumps([to_dict(config), checksum(*groups), built_on], sort_keys=True)
