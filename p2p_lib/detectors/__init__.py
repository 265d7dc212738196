"""Detectors of candidate points inside a mask: corners and other classical ones, and an adapter of SuperPoint.

What a detector promises is :class:`p2p_lib.core.interfaces.Detector`; names are listed in
:mod:`p2p_lib.core.backends`. Look first at :mod:`p2p_lib.detectors.classical`.
"""
