"""SE(3): every group law x batch shapes x near-identity and near-pi, against SciPy and against long-double series."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm, polar
from scipy.spatial.transform import RigidTransform, Rotation, Slerp

from p2p_lib.core import se3
from p2p_lib.core.errors import BadInput

BATCHES = pytest.mark.parametrize("batch", [(), (1,), (7,), (2, 3), (0,)], ids=str)
#: Angles where closed forms go wrong: nothing, around the switch to the series at 1e-4, ordinary, just below pi.
ANGLES = (0.0, 1e-12, 1e-7, 9.9e-5, 1.01e-4, 3e-4, 1e-2, 0.7, 2.5, np.pi - 1e-3, np.pi - 1e-6)
AT_ANGLE = pytest.mark.parametrize("angle", ANGLES)


def tangents(batch: tuple[int, ...], angle: float | None = None, seed: int = 0) -> np.ndarray:
    """(*batch, 6) tangents; turned by ``angle`` where it is given, else by up to nearly pi."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=(*batch, 3))
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    turn = rng.uniform(0, np.pi - 1e-3, (*batch, 1)) if angle is None else angle
    return np.concatenate([axis * turn, rng.uniform(-2, 2, (*batch, 3))], -1)


def twist(xi: np.ndarray) -> np.ndarray:
    """The 4x4 generator, written out element by element."""
    wx, wy, wz, vx, vy, vz = xi
    return np.array([[0, -wz, wy, vx], [wz, 0, -wx, vy], [-wy, wx, 0, vz], [0, 0, 0, 0]], xi.dtype)


def series(xi: np.ndarray) -> np.ndarray:
    """exp by its power series in long double: exact to the last digit of a double."""
    A = twist(xi.astype(np.longdouble))
    term, total = np.eye(4, dtype=np.longdouble), np.eye(4, dtype=np.longdouble)
    for k in range(1, 60):
        term = term @ A / k
        total = total + term
    return total.astype(float)


def flat(a: np.ndarray, dims: int) -> np.ndarray:
    return a.reshape(-1, *a.shape[a.ndim - dims :])


finite_tangents = st.lists(st.floats(-1.7, 1.7), min_size=6, max_size=6).map(np.array)


# --- exp and log -------------------------------------------------------------------------------


@AT_ANGLE
@BATCHES
def test_exp_is_the_power_series(batch, angle):
    xi = tangents(batch, angle)
    T = se3.exp(xi)
    assert T.shape == (*batch, 4, 4)
    for got, x in zip(flat(T, 2), flat(xi, 1)):
        np.testing.assert_allclose(got, series(x), rtol=0, atol=4e-15)


@AT_ANGLE
def test_exp_is_scipys(angle):
    xi = tangents((20,), angle)
    np.testing.assert_allclose(se3.exp(xi), RigidTransform.from_exp_coords(xi).as_matrix(), rtol=0, atol=2e-12)
    np.testing.assert_allclose(se3.exp(xi)[3], expm(twist(xi[3])), rtol=0, atol=2e-12)


@AT_ANGLE
@BATCHES
def test_log_undoes_exp(batch, angle):
    xi = tangents(batch, angle)
    np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, rtol=0, atol=2e-14)


@given(finite_tangents)
def test_log_undoes_exp_anywhere(xi):
    np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, rtol=0, atol=1e-13)


@pytest.mark.parametrize("seed", range(5))
def test_log_is_scipys(seed):
    T = RigidTransform.from_components(
        np.random.default_rng(seed).normal(size=(50, 3)), Rotation.random(50, random_state=seed)
    )
    np.testing.assert_allclose(se3.log(T.as_matrix()), T.as_exp_coords(), rtol=0, atol=1e-12)


@pytest.mark.parametrize("axis", [*np.eye(3), [1, 1, 0], [1, -2, 3], [-1, 1e-9, 0], [1e-4, 1, -1]], ids=str)
def test_half_turns(axis):
    axis = np.array(axis) / np.linalg.norm(axis)
    R = 2 * np.outer(axis, axis) - np.eye(3)  # exact, without trigonometry
    w = se3.so3_log(R)
    assert np.linalg.norm(w) == pytest.approx(np.pi, abs=1e-15)
    np.testing.assert_allclose(w, np.pi * axis * np.sign(w @ axis), atol=1e-12)  # either sign is right
    np.testing.assert_allclose(se3.exp(np.r_[w, 0, 0, 0])[:3, :3], R, atol=1e-12)


def test_log_of_the_identity_is_exactly_zero():
    assert (se3.log(np.eye(4)) == 0).all()
    assert (se3.exp(np.zeros((3, 6))) == np.eye(4)).all()


@AT_ANGLE
@BATCHES
def test_angle(batch, angle):
    T = se3.exp(tangents(batch, angle, seed=1)) @ np.eye(4)
    np.testing.assert_allclose(se3.angle_rad(T), np.full(batch, angle), rtol=0, atol=1e-14)
    assert (se3.angle_rad(T[..., :3, :3]) == se3.angle_rad(T)).all()


def test_angle_is_scipys():
    R = Rotation.random(500, random_state=2)
    np.testing.assert_allclose(se3.angle_rad(R.as_matrix()), R.magnitude(), rtol=0, atol=1e-13)


# --- the group ---------------------------------------------------------------------------------


@AT_ANGLE
@BATCHES
def test_inverse(batch, angle):
    T = se3.exp(tangents(batch, angle))
    eye = np.broadcast_to(np.eye(4), T.shape)
    np.testing.assert_allclose(se3.inverse(T) @ T, eye, atol=2e-14)
    np.testing.assert_allclose(T @ se3.inverse(T), eye, atol=2e-14)
    np.testing.assert_allclose(se3.inverse(T), se3.exp(-tangents(batch, angle)), atol=2e-14)
    np.testing.assert_array_equal(se3.inverse(se3.inverse(T))[..., :3, :3], T[..., :3, :3])


@BATCHES
def test_products_act_one_after_the_other(batch):
    T_a_b, T_b_c = se3.exp(tangents(batch, seed=1)), se3.exp(tangents(batch, seed=2))
    p_c = np.random.default_rng(3).normal(size=(*batch, 11, 3))
    p_a = se3.transform(T_a_b, se3.transform(T_b_c, p_c))
    assert p_a.shape == p_c.shape
    np.testing.assert_allclose(se3.transform(T_a_b @ T_b_c, p_c), p_a, atol=1e-13)


def test_transform_is_scipys_and_broadcasts():
    T, p = se3.exp(tangents((6,))), np.random.default_rng(0).normal(size=(9, 3))
    expected = np.stack([RigidTransform.from_matrix(t).apply(p) for t in T])
    np.testing.assert_allclose(se3.transform(T, p), expected, atol=1e-14)
    assert se3.transform(T[0], p[:0]).shape == (0, 3)


def test_transform_keeps_missing_points_missing():
    p = np.array([[1.0, 2, 3], [np.nan, np.nan, np.nan], [4, 5, 6]])
    assert np.isnan(se3.transform(se3.exp(tangents(())), p)).any(1).tolist() == [False, True, False]


@BATCHES
def test_hat_is_the_cross_product(batch):
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(*batch, 3)), rng.normal(size=(*batch, 3))
    np.testing.assert_allclose((se3.hat(a) @ b[..., None])[..., 0], np.cross(a, b), atol=1e-15)
    np.testing.assert_array_equal(se3.hat(a), -np.swapaxes(se3.hat(a), -1, -2))


def test_from_rt_broadcasts():
    R, t = Rotation.random(4, random_state=0).as_matrix(), np.array([1, 2, 3])
    T = se3.from_rt(R, t)
    assert T.shape == (4, 4, 4) and T.dtype == float
    np.testing.assert_array_equal(T[:, :3, :3], R)
    np.testing.assert_array_equal(T[:, :3, 3], np.tile(t, (4, 1)))
    np.testing.assert_array_equal(T[:, 3], np.tile([0, 0, 0, 1], (4, 1)))


def test_the_identity_cannot_be_changed():
    with pytest.raises(ValueError, match="read-only"):
        se3.IDENTITY[0, 0] = 2


# --- adjoint -----------------------------------------------------------------------------------


@AT_ANGLE
@BATCHES
def test_adjoint_carries_tangents_across(batch, angle):
    T, xi = se3.exp(tangents(batch, angle)), tangents(batch, 0.3, seed=5)
    carried = (se3.adjoint(T) @ xi[..., None])[..., 0]
    assert se3.adjoint(T).shape == (*batch, 6, 6)
    np.testing.assert_allclose(T @ se3.exp(xi) @ se3.inverse(T), se3.exp(carried), atol=2e-14)


def test_adjoint_is_a_homomorphism():
    A, B = se3.exp(tangents((8,), seed=1)), se3.exp(tangents((8,), seed=2))
    np.testing.assert_allclose(se3.adjoint(A @ B), se3.adjoint(A) @ se3.adjoint(B), atol=1e-13)
    np.testing.assert_allclose(se3.adjoint(se3.inverse(A)), np.linalg.inv(se3.adjoint(A)), atol=1e-13)


# --- interpolation -----------------------------------------------------------------------------


@AT_ANGLE
@BATCHES
def test_interpolation_starts_and_ends_where_it_should(batch, angle):
    A = se3.exp(tangents(batch, seed=1))
    B = A @ se3.exp(tangents(batch, angle))
    np.testing.assert_allclose(se3.interpolate(A, B, 0.0), A, atol=1e-13)
    np.testing.assert_allclose(se3.interpolate(A, B, 1.0), B, atol=1e-13)
    np.testing.assert_allclose(se3.interpolate(A, A, 0.3), A, atol=1e-13)


def test_interpolation_is_constant_speed_and_symmetric():
    A = se3.exp(tangents((), seed=1))
    B, s = A @ se3.exp(tangents((), 2.0)), np.linspace(0, 1, 11)
    path = se3.interpolate(A, B, s)
    steps = se3.log(se3.inverse(path[:-1]) @ path[1:])
    np.testing.assert_allclose(steps, np.tile(steps[0], (10, 1)), atol=1e-13)
    np.testing.assert_allclose(se3.interpolate(B, A, s), path[::-1], atol=1e-13)
    rotations = Slerp([0, 1], Rotation.from_matrix([A[:3, :3], B[:3, :3]]))(s).as_matrix()
    np.testing.assert_allclose(path[:, :3, :3], rotations, atol=1e-13)


def test_interpolation_takes_one_share_per_pose():
    A, B = se3.exp(tangents((5,), seed=1)), se3.exp(tangents((5,), seed=2))
    s = np.linspace(0.1, 0.9, 5)
    expected = np.stack([se3.interpolate(a, b, x) for a, b, x in zip(A, B, s)])
    np.testing.assert_allclose(se3.interpolate(A, B, s), expected, atol=1e-14)


# --- back to the group -------------------------------------------------------------------------


@BATCHES
def test_orthonormalised_is_the_polar_factor(batch):
    T = se3.exp(tangents(batch))
    bent = T.copy()
    bent[..., :3, :3] += np.random.default_rng(4).normal(0, 0.05, (*batch, 3, 3))
    mended = se3.orthonormalised(bent)
    np.testing.assert_array_equal(mended[..., :3, 3], T[..., :3, 3])
    for got, M in zip(flat(mended, 2), flat(bent, 2)):
        se3.check("mended", got, tolerance=1e-14)
        np.testing.assert_allclose(got[:3, :3], polar(M[:3, :3])[0], atol=1e-13)
    np.testing.assert_allclose(se3.orthonormalised(T), T, atol=1e-14)


def test_orthonormalised_makes_a_rotation_of_a_reflection_and_no_other_is_nearer():
    rng = np.random.default_rng(0)
    M = np.eye(4)
    M[:3, :3] = np.diag([1.0, 1, -0.2]) @ Rotation.random(random_state=1).as_matrix()
    R = se3.orthonormalised(M)[:3, :3]
    assert np.linalg.det(R) == pytest.approx(1)
    others = Rotation.from_rotvec(rng.normal(0, 0.5, (2000, 3))).as_matrix() @ R
    assert np.linalg.norm(R - M[:3, :3]) <= np.linalg.norm(others - M[:3, :3], axis=(1, 2)).min()


# --- check -------------------------------------------------------------------------------------


def test_check_returns_what_it_was_given():
    T = se3.exp(tangents(()))
    np.testing.assert_array_equal(se3.check("T", T.tolist()), T)
    assert se3.check("T", np.eye(4, dtype=int)).dtype == float
    almost = T.copy()
    almost[:3, :3] *= 1 + 2e-5  # single precision on disk
    se3.check("T", almost)


def bad(change) -> np.ndarray:
    T = se3.exp(tangents(()))
    change(T)
    return T


@pytest.mark.parametrize(
    ("T", "words"),
    [
        (np.eye(3), r"shape \(3, 3\).*4x4"),
        (np.zeros((2, 4, 4)), r"shape \(2, 4, 4\)"),
        (bad(lambda T: T.__setitem__((0, 3), np.nan)), "NaN"),
        (bad(lambda T: T.__setitem__((2, 1), np.inf)), "infinite"),
        (bad(lambda T: T.__imul__(1.01)), "not a rotation"),
        (np.round(se3.exp(tangents(())), 3), r"R R\^T is off by .* to 0\.0001\. .*more decimals"),
        (np.diag([1.0, 1, -1, 1]), "not a rotation.*right-handed"),
        (np.zeros((4, 4)), "not a rotation"),
        (bad(lambda T: T.__setitem__(3, [0, 0, 0, 2])), "last row.*0 0 0 1"),
        (bad(lambda T: T.__setitem__(3, [0.1, 0, 0, 1])), "last row"),
    ],
)
def test_check_refuses_in_one_line_that_names_the_thing(T, words):
    with pytest.raises(BadInput, match=words) as caught:
        se3.check("pose of frame 7", T)
    assert str(caught.value).startswith("pose of frame 7: got ")
    assert "\n" not in str(caught.value)


def test_the_median_is_in_the_middle_whatever_a_few_do():
    T, rng = se3.exp(tangents(())), np.random.default_rng(3)
    near = T @ se3.exp(rng.normal(scale=0.01, size=(40, 6)))
    near[:6] = se3.exp(rng.normal(size=(6, 6)))
    assert np.abs(se3.log(se3.inverse(T) @ se3.median(near))).max() < 0.01
