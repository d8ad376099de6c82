"""Stage one: the network that finds glass and metal, the refinement of its mask; its pretrained encoder."""

from .encoder import ColourEncoder
from .network import (
    IGNORE,
    CrossModalFusion,
    Encoder,
    RegionNet,
    level_widths,
    refine_region,
    region_probability,
)

__all__ = [
    "ColourEncoder",
    "CrossModalFusion",
    "Encoder",
    "IGNORE",
    "RegionNet",
    "level_widths",
    "refine_region",
    "region_probability",
]
