"""Drawing that more than one study or command uses: style, overlays, scenes, films, viewers, provenance.

Look first at :mod:`p2p_lib.figures.style` (colours and type) and :mod:`p2p_lib.figures.provenance` (the only place that
writes figures, with a note of what they were made from). ``pipeline_diagram`` draws the method's stages, ``overlay``
and ``scenes`` draw on images, ``film`` makes films of them, ``plots`` draws over time, ``viewer`` and ``rerun_file`` in
3D. What one notebook alone draws is in :mod:`p2p_lib.studies`.
"""
