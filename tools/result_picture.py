"""Draw the README's picture: the test scene whose optical error is the median of the split, so nobody picked it.

python tools/result_picture.py [--json ditr_lite/weights/results_test.json] [--out data_samples/result.png]
"""

import argparse
import json
from pathlib import Path

import ditr_lite as dl
from ditr_lite import baselines, viz
from ditr_lite.files import written_whole


def median_scene(rmse_m: dict[str, dict]) -> str:
    """Return the name of the frame whose optical RMSE stands in the middle of the ranking."""
    scored = {name: methods["ditr"].get("optical") for name, methods in rmse_m.items()}
    ranked = sorted((error, name) for name, error in scored.items() if error is not None)
    return ranked[len(ranked) // 2][1]


def main() -> None:
    """Draw and write the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, default=Path("ditr_lite/weights/results_test.json"))
    parser.add_argument("--out", type=Path, default=Path("data_samples/result.png"))
    args = parser.parse_args()
    name = median_scene(json.loads(args.json.read_text())["rmse_m"])
    sample = dl.load_sample(name)
    out = dl.Ditr.from_pretrained()(sample.rgb, sample.depth)
    fill = baselines.REGISTRY["keep_and_fill_debiased"](sample.rgb, sample.depth, out.region)
    fill = baselines.compose(fill, sample.depth, out.region)
    picture = viz.compare(sample, {"keep and fill, debiased": fill, "DITR": out.depth})
    with written_whole(args.out) as part:
        Path(part).write_bytes(picture.png())
    print(f"{args.out}: {name}")


if __name__ == "__main__":
    main()
