"""Points that meet bodies with a gap to close first, or bodies that rigid constraints hold."""

from functools import cache

import numpy as np
import pytest

from coupling.exchange import Exchange
from tests.coupling import encounters as enc
from tests.coupling.encounters import JOINTS, REACH, met
from tests.coupling.test_meeting import CONVERGED, CONVERGED_SHARE, assert_close, assert_same

SAME_HELD = {"float32": 8e-5, "float64": 1e-12}  # where stiff constraints stand against each other; 2e-13 in float64
PATIENT = 20  # iterations: constraints and points of every mass at once are the hardest there is
LAW_TOLERANCE = {"float32": 1e-6, "float64": 1e-14}  # of the terms' sizes

each_precision = pytest.mark.parametrize("dtype", ["float32", "float64"])


# Gaps that close first.


@each_precision
def test_nodes_with_little_material_meet_bodies_as_in_the_reference(dtype: str) -> None:
    case = enc.gapped(dtype)
    got, truth = (met(enc.crowd(k), case, REACH, d, "batch") for k, d in (("native", dtype), ("xla", "float64")))
    assert_same(got, truth, case, dtype)
    never = enc.answers(dtype)[JOINTS.index(6)].exchange.impulse
    fewer = np.any(got.exchange.impulse, axis=1).sum() / np.any(never, axis=1).sum()
    assert 0.2 < fewer < 0.9, "gaps make no difference"


# Rigid constraints in the exchange.


@cache
def held(dtype: str) -> Exchange:
    return met(enc.crowd("native", PATIENT), enc.constrained(dtype), REACH, dtype, "batch").exchange


@each_precision
def test_an_exchange_with_rigid_constraints_is_that_of_the_reference(dtype: str) -> None:
    case = enc.constrained(dtype)
    truth = met(enc.crowd("xla", PATIENT), case, REACH, "float64", "batch").exchange
    both = (held(dtype).residual < CONVERGED[dtype]) & (truth.residual < CONVERGED["float64"])
    assert both.mean() >= CONVERGED_SHARE
    for name in ("impulse", "given"):
        a, b = (getattr(done, name).reshape(len(both), -1) for done in (held(dtype), truth))
        size = np.abs(truth.impulse).max(axis=(1, 2)) + np.abs(truth.given).max(axis=1)
        assert_close(((a - b) / size[:, None])[both], 0, SAME_HELD[dtype])


@each_precision
def test_rigid_constraints_give_what_their_laws_say(dtype: str) -> None:
    """And joints get what constraints and points give: no reference is asked."""
    case, done = enc.constrained(dtype), held(dtype)
    rows, solved = case.t.rows, done.residual < CONVERGED[dtype]
    into = rows.J @ rows.T
    p = np.clip(rows.D * (rows.aim - np.einsum("erm,em->er", into, done.q)), rows.low, rows.high)
    digits = np.abs(rows.D) * (np.abs(rows.aim) + np.einsum("erm,em->er", np.abs(into), np.abs(done.q)))
    assert_close(((done.given - p) / digits)[solved], 0, LAW_TOLERANCE[dtype])
    got = np.einsum("enm,em->en", case.t.M, done.q - case.q_free)
    paid = np.einsum("er,ern->en", done.given - rows.given, rows.J)
    paid += np.einsum("egkn,egk->en", case.t.J[:, list(enc.BODY_OF)], done.wrench)
    size = np.einsum("er,ern->en", digits + np.abs(rows.given), np.abs(rows.J)).max(axis=1) + np.abs(paid).max(axis=1)
    assert_close(((got - paid) / size[:, None])[solved], 0, LAW_TOLERANCE[dtype])
    at_bound = (done.given == rows.low) | (done.given == rows.high)
    assert 0.1 < at_bound[:, 1:5].mean() < 0.9 and not done.given[:, -1].any(), "the laws' sides are not all seen"


@each_precision
def test_rigid_constraints_settle_without_points_too(dtype: str) -> None:
    case = enc.constrained(dtype)
    alone = met(enc.crowd("native"), case._replace(m=0 * case.m), REACH, dtype, "batch").exchange
    truth = met(enc.crowd("xla"), case._replace(m=0 * case.m), REACH, "float64", "batch").exchange
    assert not alone.impulse.any() and alone.residual.max() < CONVERGED[dtype]
    size = np.abs(truth.given).max(axis=1, keepdims=True)
    assert_close((alone.given - truth.given) / size, 0, SAME_HELD[dtype])
