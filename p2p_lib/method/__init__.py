"""The paper's method, and nothing else: one file per box of its overview figure.

Look first at :mod:`p2p_lib.method.pipeline` (all objects, one frame) and :mod:`p2p_lib.method.object_tracker` (one
object's step). The 2D tracker, the detector of candidates and the segmenter are parts that it is given.
"""
