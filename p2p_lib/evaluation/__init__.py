"""Metrics and protocols: arrays in, numbers out.

Look first at :mod:`p2p_lib.evaluation.metrics` and :mod:`p2p_lib.evaluation.protocol`.
"""
