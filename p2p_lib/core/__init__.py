"""Values and maths that every other package uses: frames, tracks, poses, camera, SE(3), configuration, errors.

Look first at :mod:`p2p_lib.core.types` (what passes between the packages), :mod:`p2p_lib.core.interfaces` (what the
method asks of trackers, detectors and segmenters) and :mod:`p2p_lib.core.config` (every parameter). Names of trackers,
detectors and segmenters are in ``backends``, options of a run in ``options``. Measured depth is in ``depth``, pixels
and masks in ``image``, poses in ``se3``, robust fits in ``robust``, tables in ``tables``.
"""
