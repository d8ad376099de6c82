"""Every picture of the repository; ``dl.viz.grid`` and its like, drawn with Matplotlib outside pyplot."""

from ..camera import unproject as point_cloud_points
from .grids import Panel, compare, contact_sheet, grid, row, save_panel
from .lines import curves, plot
from .panels import (
    GREY,
    MUTED,
    OKABE_ITO,
    Picture,
    depth,
    depth_limits,
    error,
    heat,
    labels,
    point_cloud_side,
    rgb,
    signed_error,
    spread,
)

__all__ = [
    "GREY",
    "MUTED",
    "OKABE_ITO",
    "Panel",
    "Picture",
    "compare",
    "contact_sheet",
    "curves",
    "depth",
    "depth_limits",
    "error",
    "grid",
    "heat",
    "labels",
    "plot",
    "point_cloud_points",
    "point_cloud_side",
    "rgb",
    "row",
    "save_panel",
    "signed_error",
    "spread",
]
