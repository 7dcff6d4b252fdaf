"""Grains and a free box together in 3-D: the books of momentum and angular momentum, and a weight.

One small scene, compiled once: a box on a bed. The toss cuts a block out of that bed, with the box on it, and throws
both against each other in the air, far from all walls.
"""

from dataclasses import replace
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from coupling import bodies as rigid
from mpm_env import sim
from mpm_env.config import parse
from mpm_env.fidelity import Fidelity
from mpm_env.health import Health
from mpm_env.mpm.budgets import budgets
from mpm_env.scene import Scene, State, build, initial
from mpm_env.scene_config import SceneConfig

DX = 0.05  # m
DT = 0.004  # s, a rigid step
G = 9.81
RHO = 1500.0
SIDE, HEIGHT = 0.5, 0.6  # m, of the box that is simulated
DEPTH = 0.2  # m, of the bed
HALF = np.array([0.075, 0.05, 0.05])  # m, of the free box
SAND = {"model": "sand", "E": 1e6, "nu": 0.3, "rho": RHO, "friction_deg": 35.0}

LIFT = 4 * DX  # m, from the bed to where the toss starts
BLOCK = 2 * DX  # m, half the width of the block that is tossed
TOSS = 25  # rigid steps: then sand may be near a wall
THROWN = np.array([0.1, 0, 0.9])  # m/s, the block
DROPPED = np.array([-0.2, 0.1, -0.6])  # m/s, the box
SPIN = np.array([2.0, -1.0, 3.0])  # rad/s, of the box about its own axes


@cache
def scene() -> Scene:
    """A free box, as dense as the sand, on a level bed."""
    middle = SIDE / 2
    config = {
        "name": "small",
        "box": {"lower": (0, 0, 0), "upper": (SIDE, SIDE, HEIGHT)},
        "feature": 4 * DX,
        "duration": 1.0,
        "gravity": (0, 0, -G),
        "grains": [{"material": SAND, "fill": [{"shape": "box", "lower": (0, 0, 0), "upper": (SIDE, SIDE, DEPTH)}]}],
        "bodies": {
            "mjcf": f"""<mujoco><worldbody><body pos="{middle} {middle} {DEPTH + HALF[2]}"><freejoint/>
              <geom name="box" type="box" size="{HALF[0]} {HALF[1]} {HALF[2]}" density="{RHO}"/></body>
            </worldbody></mujoco>""",
            "couple": ["box"],
            "friction": 0.4,
        },
    }
    return build(parse(SceneConfig, config, "test"), Fidelity(cells=4, rigid_dt=DT))


@cache
def started() -> State:
    return jax.jit(partial(initial, scene()))(jax.random.key(0))


@cache
def program() -> Any:
    return jax.jit(partial(sim.advance, scene()))


def tossed() -> State:
    """The block under the box, thrown up from above the bed, and the box thrown down onto its corner, turning."""
    state = started()
    x = state.grains.x + jnp.asarray([[0], [0], [LIFT]], jnp.float32)
    across = np.abs(np.asarray(scene().world(x))[:2] - SIDE / 2)
    m = jnp.where(np.all(across < BLOCK, axis=0), state.grains.m, 0)
    v = jnp.where(m > 0, jnp.asarray(THROWN, jnp.float32)[:, None], 0)
    qpos = state.rigid.qpos.at[:3].add(jnp.asarray([0.03, -0.02, LIFT + 0.01], jnp.float32))
    d = state.rigid.replace(qpos=qpos, qvel=jnp.asarray([*DROPPED, *SPIN], jnp.float32))
    d = rigid.refresh(scene().bodies, d)
    return jax.device_put(replace(state, grains=replace(state.grains, x=x, v=v, m=m), rigid=d), jax.devices()[0])


class Books(NamedTuple):
    """Momentum, and angular momentum about the origin of the world; float64."""

    grains: np.ndarray  # (3,) N s
    body: np.ndarray  # (3,)
    grains_turning: np.ndarray  # (3,) N m s
    body_turning: np.ndarray  # (3,)


def books(state: State) -> Books:
    model, g, d = scene().bodies.model, state.grains, state.rigid
    m, v, C, x = (np.asarray(a, np.float64) for a in (g.m, g.v, g.C, scene().world(g.x)))
    affine = [DX**2 / 4 * np.sum(m * (C[j, i] - C[i, j])) for i, j in ((1, 2), (2, 0), (0, 1))]
    centre, w = np.asarray(d.xipos[1], np.float64), np.asarray(d.qvel, np.float64)
    frame, inertial = (np.asarray(a[1], np.float64).reshape(3, 3) for a in (d.xmat, d.ximat))
    momentum = model.body_mass[1] * w[:3]
    spin = inertial @ (model.body_inertia[1] * (inertial.T @ frame @ w[3:]))
    return Books(
        grains=v @ m,
        body=momentum,
        grains_turning=np.cross(x.T, (m * v).T).sum(axis=0) + affine,
        body_turning=np.cross(centre, momentum) + spin,
    )


if __name__ == "__main__":
    import time

    s = scene()
    print(s.mpm_per_rigid, s.slots, s.sizes)
    t = time.time()
    st = tossed()
    drives = sim.scripted(s, 0, 1)
    b = [books(st)]
    R = []
    X = []
    for k in range(TOSS):
        st, r = program()(st, drives)
        b.append(books(st))
        R.append(np.asarray(r, np.float64)[0, 0])
        x = np.asarray(s.world(st.grains.x))[:, np.asarray(st.grains.m) > 0]
        X.append((x.min(1), x.max(1), np.asarray(st.rigid.qvel)))
        if k == 0:
            print("compile", time.time() - t)
    print(time.time() - t, int(st.health))
    R = np.array(R)
    mg = float(np.sum(np.asarray(st.grains.m, np.float64)))
    mb = s.bodies.model.body_mass[1]
    print("masses", mg, mb)
    P = np.array([q.grains + q.body for q in b])
    grav = np.zeros_like(P)
    grav[:, 2] = -(mg + mb) * G * DT * np.arange(len(P))
    body = np.array([q.body for q in b])
    dB = np.diff(body, axis=0) + np.array([0, 0, mb * G * DT])
    ex = np.cumsum(np.linalg.norm(dB, axis=1))
    print("exchanged", ex)
    print("lin rel", np.linalg.norm(P - P[0] - grav, axis=1)[1:] / ex)
    print("pay rel", np.linalg.norm(R[:, :3] * DT - dB, axis=1) / np.linalg.norm(dB, axis=1))
    print("pay abs", np.abs(R[:, :3] * DT - dB).max(1))
    L = np.array([q.grains_turning + q.body_turning for q in b])
    for q in X[::6] + X[-1:]:
        print(q)
    np.savez(
        "/work/brief/td.npz",
        L=L,
        P=P,
        bt=np.array([q.body_turning for q in b]),
        gt=np.array([q.grains_turning for q in b]),
        R=R,
        body=body,
    )
    st = started()
    drives = sim.scripted(s, 0, 1)
    F = []
    Z = []
    Q = []
    t = time.time()
    for k in range(250):
        st, r = program()(st, drives)
        F.append(float(r[0, 0, 2]))
        Z.append(float(st.rigid.qpos[2]))
        Q.append(np.abs(np.asarray(st.rigid.qvel)).max())
    print("rest", time.time() - t, int(st.health), mb * G)
    for a in range(0, 250, 25):
        print(a, np.mean(F[a : a + 25]) / (mb * G), np.std(F[a : a + 25]) / (mb * G), Z[a], Q[a])
