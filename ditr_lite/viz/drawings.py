"""Drawings of the system and of its networks: parts, shapes, and which notebook builds what.

Every shape is computed from a configuration, so a drawing cannot drift from the code. Letters are at least 12 pixels
high in JupyterLab and in the book's column, so that they can be read from the last row of a room.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from matplotlib.axes import Axes
from matplotlib.patches import FancyBboxPatch

from ..conditioning import CHANNELS as CONDITIONS
from ..config import AutoencoderConfig, Config, RegionConfig, UNetConfig, preset
from ..region import level_widths
from .panels import DPI, GREY, OKABE_ITO, Picture

__all__ = ["NOTEBOOKS", "autoencoder", "stage_one", "system", "unet"]

WIDTH = 800  # pixels of a drawing
LETTER = 13.1 * 72 / DPI  # points: 13 pixels, and 12 in the book, whose column is 736 pixels wide
DATA, WORK, LIT = "#FFFFFF", "#DCEBF5", "#FBD98C"  # data, what computes, highlighted
INK, LINE = "#000000", "#4D4D4D"
BLUE, ORANGE = OKABE_ITO[4], OKABE_ITO[5]


@dataclass(frozen=True)
class Box:
    """A box of a drawing: its middle, its size (pixels, y down), and what is written in it."""

    x: float
    y: float
    width: float
    height: float
    text: str

    @property
    def left(self) -> tuple[float, float]:
        """The middle of the left side."""
        return self.x - self.width / 2, self.y

    @property
    def right(self) -> tuple[float, float]:
        """The middle of the right side."""
        return self.x + self.width / 2, self.y

    @property
    def top(self) -> tuple[float, float]:
        """The middle of the upper side."""
        return self.x, self.y - self.height / 2

    @property
    def bottom(self) -> tuple[float, float]:
        """The middle of the lower side."""
        return self.x, self.y + self.height / 2


def _sheet(height: int) -> tuple[Picture, Axes]:
    """Return an empty drawing, its axes measured in pixels from the upper left corner."""
    figure = Picture(WIDTH / DPI, height / DPI)
    figure.set_layout_engine("none")  # one axes, as large as the sheet
    ax = figure.add_axes((0, 0, 1, 1))
    ax.set(xlim=(0, WIDTH), ylim=(height, 0))
    ax.axis("off")
    return figure, ax


def _draw(ax: Axes, box: Box, fill: str = WORK, edge: str = LINE, ink: str = INK, thick: float = 1.2) -> None:
    """Draw a box; the first line of its text is bold."""
    x, y = box.x - box.width / 2, box.y - box.height / 2
    style = "round,pad=0,rounding_size=5"
    ax.add_patch(FancyBboxPatch((x, y), box.width, box.height, style, facecolor=fill, edgecolor=edge, linewidth=thick))
    lines = box.text.split("\n")
    for k, line in enumerate(lines):
        middle = box.y + 17 * (k - (len(lines) - 1) / 2)
        _write(ax, box.x, middle, line, weight="bold" if k == 0 else "normal", color=ink)


def _write(ax: Axes, x: float, y: float, text: str, **style) -> None:
    """Write one line or several, centred on a place."""
    style = {"ha": "center", "va": "center_baseline", "fontsize": LETTER, "linespacing": 1.1} | style
    ax.text(x, y, text, **style)


def _arrow(ax: Axes, *places: tuple[float, float], colour: str = LINE, style: str = "-", head: bool = True) -> None:
    """Draw a line through places, with an arrow head at the last one."""
    for a, b in zip(places[:-2], places[1:-1], strict=True):
        ax.plot((a[0], b[0]), (a[1], b[1]), color=colour, linewidth=1.5, linestyle=style, solid_capstyle="round")
    (x0, y0), (x1, y1) = places[-2:]
    kind = {"arrowstyle": "-|>" if head else "-", "color": colour, "linewidth": 1.5, "linestyle": style}
    ax.annotate("", (x1, y1), (x0, y0), arrowprops=kind | {"shrinkA": 0, "shrinkB": 0, "mutation_scale": 12})


# --- the whole system -------------------------------------------------------------------------------------------------

# notebook -> the boxes that it builds or is about
NOTEBOOKS: Mapping[str, Sequence[str]] = {
    "00": (),
    "01": ("camera", "depth"),
    "02": ("region",),
    "03": ("encode", "decode"),
    "04": ("optical", "geometric"),
    "05": ("boundary",),
    "06": ("boundary", "region", "encode", "optical", "geometric", "decode", "compose", "out"),
    "07": ("score",),
    "08": ("study",),
    "09": ("camera", "colour", "depth", "out"),
}
# name -> column, row, text, notebook that builds it
PARTS = {
    "colour": (0, 0, "colour X\nH × W × 3", ""),
    "camera": (0, 1, "depth camera\nlooks at a scene", "01, 09"),
    "depth": (0, 2, "raw depth D_in\nH × W, metres\n0 = missing", ""),
    "boundary": (1, 0, "boundary maps\nM_RGB, M_D, M_DA\nH × W, yes or no", "05"),
    "region": (1, 1, "stage one\nregion: glass, metal\nH × W, yes or no", "02"),
    "encode": (1, 2, "Enc\nknown depth to\nlatents {latent}", "03"),
    "optical": (2, 0, "optical branch\nU-Net paints latents\nof the region", "04"),
    "geometric": (2, 1, "geometric branch\nU-Net paints latents\nof other holes", "04"),
    "decode": (2, 2, "Dec\nlatents to depth\nH × W", "03"),
    "out": (3, 0, "repaired D_out\nH × W, no holes", ""),
    "compose": (3, 2, "compose\nbranches and\nkept readings", "06"),
    "score": (4, 0, "scores\nagainst the truth", "07"),
    "study": (4, 2, "studies\nleave parts out,\nexchange them", "08"),
}


def system(part: str = "00") -> Picture:
    """Draw the whole system: data, shapes, and which notebook builds what.

    Args:
        part: the notebook whose part is highlighted, by its two digits, or by its name: "02", "02_region_refinement".
            "00" highlights nothing.

    Raises:
        ValueError: for a notebook that does not exist.
    """
    number = str(part)[:2]
    if number not in NOTEBOOKS:
        raise ValueError(f"part: expected a notebook, {', '.join(NOTEBOOKS)}, got {part!r}")
    config = preset("lite")
    latent = f"{config.autoencoder.latent_channels} × H/4 × W/4"
    figure, ax = _sheet(400)
    columns, rows, widths = (70, 238, 424, 587, 732), (78, 206, 334), (128, 152, 148, 130, 124)
    boxes = {
        name: Box(columns[c], rows[r], widths[c], 74, text.format(latent=latent))
        for name, (c, r, text, _) in PARTS.items()
    }
    _connect_system(ax, boxes)
    for name, box in boxes.items():
        lit = name in NOTEBOOKS[number]
        data = name in ("colour", "depth", "out")
        fill = LIT if lit else DATA if data else WORK
        _draw(ax, box, fill, ORANGE if lit else LINE, thick=3 if lit else 1.2)
        _tag(ax, box, PARTS[name][3])
    return figure


def _tag(ax: Axes, box: Box, number: str) -> None:
    """Write the number of a notebook on the upper edge of a box."""
    if number:
        left, top = box.left[0], box.top[1]
        style = {"boxstyle": "round,pad=0.15", "facecolor": BLUE, "edgecolor": "white", "linewidth": 1}
        _write(ax, left + 8, top - 1, number, ha="left", color="white", weight="bold", bbox=style, zorder=5)


def _connect_system(ax: Axes, boxes: Mapping[str, Box]) -> None:
    """Draw who gives what to whom."""
    b = boxes
    _arrow(ax, b["camera"].top, b["colour"].bottom)
    _arrow(ax, b["camera"].bottom, b["depth"].top)
    # colour and depth go into all three boxes of the second column
    bus = (b["colour"].right[0] + b["region"].left[0]) / 2
    _bus(ax, bus, [b["colour"].right, b["depth"].right], [b["boundary"].left, b["region"].left, b["encode"].left])
    _arrow(ax, b["region"].bottom, b["encode"].top)
    # what the branches are shown: boundaries, region, encoded depth, and the colour itself, over the top
    gather = (b["region"].right[0] + b["optical"].left[0]) / 2
    given = [b["boundary"].right, b["region"].right, b["encode"].right]
    _bus(ax, gather, given, [b["optical"].left, b["geometric"].left])
    above = 20
    _arrow(ax, b["colour"].top, (b["colour"].x, above), (gather, above), (gather, b["optical"].y), head=False)
    _write(ax, b["boundary"].x, above - 9, "colour", style="italic")
    # both branches are decoded
    side = b["optical"].right[0] + 9
    high, low = b["decode"].y - 12, b["decode"].y + 12
    _arrow(ax, b["optical"].right, (side, b["optical"].y), (side, high), (b["decode"].right[0], high))
    _arrow(ax, b["geometric"].bottom, b["decode"].top)
    _arrow(ax, (b["decode"].right[0], low), (b["compose"].left[0], low))
    # readings that are kept go round below
    below = 387
    _arrow(ax, b["depth"].bottom, (b["depth"].x, below), (b["compose"].x, below), b["compose"].bottom)
    _write(ax, 322, below - 1, "readings outside the region are kept", style="italic", backgroundcolor="white")
    _arrow(ax, b["compose"].top, b["out"].bottom)
    _arrow(ax, b["out"].right, b["score"].left)
    _arrow(ax, b["study"].top, b["score"].bottom)


def _bus(ax: Axes, x: float, sources: Sequence[tuple], targets: Sequence[tuple]) -> None:
    """Join lines from ``sources`` in a vertical line at ``x`` and send an arrow to each of ``targets``."""
    heights = [y for _, y in (*sources, *targets)]
    # dots and a thick line: a source that stands opposite a target gives to all of them
    ax.plot((x, x), (min(heights), max(heights)), color=LINE, linewidth=3)
    ax.plot([x] * len(heights), heights, "o", color=LINE, markersize=6)
    for place, y in sources:
        ax.plot((place, x), (y, y), color=LINE, linewidth=1.5)
    for place, y in targets:
        _arrow(ax, (x, y), (place, y))


# --- stage one --------------------------------------------------------------------------------------------------------


def stage_one(config: RegionConfig | None = None, size: tuple[int, int] | None = None) -> Picture:
    """Draw stage one: two encoders, fusion at every level, the decoder with its side outputs, boundary refinement.

    Args:
        config: of stage one, 2 to 5 levels; the shipped one by default.
        size: (height, width) of the picture, pixels; the shipped working size by default.

    Raises:
        ValueError: for more levels than the sheet has room for.
    """
    config, (height, width) = config or preset("lite").region, size or preset("lite").size
    levels = config.levels
    if not 2 <= levels <= 5:
        raise ValueError(f"expected 2 to 5 levels, got {levels}: the sheet has no room for others")
    figure, ax = _sheet(456)
    rows = {"colour": 84, "fusion": 162, "depth": 240, "decoder": 344}
    step = min(164, 656 // levels)
    columns = [204 + step * k for k in range(levels)]
    widths = level_widths(config.width, levels)
    shapes = [_shape(channels, height, width, 2 ** (k + 1)) for k, channels in enumerate(widths)]
    names = {"colour": "encoder", "fusion": "fusion", "depth": "encoder", "decoder": "decoder"}
    grid = {}
    for row, y in rows.items():
        for k, (x, shape) in enumerate(zip(columns, shapes, strict=True)):
            name = "context" if row == "decoder" and k == levels - 1 else names[row]
            lines = [name, shape]
            if row == "decoder" and k >= levels - 2 and config.attention:
                lines.insert(1, "and attention")
            grid[row, k] = Box(x, y, step - 26, 16 + 17 * len(lines), "\n".join(lines))
    inputs = {
        "colour": Box(70, rows["colour"], 110, 50, f"colour\n3 × {height} × {width}"),
        "depth": Box(70, rows["depth"], 110, 50, f"depth, valid\n2 × {height} × {width}"),
    }
    for k, x in enumerate(columns):
        _write(ax, x, 38, f"stride {2 ** (k + 1)}", style="italic")
    _write(ax, WIDTH / 2, 14, "coarser, wider: what it is  →", style="italic", color=LINE)
    _connect_stage_one(ax, grid, inputs, levels)
    for (row, _), box in grid.items():
        _draw(ax, box, LIT if row == "fusion" else WORK)
    for box in inputs.values():
        _draw(ax, box, DATA)
    _heads_of_stage_one(ax, grid, config, levels)
    return figure


def _connect_stage_one(ax: Axes, grid: Mapping[tuple, Box], inputs: Mapping[str, Box], levels: int) -> None:
    """Draw the arrows between the boxes of stage one."""
    for row, box in inputs.items():
        _arrow(ax, box.right, grid[row, 0].left)
    for k in range(levels):
        _arrow(ax, grid["colour", k].bottom, grid["fusion", k].top)
        _arrow(ax, grid["depth", k].top, grid["fusion", k].bottom)
        side = grid["fusion", k].right[0] + 8  # past the depth encoder, down to the decoder
        low = grid["decoder", k].top[1] - 14
        start = grid["fusion", k].right
        _arrow(
            ax, start, (side, start[1]), (side, low), (grid["decoder", k].x, low), grid["decoder", k].top, colour=BLUE
        )
        if k + 1 < levels:
            for row in ("colour", "depth"):
                _arrow(ax, grid[row, k].right, grid[row, k + 1].left)
            _arrow(ax, grid["decoder", k + 1].left, grid["decoder", k].right, colour=BLUE)


def _heads_of_stage_one(ax: Axes, grid: Mapping[tuple, Box], config: RegionConfig, levels: int) -> None:
    """Draw what comes out: side outputs below, boundary refinement and classes at the left."""
    for k in range(1, levels):
        box = grid["decoder", k]
        place = (box.x, box.bottom[1] + 28)
        _arrow(ax, box.bottom, place, colour=ORANGE)
        _write(ax, box.x, place[1] + 10, f"side, {config.classes} classes")
    sharpen = Box(70, grid["decoder", 0].y, 110, 67, f"boundary\nrefinement,\n{config.classes} classes")
    _arrow(ax, grid["decoder", 0].left, sharpen.right, colour=BLUE)
    _draw(ax, sharpen, WORK)
    merged = Box(70, 434, 110, 33, "P(region)")
    _arrow(ax, sharpen.bottom, merged.top, colour=BLUE)
    _draw(ax, merged, DATA)
    _write(ax, merged.right[0] + 6, merged.y, "= P(transparent) + P(reflective), at every pixel", ha="left")


def _shape(channels: int, height: int, width: int, stride: int) -> str:
    return f"{channels} × {height // stride} × {width // stride}"


# --- the autoencoder --------------------------------------------------------------------------------------------------


def autoencoder(config: AutoencoderConfig | None = None, size: tuple[int, int] | None = None) -> Picture:
    """Draw the autoencoder: the encoder above, latents at the right, quantiser and decoder below, no skip connection.

    Args:
        config: of the autoencoder, one to three levels; the shipped one by default.
        size: (height, width) of the depth map, pixels; the shipped working size by default.

    Raises:
        ValueError: for more levels than the sheet has room for.
    """
    config, (height, width) = config or preset("lite").autoencoder, size or preset("lite").size
    levels = len(config.multipliers)
    if levels > 3:
        raise ValueError(f"expected at most 3 levels, got {levels}: the sheet has no room for more")
    figure, ax = _sheet(310)
    step = 790 / (levels + 2)
    columns = [8 + step * (k + 0.5) for k in range(levels + 2)]
    wide = min(step - 26, 176)
    widths = [config.width * m for m in config.multipliers]
    shapes = [_shape(c, height, width, 2 ** (k + 1)) for k, c in enumerate(widths)]
    latent = _shape(config.latent_channels, height, width, 2**levels)
    up, down = 82, 226
    encoder = [Box(columns[0], up, wide, 58, f"depth D\n1 × {height} × {width}")]
    decoder = [Box(columns[0], down, wide, 58, f"depth again\n1 × {height} × {width}")]
    for k, shape in enumerate(shapes):
        encoder.append(Box(columns[k + 1], up, wide, 58, f"{'conv, stride 2' if k else 'fold 2 × 2, conv'}\n{shape}"))
        decoder.append(Box(columns[k + 1], down, wide, 58, f"{'conv, enlarge' if k else 'conv, unfold'}\n{shape}"))
    code = Box(columns[-1], up, wide, 58, f"latents L\n{latent}")
    quantiser = Box(columns[-1], down, wide, 75, f"quantiser\n{config.codes} codes\n{latent}")
    _connect_autoencoder(ax, [*encoder, code], [quantiser, *reversed(decoder)])
    for box in (*encoder[1:], *decoder[1:]):
        _draw(ax, box, WORK)
    for box in (encoder[0], decoder[0], code):
        _draw(ax, box, DATA)
    _draw(ax, quantiser, LIT)
    _brackets(ax, columns, wide)
    return figure


def _connect_autoencoder(ax: Axes, forth: Sequence[Box], back: Sequence[Box]) -> None:
    """Draw the way down to the latents and the way back."""
    for a, b in zip(forth[:-1], forth[1:], strict=True):
        _arrow(ax, a.right, b.left)
    for a, b in zip(back[:-1], back[1:], strict=True):
        _arrow(ax, a.left, b.right, colour=BLUE)
    _arrow(ax, forth[-1].bottom, back[0].top, colour=ORANGE)
    middle = (forth[-1].bottom[1] + back[0].top[1]) / 2
    _write(ax, forth[-1].left[0] - 6, middle, "diffusion works here (04)  →", ha="right", color=ORANGE, weight="bold")


def _brackets(ax: Axes, columns: Sequence[float], wide: float) -> None:
    """Name the two halves above and below their boxes."""
    left, right = columns[1] - wide / 2, columns[-2] + wide / 2
    for y, out, text in (
        (40, -1, "encoder: L = Enc(D)"),
        (272, 1, "decoder: D = Dec(L), the quantiser is its first layer"),
    ):
        end = right if out < 0 else columns[-1] + wide / 2
        ax.plot((left, left, end, end), (y, y + 8 * out, y + 8 * out, y), color=GREY, linewidth=1.5)
        _write(ax, (left + end) / 2, y + 20 * out, text, style="italic")
    _write(ax, columns[0], 154, "no skip\nconnections", style="italic")


# --- the denoiser -----------------------------------------------------------------------------------------------------


def unet(config: UNetConfig | None = None, latent_channels: int | None = None, size: tuple | None = None) -> Picture:
    """Draw the denoising U-Net and where its conditions enter: time, known depth, F(x).

    Args:
        config: of the U-Net, four levels; the shipped one by default.
        latent_channels: channels of the latents; the shipped number by default.
        size: (height, width) of the picture, pixels; the shipped working size by default.

    Raises:
        ValueError: for another number of levels than the sheet has room for.
    """
    lite: Config = preset("lite")
    config, (height, width) = config or lite.unet, size or lite.size
    latent = latent_channels or lite.autoencoder.latent_channels
    levels = len(config.multipliers)
    if levels != 4:
        raise ValueError(f"expected 4 levels, got {levels}: the sheet has room for four")
    figure, ax = _sheet(470)
    columns = [230 + 162 * k for k in range(levels)]
    rows = {"feature": 80, "down": 210, "up": 334}
    shapes = [_shape(config.width * m, height, width, 4 * 2**k) for k, m in enumerate(config.multipliers)]
    looks = [0, *config.attention_levels]  # where F(x) is used
    grid = {}
    for k, x in enumerate(columns):
        _write(ax, x, 22, f"stride {4 * 2**k}", style="italic")
        heed = "\nattention" if k in config.attention_levels else ""
        grid["down", k] = Box(
            x, rows["down"], 144, 67, f"{'2 × conv' if not k else 'pool, 2 × conv'}\n{shapes[k]}{heed}"
        )
        if k + 1 < levels:
            grid["up", k] = Box(x, rows["up"], 144, 67, f"enlarge, 2 × conv\n{shapes[k]}{heed}")
        if k in looks:
            feature = _shape(config.cond_channels * config.multipliers[k], height, width, 4 * 2**k)
            grid["feature", k] = Box(x, rows["feature"], 144, 50, f"F(x)\n{feature}")
    _inputs_of_unet(ax, grid, config, latent, (height, width))
    _connect_unet(ax, grid, levels, config)
    for (row, _), box in grid.items():
        _draw(ax, box, LIT if row == "feature" else WORK)
    return figure


def _inputs_of_unet(
    ax: Axes, grid: Mapping[tuple, Box], config: UNetConfig, latent: int, size: tuple[int, int]
) -> None:
    """Draw at the left what goes in and comes out, and below it the time."""
    height, width = size
    grid_size = f"{height // 4} × {width // 4}"
    colour = "\n+ pretrained colour" if config.colour_channels else ""
    picture = Box(
        76, 80, 142, 84, f"conditions x\n{len(CONDITIONS)} × {height} × {width}\ncolour, guide, depth{colour}"
    )
    noisy = Box(76, 210, 142, 84, f"noisy latents L_t\n{latent} × {grid_size}\nknown latents {latent}\nis it known? 1")
    out = Box(
        76, 334, 142, 67, f"clean latents x_θ\n{latent} × {grid_size}\n" + ("known + change" if config.anchor else "")
    )
    for box in (picture, noisy, out):
        _draw(ax, box, DATA)
    _arrow(ax, picture.right, grid["feature", 0].left, colour=ORANGE)
    _arrow(ax, noisy.right, grid["down", 0].left)
    _arrow(ax, grid["up", 0].left, out.right)
    time = Box(76, 432, 142, 50, "step t\nas sines, MLP")
    _draw(ax, time, DATA)
    y = time.y
    last = max(k for row, k in grid if row == "down")
    side = grid["down", last].right[0] + 8
    _arrow(ax, time.right, (side, y), (side, grid["down", last].y), grid["down", last].right, colour=GREY)
    _write(ax, 430, y - 1, "t is added inside every block", style="italic", backgroundcolor="white")


def _connect_unet(ax: Axes, grid: Mapping[tuple, Box], levels: int, config: UNetConfig) -> None:
    """Draw the way down, the way up, the skip connections, and F(x) where it enters."""
    for k in range(levels - 1):
        _arrow(ax, grid["down", k].right, grid["down", k + 1].left)
        _arrow(ax, grid["down", k].bottom, grid["up", k].top, colour=BLUE, style=":")
        if k:
            _arrow(ax, grid["up", k].left, grid["up", k - 1].right)
    bottom, last = grid["down", levels - 1], grid["up", levels - 2]
    _arrow(ax, bottom.bottom, (bottom.x, last.y), last.right)
    _write(ax, (grid["down", 0].x + grid["down", 1].x) / 2, 272, "skip connections", color=BLUE)
    previous = grid["feature", 0]
    for k in config.attention_levels:
        _arrow(ax, previous.right, grid["feature", k].left, colour=ORANGE)
        previous = grid["feature", k]
    for (row, k), box in list(grid.items()):
        if row == "feature":
            _arrow(ax, box.bottom, grid["down", k].top, colour=ORANGE)
            how = "joined\nto L_t" if k == 0 else "cross-\nattention"
            _write(ax, box.x + 8, (box.bottom[1] + grid["down", k].top[1]) / 2, how, ha="left", color=ORANGE)
