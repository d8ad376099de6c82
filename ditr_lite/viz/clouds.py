"""Point clouds to turn with the mouse (plotly), and the same clouds as a picture for pages that run nothing.

The interactive figure carries its points with it and loads nothing from a network. JupyterLab draws it; a page that
cannot shows the picture.
"""

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from ..camera import Camera, unproject
from .panels import FONT, Picture

if TYPE_CHECKING:
    import plotly.graph_objects as go

MIME = "application/vnd.plotly.v1+json"
BACKGROUND = "#4A4A4A"  # points of tables and walls are pale
AXES = ("x, right (m)", "z, away (m)", "y, up (m)")  # as drawn: the vertical axis last


def points_of(
    depth_m: np.ndarray, rgb: np.ndarray, camera: Camera, max_points: int = 3000
) -> tuple[np.ndarray, np.ndarray]:
    """Return points and colours of a depth map, thinned on the pixel grid, so that surfaces thin evenly.

    Args:
        depth_m: (H, W) metres, 0 = missing.
        rgb: (H, W, 3) uint8.
        camera: of the same size.
        max_points: at most so many are returned.

    Returns:
        (N, 3) float32 metres as drawn (right, away, up); (N, 3) uint8.

    Raises:
        ValueError: when sizes differ or ``max_points`` is below 1.
    """
    if rgb.shape != (*depth_m.shape, 3) or rgb.dtype != np.uint8:
        raise ValueError(f"rgb should be {(*depth_m.shape, 3)} uint8 like the depth map, got {rgb.shape} {rgb.dtype}")
    if max_points < 1:
        raise ValueError(f"max_points should be at least 1, got {max_points}")
    step = max(1, int(np.ceil(np.sqrt((depth_m > 0).sum() / max_points))))
    while True:
        grid = np.zeros(depth_m.shape, bool)
        grid[::step, ::step] = True
        thin = np.where(grid, depth_m, np.zeros_like(depth_m))
        if (thin > 0).sum() <= max_points:
            break
        step += 1
    points = unproject(thin, camera)[:, [0, 2, 1]] * [1, 1, -1]
    return points.astype(np.float32), rgb[thin > 0]


def interactive(
    maps: Mapping[str, np.ndarray], rgb: np.ndarray, camera: Camera, max_points: int = 3000, height: int = 420
) -> "go.Figure":
    """Return clouds side by side, each to be turned and zoomed with the mouse.

    Args:
        maps: title -> (H, W) metres, 0 = missing.
        rgb: (H, W, 3) uint8.
        camera: of the same size.
        max_points: of each cloud; 3000 points are about 40 KB.
        height: of the figure, in pixels.

    Raises:
        ImportError: without plotly.
    """
    try:
        import plotly.graph_objects as go  # only here: `pip install .` without extras has no plotly
    except ImportError:
        raise ImportError("turning clouds with the mouse needs plotly: pip install -e '.[notebooks]'") from None
    figure = go.Figure()
    clouds = {title: points_of(depth, rgb, camera, max_points) for title, depth in maps.items()}
    low, high = _limits([points for points, _ in clouds.values()])
    axes = [
        {"range": [float(a), float(b)], "title": {"text": name}} for a, b, name in zip(low, high, AXES, strict=True)
    ]
    for k, (title, (points, colours)) in enumerate(clouds.items()):
        scene = f"scene{k + 1 if k else ''}"
        x, y, z = np.round(points, 3).T
        index, scale = _palette(colours)
        marker = {"size": 2.5, "color": index, "colorscale": scale, "cmin": 0, "cmax": len(scale) - 1}
        figure.add_trace(go.Scatter3d(x=x, y=y, z=z, mode="markers", marker=marker, name=title, scene=scene))
        width = 1 / len(clouds)
        placed = {"x": [k * width, (k + 1) * width], "y": [0, 1]}
        eye = {"x": 1.35, "y": -2.1, "z": 1.05}  # from the camera's side, a little above and to the right
        figure.update_layout(
            {
                scene: {
                    "domain": placed,
                    "aspectmode": "data",
                    "bgcolor": BACKGROUND,
                    "camera": {"eye": eye},
                    **{f"{n}axis": axis for n, axis in zip("xyz", axes, strict=True)},
                }
            }
        )
        figure.add_annotation(text=title, x=(k + 0.5) * width, y=1, xref="paper", yref="paper", showarrow=False)
    figure.update_layout(height=height, margin={"l": 0, "r": 0, "t": 28, "b": 0}, showlegend=False, template="none")
    figure.update_layout(paper_bgcolor=BACKGROUND, font={"color": "white", "size": 13})
    return figure


def _palette(colours: np.ndarray) -> tuple[np.ndarray, list[list[float | str]]]:
    """Return (N,) uint8 indices into a few typical colours, and these as a plotly scale: a tenth of a list of names."""
    if not len(colours):
        return np.zeros(0, np.uint8), [[0.0, "rgb(0,0,0)"], [1.0, "rgb(0,0,0)"]]
    image = Image.fromarray(colours[None]).quantize(48, kmeans=1, dither=Image.Dither.NONE)
    index = np.asarray(image)[0]
    table = np.array(image.getpalette(), np.uint8).reshape(-1, 3)[: int(index.max()) + 1]
    table = table if len(table) > 1 else np.repeat(table, 2, axis=0)  # a scale has two ends
    return index, [[k / (len(table) - 1), f"rgb({r},{g},{b})"] for k, (r, g, b) in enumerate(table.tolist())]


class Interactive:
    """What a notebook shows of an interactive figure: the figure itself, and words where it cannot be drawn.

    plotly's own display would put its whole library of 4 MB, or a link to one, into the notebook.
    """

    def __init__(self, figure: "go.Figure"):
        self.figure = figure

    def _repr_mimebundle_(self, include=None, exclude=None) -> dict[str, object]:
        titles = ", ".join(trace.name for trace in self.figure.data)
        words = f"<interactive point clouds: {titles}; the picture below shows the same from one side>"
        return {MIME: json.loads(self.figure.to_json()), "text/plain": words}


def static(maps: Mapping[str, np.ndarray], rgb: np.ndarray, camera: Camera, max_points: int = 8000) -> Picture:
    """Return the same clouds as a picture, seen from the right of the camera and a little above it."""
    figure = Picture(3.4 * len(maps), 3.0)
    clouds = [points_of(depth, rgb, camera, max_points) for depth in maps.values()]
    low, high = _limits([points for points, _ in clouds])
    for k, (title, (points, colours)) in enumerate(zip(maps, clouds, strict=True)):
        ax = figure.add_subplot(1, len(maps), k + 1, projection="3d", computed_zorder=False)
        size = float(np.clip(12_000 / max(len(points), 1), 1.5, 8.0))  # thinned clouds get larger points
        ax.scatter(*points.T, s=size, c=colours / 255.0, linewidths=0, depthshade=False)
        ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
        ax.set_box_aspect(np.maximum(high - low, 1e-3), zoom=1.35)
        ax.view_init(elev=20, azim=-35)
        ax.set_title(title, fontsize=FONT)
        ax.set_axis_off()
    return figure


def _limits(clouds: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the 1st and 99th percentile over all clouds, so that one flying point does not shrink the rest."""
    together = np.concatenate([c for c in clouds if len(c)] or [np.zeros((1, 3))])
    low, high = np.percentile(together, [1, 99], axis=0)
    return low, np.maximum(high, low + 1e-3)
