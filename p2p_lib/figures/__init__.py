"""Drawing that commands and notebooks use: style, overlays, scenes, films, viewers, provenance.

Look first at :mod:`p2p_lib.figures.style` (colours and type) and :mod:`p2p_lib.figures.provenance` (the only place that
writes figures, with a note of what they were made from). ``overlay`` and ``scenes`` draw on images, ``film`` makes
films of them, ``viewer`` draws in 3D. What notebooks alone draw stands beside
them, in ``notebooks/studies``.
"""
