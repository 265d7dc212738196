"""Detectors of candidate points inside a mask, by name in :mod:`p2p_lib.core.backends`."""
