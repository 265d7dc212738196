"""Sequences in, runs out: one loader per layout, manifests and downloads, run folders, export and import.

Look first at :mod:`p2p_lib.datasets.sequence` and :mod:`p2p_lib.datasets.runs`.
"""
