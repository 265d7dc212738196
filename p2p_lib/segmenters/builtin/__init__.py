"""The built-in segmenter: colour, depth, motion and the reconstructed surface, cut by a random walker.

Look first at :mod:`p2p_lib.segmenters.builtin.segmenter`, which runs the stages: ``prompted`` (start, correct), with
``start_evidence`` and ``start_doubts``, ``following`` (from the frame before) and ``finding`` (after an absence, not on
what ``bystanders`` were seen beside it). They share ``target`` (what is remembered of an object), ``view`` (the frame),
``cut`` (evidence), ``motion`` (parts, what came since), ``patch`` (the small grid), ``colours`` and ``random_walk``.
"""
