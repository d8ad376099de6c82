"""Score DITR, its learned peers, its ablation and its oracles: same frames, same region from stage one, same pixels.

Every row is kept in a file of its own as soon as it is complete, with a checksum of the weights and settings that it
depends on: what is asked again costs nothing, and after a change of weights only what depends on them is computed anew.
"""

import hashlib
import importlib.util
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from tqdm.auto import tqdm

from .. import metrics
from ..baselines import REGISTRY
from ..config import RefineConfig, StdConfig, to_dict
from ..data import Sample
from ..files import read_json, write_depth, write_json
from ..pipeline import Ditr, compose
from ..store import read_card
from ..studies.floor import reconstruct
from ..studies.peer_tables import EQUAL, IDEAS, SETS, SHIPPED
from ..studies.swaps import SWAPS, Swapped
from ..windows import fit_frame
from . import system

NEED_TRUTH = (  # rows that cannot be asked about a frame without truth
    *("true region", "truth through the autoencoder", "equal time, true region", "truth at the working size"),
)
NEEDED = ("ditr", "dp", "bb", "regression")  # arms that the tables and verdicts set others beside
MOVED_M = 0.02  # a reading that moved by more was thrown away
NO_GLASS = "(no glass)"  # in the name of a real frame that is known to show none
Row = dict[str, float | None]


@dataclass(frozen=True)
class Found:
    """What stage one found in a frame, (H, W) bool each: the region, and the mask before refinement."""

    region: np.ndarray
    unrefined: np.ndarray


Method = Callable[[Sample, Found], np.ndarray]  # -> depth (H, W) metres


def find(ditr: Ditr, sample: Sample) -> Found:
    """Run stage one of the shipped system."""
    _, region = ditr.find_region(sample.rgb, sample.depth)
    _, unrefined = ditr.find_region(sample.rgb, sample.depth, refine=RefineConfig(0, 0, 0))
    return Found(region, unrefined)


def methods(ditr: Ditr, folder: Path | str) -> dict[str, tuple[Method, str]]:
    """Return row -> method and a checksum of what it depends on, beside the frames.

    Args:
        ditr: the shipped system.
        folder: weights of the arms, as ``tools/train_peers.py`` writes them.

    Raises:
        ValueError: when one of :data:`NEEDED` has not been trained there.
    """
    arms = system.trained(folder)
    if missing := [arm for arm in NEEDED if arm not in arms]:
        asked = f"run `python tools/train_peers.py {' '.join(missing)}` first"
        raise ValueError(f"{folder} holds no trained {missing[0]!r}, with which all others are compared: {asked}")
    settings = json.dumps(to_dict(replace(ditr.config, std=StdConfig())), sort_keys=True)  # std moves no depth
    shipped = _key(settings, *(part["sha256"] for part in read_card()["parts"].values()))
    stage_one = _key(settings, read_card()["parts"]["region"]["sha256"])
    parts = read_card(folder)["parts"]

    def arm_key(arm: str, seed: int) -> str:
        own = [part["sha256"] for n, part in parts.items() if part.get("arm") == arm and part["seed"] == seed]
        if arm == system.ALIGNED:
            own = [parts[f"rgb_only-{seed}"]["sha256"]]
        return _key(stage_one, *own)

    rows: dict[str, tuple[Method, str]] = {}
    for seed in arms["ditr"]:
        name = EQUAL if seed == 0 else f"{EQUAL}, seed {seed}"
        rows[name] = (_arm(folder, "ditr", seed), arm_key("ditr", seed))
    for peer in IDEAS:
        for seed in arms.get(peer, ()):
            rows[peer if seed == 0 else f"{peer}, seed {seed}"] = (_arm(folder, peer, seed), arm_key(peer, seed))
    for seed in sorted(set(arms.get("bb", ())) & set(arms.get("dp", ()))):
        rows[f"BB, seed {seed}"] = (_backbone(folder, seed), arm_key("bb", seed))
        rows[f"+DP, seed {seed}"] = (_arm(folder, "dp", seed, unrefined=True), arm_key("dp", seed))
        rows[f"+RR, seed {seed}"] = (_arm(folder, "dp", seed), arm_key("dp", seed))
    for name, oracle in equal_oracles(folder).items():
        rows[name] = (oracle, arm_key("ditr", 0))
    for name, fill in REGISTRY.items():
        rows[name] = (partial(_baseline, fill), stage_one)
    for name, oracle in shipped_methods(ditr).items():
        rows[name] = (oracle, shipped)
    return rows


def shipped_methods(ditr: Ditr) -> dict[str, Method]:
    """Return the shipped system and its oracles."""
    plain = Swapped(ditr, SWAPS["no detail"])

    def floor(sample: Sample, found: Found) -> np.ndarray:
        painted = reconstruct(ditr.parts["autoencoder"], sample)[0]
        return compose(sample.depth, painted, painted, found.region)

    return {
        SHIPPED: lambda s, found: ditr(s.rgb, s.depth, found.region).depth,
        "true region": lambda s, found: ditr(s.rgb, s.depth, s.region).depth,
        "no detail network": lambda s, found: plain.paint(s, found.region),
        "truth through the autoencoder": floor,
        "one sample": lambda s, found: ditr(s.rgb, s.depth, found.region, samples=1).depth,
        "sixteen samples": lambda s, found: ditr(s.rgb, s.depth, found.region, samples=16).depth,
    }


def equal_oracles(folder: Path | str) -> dict[str, Method]:
    """Return oracles of DITR at equal time."""
    loaded = _Once(folder, "ditr", 0)

    def plain(sample: Sample, found: Found) -> np.ndarray:
        return Swapped(loaded(), SWAPS["no detail"]).paint(sample, found.region)

    def size(sample: Sample, found: Found) -> np.ndarray:
        frame = fit_frame(sample.depth.shape, loaded().config.size)
        painted = frame.back(frame.into(sample.depth_gt))
        painted = np.where(painted > 0, painted, 1.0)  # where no truth is known nothing is scored
        return compose(sample.depth, painted, painted, found.region)

    return {
        "equal time, true region": lambda s, found: loaded()(s.rgb, s.depth, s.region).depth,
        "equal time, no detail network": plain,
        "truth at the working size": size,
    }


class _Once:
    """An arm that is loaded when it is first called for."""

    def __init__(self, folder: Path | str, arm: str, seed: int):
        self.given, self.loaded = (folder, arm, seed), None

    def __call__(self) -> Ditr:
        if self.loaded is None:
            self.loaded = system.load_arm(*self.given)
        return self.loaded


def _arm(folder: Path | str, arm: str, seed: int, unrefined: bool = False) -> Method:
    loaded = _Once(folder, arm, seed)

    def call(sample: Sample, found: Found) -> np.ndarray:
        return loaded()(sample.rgb, sample.depth, found.unrefined if unrefined else found.region).depth

    return call


def _backbone(folder: Path | str, seed: int) -> Method:
    """Return BB: no stage one, no partition; the whole frame is painted, readings included."""
    loaded = _Once(folder, "bb", seed)
    return lambda s, _: loaded()(s.rgb, s.depth, np.zeros(s.depth.shape, bool), adjust=True).depth


def _baseline(fill: Callable, sample: Sample, found: Found) -> np.ndarray:
    filled = fill(sample.rgb, sample.depth, found.region)
    return compose(sample.depth, filled, filled, found.region)


def _key(*checksums: str) -> str:
    return hashlib.sha256("".join(sorted(checksums)).encode()).hexdigest()[:16]


def score_rows(
    rows: Mapping[str, tuple[Method, str]],
    frames: Sequence[tuple[Sample, Found]],
    folder: Path | str,
    measure: Callable[[np.ndarray, Sample], Row],
) -> dict[str, dict[str, Row]]:
    """Return frame -> row -> scores; a row that is in ``folder`` already, of the same frames and weights, is read.

    Args:
        rows: as :func:`methods` returns them.
        frames: with what stage one found in each.
        folder: for one file a row.
        measure: completed depth and frame -> scores.
    """
    scores: dict[str, dict[str, Row]] = {sample.name: {} for sample, _ in frames}
    for name, (method, key) in tqdm(rows.items(), desc="methods", unit="method"):
        file = Path(folder) / f"{name.replace(' ', '_').replace(',', '')}.json"
        kept = read_json(file) if file.is_file() else {"key": None, "scores": {}}
        done = kept["scores"] if kept["key"] == key else {}
        left = [(s, found) for s, found in frames if frame_key(s) not in done]
        for sample, found in left:
            done[frame_key(sample)] = measure(method(sample, found), sample)
        if left:
            file.parent.mkdir(parents=True, exist_ok=True)
            write_json(file, {"key": key, "scores": done})
        for sample, _ in frames:
            scores[sample.name][name] = done[frame_key(sample)]
    return scores


def frame_key(sample: Sample) -> str:
    """Return what scores of a frame are kept by: its name, and a checksum of all that they depend on."""
    maps = (sample.rgb, sample.depth, sample.depth_gt, sample.region)
    digest = hashlib.sha256(b"".join(np.ascontiguousarray(m).tobytes() for m in maps if m is not None))
    return f"{sample.name} {digest.hexdigest()[:12]}"


def paint_failures(
    rows: Mapping[str, tuple[Method, str]],
    frames: Sequence[tuple[Sample, Found]],
    failures: Mapping[str, str],
    folder: Path | str,
) -> None:
    """Write what each peer completes of its frame (peer -> frame) as ``folder/PEER.png``, in millimetres."""
    Path(folder).mkdir(parents=True, exist_ok=True)
    by_name = {sample.name: (sample, found) for sample, found in frames}
    for peer, frame in failures.items():
        write_depth(Path(folder) / f"{peer}.png", rows[peer][0](*by_name[frame]))


def score_rendered(depth: np.ndarray, sample: Sample, sets: Sequence[str] = SETS) -> Row:
    """Return the RMSE in metres on each pixel set of a frame whose region is known."""
    found = metrics.evaluate(depth, sample.depth_gt, sample.region, sample.depth)
    return {key: found[key] and round(found[key]["rmse"], 6) for key in sets}


def score_real(depth: np.ndarray, sample: Sample) -> Row:
    """Return the scores of a real frame: as :func:`score_rendered`, or without truth the share of readings that moved.

    The share is None where nobody knows what is glass: no region, and no ``(no glass)`` in the frame's name.
    """
    if sample.depth_gt is not None:
        return score_rendered(depth, sample)
    known = sample.region is not None or NO_GLASS in sample.name
    return {"moved": round(moved_share(depth, sample), 6) if known else None}


def moved_share(depth: np.ndarray, sample: Sample) -> float:
    """Return the share of the readings outside the region that moved; without a known region, of all readings."""
    counted = sample.depth > 0
    if sample.region is not None:
        counted &= ~sample.region
    moved = counted & (np.abs(depth - sample.depth) > MOVED_M)
    return float(moved.sum() / max(1, counted.sum()))


def frames_of_file(file: Path | str) -> list[Sample]:
    """Return the frames that a Python file of the reader's own yields.

    Args:
        file: defines ``frames()``, a generator of (name, rgb (H, W, 3) uint8, raw depth (H, W) metres, true depth or
            None, region (H, W) bool or None).

    Raises:
        ValueError: when there is no such file or function.
    """
    file = Path(file)
    if not file.is_file():
        raise ValueError(f"{file}: no such file; it should define frames(), see peers.compare.frames_of_file")
    spec = importlib.util.spec_from_file_location("frames_of_file", file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    if not callable(getattr(module, "frames", None)):
        raise ValueError(f"{file} defines no frames()")
    return [_sample(*given) for given in module.frames()]


def _sample(name: str, rgb: np.ndarray, raw: np.ndarray, truth: np.ndarray | None, region: np.ndarray | None) -> Sample:
    raw = np.where(np.isfinite(raw) & (raw > 0), raw, 0).astype(np.float32)
    return Sample(name=name, rgb=rgb, depth=raw, depth_gt=truth, region=region, camera=None)


def frames_of(ditr: Ditr, samples: Iterable[Sample], count: int | None = None) -> list[tuple[Sample, Found]]:
    """Return frames with what stage one finds in each."""
    return [(s, find(ditr, s)) for s in tqdm(samples, desc="stage one", unit="frame", total=count)]


def trained_notes(folder: Path | str) -> dict[str, Any]:
    """Return, per network, what of the arms' card belongs into a results file."""
    keys = ("arm", "minutes", "cpu_seconds", "seed", "steps", "scenes", "parameters", "sha256")
    parts = read_card(folder)["parts"]
    return {name: {k: part[k] for k in keys} for name, part in parts.items() if "arm" in part}
