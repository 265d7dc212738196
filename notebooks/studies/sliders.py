"""A picture that follows sliders: drawn for every position beforehand, so that it moves in a saved page as well."""

from __future__ import annotations

import base64
import html
import io
import json
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image

from p2p_lib.core.errors import BadInput
from p2p_lib.figures import style
from p2p_lib.figures.provenance import Saved, save_figure

#: Pixels of a picture for one on the page.
_FINE = 1.5
#: Read by every slider of a page: the picture at the positions of all sliders of its box.
_MOVE = (
    "const b=this.closest('figure'),s=[...b.querySelectorAll('input')];"
    "s.forEach(x=>x.nextElementSibling.textContent=JSON.parse(x.dataset.values)[x.value]);"
    "b.querySelector('img').src=JSON.parse(b.dataset.pictures)[s.reduce((k,x)=>k*(+x.max+1)+(+x.value),0)]"
)


def save_sliders(
    draw: Callable[..., Any],
    name: str,
    caption: str,
    sliders: Mapping[str, Sequence[float]],
    start: Sequence[float],
    **notes: Any,
) -> Saved:
    """Show ``draw(*values)`` for the values that the sliders stand at; the picture at ``start`` is what is saved.

    draw     a Matplotlib figure or an image (H, W, 3) uint8 for one value of each slider
    sliders  label to its values, in their order
    start    one value of each: the picture that is shown first, and alone where no script runs
    notes    ``sources`` and ``parameters`` of :func:`~p2p_lib.figures.provenance.save_figure`
    """
    axes = list(sliders.values())
    for label, values, value in zip(sliders, axes, start, strict=True):
        if value not in values:
            raise BadInput(f"start of slider {label!r}", value, "one of " + ", ".join(f"{v:g}" for v in values))
    saved = save_figure(draw(*start), name, caption, **notes)
    pictures = [_embedded(draw(*values)) for values in product(*axes)]
    at = [list(values).index(value) for values, value in zip(axes, start, strict=True)]
    shown = pictures[int(np.ravel_multi_index(at, [len(values) for values in axes]))]
    rows = "".join(
        f'<label style="display:block;font-size:13px">{html.escape(label)} '
        f'<input type="range" min="0" max="{len(values) - 1}" value="{k}" oninput="{_MOVE}" '
        f"data-values='{json.dumps([f'{v:g}' for v in values])}'> <output>{values[k]:g}</output></label>"
        for (label, values), k in zip(sliders.items(), at, strict=True)
    )
    look = saved.shown[1]["image/png"]
    page = (
        f"<figure data-pictures='{json.dumps(pictures)}' style='margin:0'>{rows}"
        f'<img alt="{html.escape(look["alt"])}" src="{shown}" style="width:{look["width"]}px;max-width:100%"></figure>'
    )
    data, metadata = saved.shown
    return Saved(saved.path, ({**data, "text/html": page}, metadata), saved.caption)


def _embedded(picture: Any) -> str:
    """A drawn picture as an address that holds it."""
    if not isinstance(picture, np.ndarray):
        with style.applied():  # drawn once, where savefig draws twice and packs what is packed again below
            canvas = FigureCanvasAgg(picture)
            picture.set_dpi(_FINE * picture.dpi)
            canvas.draw()
            picture = np.asarray(canvas.buffer_rgba())[..., :3]
    with io.BytesIO() as webp:
        Image.fromarray(picture).save(webp, "WEBP", quality=70, method=4)
        return "data:image/webp;base64," + base64.b64encode(webp.getvalue()).decode()
