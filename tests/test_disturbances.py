"""Unknown dynamics f(chi): each law's closed form, its scale, and f(0) = 0 where (1) requires it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from marlbc_mj.core import laws
from marlbc_mj.core.disturbances import ConstantWind, LinearDrag, PaperDrag, QuadraticDrag
from marlbc_mj.util.errors import ConfigurationError

vectors = arrays(np.float64, 2, elements=st.floats(-100.0, 100.0))
scales = st.floats(-3.0, 3.0)

CLOSED_FORMS = [
    (
        PaperDrag,
        {},
        lambda p, v: [
            v[0] * np.sin(p[1]) ** 2 + v[1] * np.cos(p[0]) ** 2,
            v[0] * np.sin(p[1]) ** 2 - v[1] * np.cos(p[0]) ** 2,
        ],
    ),
    (LinearDrag, {"coefficient": 1.7}, lambda p, v: -1.7 * v),
    (QuadraticDrag, {"coefficient": 0.3}, lambda p, v: -0.3 * np.linalg.norm(v) * v),
    (ConstantWind, {"force": (3.0, -2.0)}, lambda p, v: [3.0, -2.0]),
]


def force_of(disturbance, p, v, t=0.0) -> np.ndarray:
    out = np.full(2, np.nan)
    disturbance.law(laws.as_gains(disturbance.law, disturbance.params()), t, p, v, out)
    return out


@pytest.mark.parametrize(("kind", "numbers", "closed_form"), CLOSED_FORMS, ids=lambda x: getattr(x, "__name__", ""))
@given(p=vectors, v=vectors, scale=scales)
def test_closed_form_times_scale(kind, numbers, closed_form, p, v, scale):
    """(43) and the project's own laws equal their closed forms times ``scale``."""
    expected = scale * np.array(closed_form(p, v))
    np.testing.assert_allclose(force_of(kind(scale=scale, **numbers), p, v), expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("kind", [PaperDrag, LinearDrag, QuadraticDrag])
@given(p=vectors)
def test_drag_vanishes_at_rest(kind, p):
    """f = 0 without velocity, in particular f(0) = 0 as (1) requires."""
    assert not force_of(kind(), p, np.zeros(2)).any()
    assert not force_of(kind(), np.zeros(2), np.zeros(2)).any()


@pytest.mark.parametrize("kind", [LinearDrag, QuadraticDrag])
@given(v=vectors)
def test_passive_drag_takes_energy(kind, v):
    """f . v <= 0 for true drag, unlike (43), which can add energy."""
    assert force_of(kind(), np.zeros(2), v) @ v <= 0.0


@pytest.mark.parametrize("kind", [kind for kind, _, _ in CLOSED_FORMS])
def test_gains_begin_with_the_scale(kind):
    """The first number of the row is the scale, which random draws multiply."""
    assert laws.pack_gains(kind.law, kind(scale=0.25).params())[0] == 0.25
    assert not force_of(kind(scale=0.0), np.ones(2), np.ones(2)).any()


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize(
    "make",
    [
        PaperDrag,
        lambda x: LinearDrag(coefficient=x),
        lambda x: QuadraticDrag(coefficient=x),
        lambda x: ConstantWind(force=(x, 0)),
    ],
)
def test_numbers_that_are_not_finite_are_refused(make, value):
    """The message shows the value."""
    with pytest.raises(ConfigurationError, match=str(value)):
        make(value)
