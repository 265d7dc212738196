"""Drawing that more than one study or command uses: style, overlays, scenes, films, viewers, provenance.

Look first at :mod:`p2p_lib.figures.style` and :mod:`p2p_lib.figures.provenance`.
"""
