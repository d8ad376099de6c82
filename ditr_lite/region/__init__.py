"""Stage one: the network that finds glass and metal, the refinement of its mask; its pretrained encoder."""

from .encoder import ColourEncoder
from .network import (
    COLOUR_ENCODERS,
    IGNORE,
    BoundaryRefinement,
    CrossModalFusion,
    Encoder,
    PretrainedPyramid,
    RegionNet,
    refine_region,
    region_probability,
)

__all__ = [
    "BoundaryRefinement",
    "COLOUR_ENCODERS",
    "ColourEncoder",
    "CrossModalFusion",
    "Encoder",
    "IGNORE",
    "PretrainedPyramid",
    "RegionNet",
    "refine_region",
    "region_probability",
]
