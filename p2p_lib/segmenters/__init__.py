"""Segmenters: the built-in one, which starts from clicks and needs no weights, and an adapter of SAM 2.

What a segmenter promises is :class:`p2p_lib.core.interfaces.Segmenter`; names are listed in
:mod:`p2p_lib.core.backends`. Look first at :mod:`p2p_lib.segmenters.builtin`.
"""
