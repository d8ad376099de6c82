"""Pictures with knobs: a row of pictures at chosen settings, below sliders where the front end can show them.

A kernel is not told which program reads its outputs. Programs that can show widgets leave a trace in its environment
when they start it; those that only execute a notebook (nbconvert, nbval, nbclient) do not.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from .panels import WIDTH_IN, Picture

# Set for the kernels of JupyterLab and Notebook, of VS Code, and of Colab.
FRONT_ENDS = ("JPY_SESSION_NAME", "VSCODE_PID", "COLAB_RELEASE_TAG")

LIVE_SCALE = 1.6  # one setting has the room of several


def front_end() -> bool:
    """Say whether this kernel was started by a program that shows widgets."""
    return any(os.environ.get(name) for name in FRONT_ENDS)


def knobs(
    draw: Callable[..., None],
    values: Mapping[str, Sequence],
    row: Sequence[Mapping[str, Any]],
    panels: int = 1,
    size: tuple[float, float] = (3.0, 2.6),
    live: bool | None = None,
) -> Any:
    """Return a picture that can be turned by hand, or the same picture at several settings; a cell's last expression.

    Args:
        draw: called as ``draw(ax, **setting)``, or ``draw(axes, **setting)`` with ``panels`` axes when there are
            several; it draws and sets the titles, which should name the setting.
        values: knob -> the values that it can take, in order.
        row: settings, each with one value for every knob: what the static row shows; sliders start at the first.
        panels: axes that one setting needs; beside each other with sliders, beneath each other in the row.
        size: width and height of one axes, inches; the row is at most as wide as a notebook.
        live: sliders and the row (True) or the row alone (False); None asks :func:`front_end`.

    Returns:
        An ``ipywidgets.VBox`` of sliders, the picture that they move and the row, or the row alone, a
        :class:`~ditr_lite.viz.panels.Picture`.

    Raises:
        ValueError: when a setting lacks a knob, has one too many, or a value that the knob cannot take.
    """
    if not row or not values or panels < 1:
        raise ValueError(f"expected at least one setting, knob and panel, got {len(row)}, {len(values)}, {panels}")
    for setting in row:
        if set(setting) != set(values):
            raise ValueError(f"each setting should name the knobs {sorted(values)}, got {sorted(setting)}")
        for name, value in setting.items():
            if value not in values[name]:
                raise ValueError(f"{name} = {value!r} is not among its values; add it to values[{name!r}]")
    live = front_end() if live is None else live
    return _sliders(draw, values, row, panels, size) if live else _draw(draw, row, panels, size, across=False)


def _draw(draw, settings, panels, size, across) -> Picture:
    """Draw one column of panels per setting; ``across`` lays the panels of a single setting in a row."""
    rows, columns = (1, panels) if across else (panels, len(settings))
    width = min(WIDTH_IN, size[0] * columns)
    figure = Picture(width, size[1] * rows)
    axes = figure.subplots(rows, columns, squeeze=False)
    for k, setting in enumerate(settings):
        own = axes[0] if across else axes[:, k]
        draw(own[0] if panels == 1 else own, **setting)
    return figure


def _sliders(draw, values, row, panels, size):
    """Return sliders above an image that is drawn again whenever one of them comes to rest, and the row below it."""
    import ipywidgets  # not before it is needed: without a front end nothing should be sent to one

    sliders = {
        name: ipywidgets.SelectionSlider(
            options=[(f"{v:g}" if isinstance(v, float) else str(v), v) for v in options],
            value=row[0][name],
            description=name.replace("_", " "),
            tooltip=f"{name.replace('_', ' ')}: move to draw again",  # without, the page shows "null" at the label
            continuous_update=False,
            style={"description_width": "initial"},
        )
        for name, options in values.items()
    }
    # as large as it is drawn: a box would stretch it to its own width
    layout = {"align_self": "flex-start", "max_width": "100%"}
    picture = ipywidgets.Image(format="png", layout=layout)
    still = ipywidgets.Image(format="png", layout=layout, value=_draw(draw, row, panels, size, across=False).png())
    size = tuple(LIVE_SCALE * inches for inches in size)

    def redraw(_=None) -> None:
        setting = {name: slider.value for name, slider in sliders.items()}
        picture.value = _draw(draw, [setting], panels, size, across=True).png()

    for slider in sliders.values():
        slider.observe(redraw, "value")
    redraw()
    return ipywidgets.VBox([*sliders.values(), picture, still])
