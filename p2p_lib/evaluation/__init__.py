"""Metrics and protocols: arrays in, numbers or DataFrames out.

Look first at :mod:`p2p_lib.evaluation.metrics` (errors of poses), then at the protocols: ``protocol`` and ``alignment``
score a run, ``recovery`` its returns after occlusion, ``confidence`` what its confidences are worth, ``reconstruction``
its meshes, ``mask_score`` its masks. ``tracker_score`` scores a 2D tracker by
``true_tracks`` and ``point_tracks``; ``oracle`` is a tracker that knows the truth.
"""
