"""Ways from view to view, and the slide they stand for."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from p2p_lib.core import se3
from p2p_lib.extended.views import AccumulatedViews

AXIS = np.array([0.36, 0.48, 0.8])


def turned(deg: float) -> np.ndarray:
    return se3.from_rt(Rotation.from_rotvec(np.radians(deg) * AXIS).as_matrix(), np.array([0.1, -0.2, 0.7]))


def test_the_way_goes_by_the_views_and_back_again():
    views = AccumulatedViews()
    assert views.accumulated_rad(turned(20)) == 0 and views.turned_rad(turned(20)) == np.inf
    for deg in (0, 60, 120, 180, 240):
        views.add(turned(deg))
    # 240 degrees are 120 the short way, where nobody has looked along.
    assert np.degrees(views.accumulated_rad(turned(240))) == pytest.approx(240)
    assert np.degrees(views.accumulated_rad(turned(130))) == pytest.approx(130)
    views.add(turned(50))  # nearest is 60, from where it is 10 more
    assert np.degrees(views.accumulated_rad(turned(49))) == pytest.approx(71)
    assert np.degrees(views.accumulated_rad(turned(0))) == pytest.approx(0, abs=1e-4)
    assert np.degrees(views.turned_rad(turned(-30))) == pytest.approx(30)


def test_the_cap_holds_and_takes_what_is_most_alike():
    views = AccumulatedViews(3)
    for deg in (0, 90, 180, 100):
        views.add(turned(deg))
    assert len(views) == 3
    kept = np.degrees(se3.angle_rad(se3.inverse(views.T_cam_obj) @ turned(0)))
    np.testing.assert_allclose(np.sort(kept), [0, 100, 180], atol=1e-4)
    assert np.degrees(views.accumulated_rad(turned(100))) == pytest.approx(100)
