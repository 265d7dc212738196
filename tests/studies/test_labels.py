"""Notebook 11: the picture of what labels.csv says."""

import numpy as np
from pandas import DataFrame

from studies.labels import evidence_plot


def test_images_have_whole_numbers():
    labels = DataFrame({"image": range(18), "object": "box", "visib_iou": 0.8, "depth_on_surface": 0.9})
    ticks = evidence_plot(labels).axes[1].get_xticks()
    assert len(ticks) > 3 and (ticks == np.rint(ticks)).all()
