"""Measure the rendered scenes and write their data card, data_samples/README.md, and its contact sheet.

    python tools/data_card.py [--scenes outputs/scenes/train] [--real DIR]

``--scenes`` is a folder of rendered training scenes to hold against real frames; where it is absent, the shipped
training samples stand in. ``--real`` is a folder of ClearGrasp's real frames; without it the card has no such columns.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from ditr_lite import baselines, viz
from ditr_lite.data import OPAQUE, REFLECTIVE, SAMPLES, SPLITS, TRANSPARENT, Sample, list_samples, read_sample
from ditr_lite.datasets import ClearGrasp
from ditr_lite.loss_types import Cause, LossType
from ditr_lite.simulator import realism
from ditr_lite.simulator.scenes import TEST_FAMILIES, TRAIN_FAMILIES

ROOT = Path(__file__).resolve().parents[1]
STRIDE = 8  # the contact sheet shows every eighth scene of the test split: taken blindly, never picked
KINDS = {"opaque": OPAQUE, "transparent": TRANSPARENT, "reflective": REFLECTIVE}


def read_all(folder: Path) -> list[Sample]:
    """Return all samples of a folder, by name."""
    return [read_sample(path.parent) for path in sorted(folder.glob("*/meta.json"))]


def table(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table; the first column is aligned left, all others right."""
    lines = [titles, ["---"] + ["---:"] * (len(titles) - 1), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def ranks(simulated: Sequence[Sample], real: Sequence[Sample]) -> list[tuple[str, str, float]]:
    """Return (statistic, frame, per cent of the simulated frames below it) for all real frames."""
    rows = [realism.frame_statistics(s) for s in simulated]
    values = [(key, s.name, v) for s in real for key, v in realism.frame_statistics(s).items()]
    return [(key, name, 100 * float(np.mean([r[key] < v for r in rows]))) for key, name, v in values]


def realism_section(simulated: Sequence[Sample], real: Sequence[Sample], which: str) -> str:
    """Return the comparison with real frames and its verdict."""
    text = f"Percentiles over {len(simulated)} {which}"
    if not real:
        return f"{text}; no real frames were at hand.\n\n```\n{realism.compare(list(simulated), [])}\n```"
    text += f", and {len(real)} real frames of ClearGrasp\n(RealSense D435), which are not part of this repository:"
    placed = ranks(simulated, real)
    out = [(key, name, rank) for key, name, rank in placed if not 5 <= rank <= 95]
    verdict = f"**{len(placed) - len(out)} of {len(placed)}** real values lie inside the simulated 5 to 95 % spread."
    if out:
        listed = "; ".join(f"`{key}` of {name} at percentile {rank:.1f}" for key, name, rank in out)
        verdict += f"\nOutside: {listed}."
    legend = "\n".join(f"- `{key}`: {meaning}" for key, meaning in realism.STATISTICS.items())
    frames = "frames are" if len(real) > 1 else "frame is"
    few = f"{len(real)} real {frames} few, too few to tell how often each case occurs."
    return f"{text}\n\n```\n{realism.compare(list(simulated), list(real))}\n```\n\n{verdict}\n\n{legend}\n\n{few}"


def split_table(splits: dict[str, list[Sample]]) -> str:
    """Return the median of every statistic, the shares of loss and cause, split by split."""
    measured = {name: [realism.frame_statistics(s) for s in samples] for name, samples in splits.items()}
    rows = [["scenes", *(str(len(samples)) for samples in splits.values())]]
    for key in realism.STATISTICS:
        medians = (float(np.nanmedian([r[key] for r in stats])) for stats in measured.values())
        rows.append([f"median `{key}`", *(f"{m:.4f}" for m in medians)])
    rows.append(["`measure_bias`, m", *(f"{baselines.measure_bias(samples):.4f}" for samples in splits.values())])
    things = {name: [t["kind"] for s in samples for t in s.meta["things"]] for name, samples in splits.items()}
    for name, kind in KINDS.items():
        counts = (things[split].count(kind) / len(samples) for split, samples in splits.items())
        rows.append([f"{name} things a scene", *(f"{c:.2f}" for c in counts)])
    for codes, key in ((LossType, "loss"), (Cause, "cause")):
        for code in codes:
            shares = [100 * np.mean([getattr(s, key) == code for s in samples]) for samples in splits.values()]
            if any(shares):
                rows.append([f"{key} {int(code)}, `{code.name}`, % of pixels", *(f"{s:.2f}" for s in shares)])
    return table(["", *splits], rows)


def largest_difference(one: Sequence[Sample], other: Sequence[Sample]) -> str:
    """Return the statistic whose medians differ most between two splits, by their ratio, and the two medians."""
    a, b = ([realism.frame_statistics(s) for s in samples] for samples in (one, other))
    medians = {key: [float(np.nanmedian([r[key] for r in rows])) for rows in (a, b)] for key in realism.STATISTICS}
    key = max(medians, key=lambda k: abs(np.log(medians[k][0] / medians[k][1])))
    return f"`{key}`, {medians[key][0]:.3f} against {medians[key][1]:.3f}"


def family_table() -> str:
    """Return which shapes each kind of thing may have, in training and in the test split."""
    rows = []
    for name, kind in KINDS.items():
        train, test = TRAIN_FAMILIES[kind], TEST_FAMILIES[kind]
        rows.append([name, ", ".join(train), "the same" if test == train else ", ".join(test)])
    return table(["things", "train and val", "test"], rows).replace("---:", "---")


def contact_sheet(samples: Sequence[Sample], path: Path) -> None:
    """Draw every :data:`STRIDE`-th sample in full colour."""
    figure = viz.contact_sheet(samples[::STRIDE], columns=8)
    Figure.savefig(figure, path, dpi=130, pil_kwargs={"optimize": True})


def seeds(samples: Sequence[Sample]) -> str:
    """Return the first and the last seed, and which between them were passed over."""
    used = [s.meta["seed"] for s in samples]
    gone = sorted(set(range(used[-1] + 1)) - set(used))
    return f"{used[0]} to {used[-1]}" + (f" without {', '.join(map(str, gone))}" if gone else "")


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=Path, default=ROOT / "outputs" / "scenes" / "train")
    parser.add_argument("--real", type=Path)
    options = parser.parse_args(arguments)
    splits = {split: read_all(SAMPLES / split) for split in SPLITS if list_samples(split)}
    rendered = read_all(options.scenes)
    wide = rendered or splits["train"]
    last = wide[-1].meta["seed"]
    which = f"{'rendered' if rendered else 'shipped'} training scenes (seeds 0 to {last})"
    real = list(ClearGrasp(options.real)) if options.real else []
    contact_sheet(splits["test"], SAMPLES / "contact_sheet.png")
    columns = ({"train, all rendered": rendered} if rendered else {}) | splits
    infrared = {split: sum(s.ir_left is not None for s in samples) for split, samples in splits.items()}
    made = [[split, str(len(s)), seeds(s), str(infrared[split])] for split, s in splits.items()]
    card = TEXT.format(
        stride=STRIDE,
        made=table(["split", "scenes", "seeds", "with infrared pair"], made),
        loss=", ".join(f"{int(c)} {c.name}" for c in LossType),
        cause=", ".join(f"{int(c)} {c.name}" for c in Cause),
        realism=realism_section(wide, real, which),
        splits=split_table(columns),
        difference=largest_difference(splits["test"], wide),
        families=family_table(),
    )
    (SAMPLES / "README.md").write_text(card, encoding="utf-8")
    size = sum(p.stat().st_size for p in SAMPLES.rglob("*") if p.is_file())
    print(
        f"{SAMPLES / 'README.md'}: {len(wide)} {which}; bias {baselines.measure_bias(wide):.4f} m; {size / 1e6:.1f} MB"
    )
    return 0


TEXT = """# Rendered scenes: data card

Table-top scenes with transparent and reflective objects, seen by a simulated active-stereo depth camera, with the
truth about every pixel: depth, object, material, what the sensor did there and why. They are made by this
repository, from nothing but seeds; no photograph, scan or other data set went in. This card and its tables are
written by `python tools/data_card.py`.

![Every scene shown here follows from a fixed stride: colour with region outline, raw depth, truth](contact_sheet.png)

Every {stride}th scene of the test split: colour with the outline of the region, raw depth (grey is missing), truth.

## How they were made

`python -m ditr_lite simulate --out DIR` (`make samples`) renders them again: Mitsuba 3, `scalar_rgb`, path-traced RGB
(four passes of four paths a pixel, their median, then a camera's own denoising) and an infrared pair under a projected
dot pattern (five paths a pixel), semi-global block matching, dropouts, reprojection into the RGB view.
`scenes.py`, `render.py`, `stereo.py` and `simulate.py` in `ditr_lite/simulator` are the whole recipe. A scene follows
from split and seed alone.

{made}

Seeds are taken from 0 upwards. A seed is passed over when less than 0.5 % of its picture is transparent or
reflective, or when the sensor reads less than a quarter of the pixels. The same seed, on the same machine and the
versions in `environment.txt`, gives the same bytes; other processors may round the last digit differently. More
training scenes than fit here: `python -m ditr_lite simulate --split train --count 1500 --out outputs/scenes`.

Eight pictures were rendered with their two lamps in the other order, so that rendering them again leaves other noise
in `rgb.jpg` and nothing else: test_00007, 42, 64, 73, 108, 113, 120 and 132.

License: Creative Commons Attribution 4.0 International (CC BY 4.0), see `LICENSE-CC-BY-4.0`.

## Files

One folder a scene, `SPLIT/SPLIT_SEED/`; all maps are 256 x 192 pixels in the view of the RGB camera.

| file | what it is |
|---|---|
| `rgb.jpg` | colour, 8 bit, sRGB |
| `depth.png` | raw sensor depth, 16 bit, millimetres, 0 = missing |
| `depth_gt.png` | depth of the first surface, glass included, 16 bit, millimetres, 0 = unknown |
| `material.png` | 0 opaque, 1 transparent, 2 reflective; the region is what is not 0 |
| `instances.png` | 0 table, walls and floor; k the k-th entry of `things` in `meta.json` |
| `loss.png` | {loss} |
| `cause.png` | {cause} |
| `ir_left.png`, `ir_right.png` | rectified infrared pair, 8 bit, 360 x 232, of some scenes only |
| `meta.json` | intrinsics of both cameras, baseline and pose (metres), seed, sensor settings, shapes, materials |

A reading is wrong when it is off by more than 10 mm and by more than 2 % of the true depth. Labels were taken from
the depths before these were rounded to millimetres. In Python: `dl.load_sample("test_00000")`, in metres.

## How they compare with a real camera

{realism}

## The splits

Each statistic is taken frame by frame; the tables of shares count pixels.

{splits}

## What the test split holds out

Training and validation scenes share shapes and materials. In the test split no transparent or reflective thing has
a shape that they have; opaque things, tables, walls, light, cameras and sensor settings are drawn alike.

{families}

| material | train and val | test |
|---|---|---|
| glass: refractive index | 1.45 to 1.56 | 1.33 to 1.42 or 1.60 to 1.75 |
| glass: loss of colour by tint | up to 25 % | up to 45 % |
| metal | silver, aluminium, chromium | copper, gold |
| brushed metal: roughness | 0.05 to 0.20 | 0.20 to 0.30 |

So the colour of a mirror alone tells the test split from training, and its thin stems and star-shaped prisms are
finer than anything there. Of the statistics above, the median of test differs most from that of training in
{difference}.

## Known limits

- The camera is ideal: no lens distortion, no rolling shutter, no motion blur, no chromatic error, no auto-exposure
  that fails; RGB and infrared are calibrated without error. Denoising leaves the pictures flatter than a real
  camera's.
- The sensor is one kind, active stereo. Time of flight and structured light fail differently. There is no temporal
  filter, no interference of a second projector, no sunlight.
- Light is traced in three colours: glass does not disperse it, and no caustic is sharp at this number of paths. In
  infrared each wall of glass passes a share that is drawn, not derived from the material.
- Vessels are empty: no liquid, no labels, no scratches, no dust, no fingerprints. Shapes are bodies of revolution,
  prisms, boxes and plates; no handles, no cloth, no people, no clutter beyond a dozen things on a table.
- Opaque surfaces carry procedural textures in colours more vivid than most rooms have.
- Things stand, lie or lean as they were put, without physics. Some things that lie rest on their bounding box:
  lying hexagons, stars, vases and wine glasses hover by up to 11 mm, most by 1 to 3.
- At 256 x 192 a stem is two pixels wide, and so is the parallax shadow of a thing a few centimetres high.
  `PARALLAX` and `STEREO_OCCLUSION` forgive a pixel at either side and yield to `DROPOUT`, so they cover few pixels:
  geometric loss here is mostly dropouts and surfaces without a match. Real frames of 1280 x 720 show wider shadows.
- Thin glass is one sheet without a thickness; truth is its outer surface, and the inside of a bowl is not labelled
  apart.
"""


if __name__ == "__main__":
    sys.exit(main())
