"""What a run adds up to: the numbers of every frame, for run.npz and for the end of a run."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mpm_env.health import ContactReport
from mpm_env.mpm.budgets import budgets, total
from mpm_env.scene import Scene, State
from mpm_env.scene_config import SnowConfig
from mpm_env.view import View

LAST_SHARE = 0.1  # of a run: mean forces "at the end" are over this


@dataclass(eq=False)
class Ledger:
    """Time series of a run; `arrays` names them, with shapes and units.

    frames f, rigid steps k, bodies b (the world is body 0), coupled geoms g, snapshots s, slots n, rows of history h,
    kinds of snow q.
    """

    scene: Scene
    frames: dict[str, list[Any]] = field(default_factory=dict)
    reactions: list[np.ndarray] = field(default_factory=list)
    snapshots: dict[str, list[Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        scene = self.scene
        gravity = jnp.asarray(scene.gravity, scene.dtype)
        self._start: np.ndarray | None = None  # (n,) kg, each slot's mass at the first frame
        self._snow = [k for k, grains in enumerate(scene.config.grains) if grains.material.model == "snow"]
        self._budgets = jax.jit(lambda state: budgets(scene.grid, scene.beds(state.materials), state.grains, gravity))

    def note(self, state: State, view: View, reactions: np.ndarray) -> dict[str, float]:
        """Add a frame with the reactions (j, g, 6) since the last one; returns the scalars worth a plot."""
        row = {
            "step": int(state.steps),
            "time": view.time,
            "health": int(state.health),
            **self._of_mass(state),
            **self._of_grains(state),
            **self._of_snow(state),
            **self._of_bodies(state, view),
            **self._of_contact(state),
        }
        for key, value in row.items():
            self.frames.setdefault(key, []).append(value)
        self.reactions.append(np.asarray(reactions, np.float64))
        return {
            "mass/present_kg": row["mass"],
            "mass/left_kg": row["mass_left"],
            "energy/grains_kinetic_J": row["kinetic"],
            "energy/grains_elastic_J": row["elastic"],
            "energy/grains_potential_J": row["potential"],
            "energy/bodies_kinetic_J": row["bodies_kinetic"],
            "energy/bodies_potential_J": row["bodies_potential"],
            "health/bits": float(row["health"]),
            **{f"contact/{key}": row[f"contact_{key}"] for key in ContactReport._fields if self.scene.bodies},
        }

    def snapshot(self, state: State, view: View) -> None:
        """Keep every grain of a state: empty slots have no mass."""
        scene, p = self.scene, state.grains_at_home
        x, v = (np.full((scene.slots, 3), np.nan, np.float32) for _ in range(2))
        x[view.slots] = view.grains
        v[view.slots] = _in_space(np.asarray(p.v), scene)[view.slots]
        row = {"time": view.time, "x": x, "v": v, "mass": p.m, "history": p.history}
        for key, value in row.items():
            self.snapshots.setdefault(f"snapshot_{key}", []).append(value)

    def arrays(self) -> dict[str, np.ndarray]:
        """Everything noted.

        step, time s, health (f,); body_position (f, b, 3) m, body_quaternion (f, b, 4) w x y z, body_twist (f, b, 6)
        m/s and rad/s at the body's origin; qpos, qvel, control (f, nq | nv | nu); reaction_time (k,) s and reaction
        (k, g, 6) N and N m about the body's centre of mass, mean over each rigid step; of the grains mass, and
        mass_left of those that were there at the first frame and are gone (f,) kg, momentum (f, 3) kg m/s,
        angular_momentum (f, 3) kg m^2/s about the world's origin, kinetic, elastic, potential (f,) J; the same of the
        bodies as bodies_*, potential zero at z = 0; snapshot_time (s,) s, snapshot_x (s, n, 3) m, snapshot_v (s, n, 3)
        m/s, snapshot_mass (s, n) kg, snapshot_material (n,), snapshot_history (s, h, n) what the materials remember, of
        snow ln J_P; with snow also J_P (f, q, 2), the least and the greatest of its grains; with bodies also contact_*
        (f,), the fields of health.ContactReport, of the last rigid step before each frame.
        """
        scene = self.scene
        b = scene.bodies
        reaction = np.concatenate(self.reactions[1:] or [np.zeros((0, len(b.geoms) if b else 0, 6))])
        material = np.zeros(scene.slots, int)
        for k, (start, stop) in enumerate(scene.spans):
            material[start:stop] = k
        return {
            **{key: np.asarray(rows) for key, rows in self.frames.items()},
            **{key: np.asarray(rows) for key, rows in self.snapshots.items()},
            "reaction": reaction,
            "reaction_time": (np.arange(len(reaction)) + 1) * scene.rigid_dt,
            "snapshot_material": material,
            "geom_names": np.asarray(b.names if b else (), str),
            "body_names": np.asarray([b.model.body(i).name for i in range(b.model.nbody)] if b else [], str),
        }

    def figures(self) -> dict[str, Any]:
        """The run in a few numbers: kg, m, N, s."""
        data = self.arrays()
        last = -max(int(LAST_SHARE * len(data["reaction"])), 1)
        forces = {}
        for g, name in enumerate(data["geom_names"]):
            force = data["reaction"][:, g, :3]
            size = np.linalg.norm(force, axis=-1)
            if len(size):
                peak = int(np.argmax(size))
                forces[str(name)] = {
                    "peak_N": float(size[peak]),
                    "peak_at_s": float(data["reaction_time"][peak]),
                    "mean_N": force.mean(axis=0).tolist(),
                    "last_tenth_mean_N": force[last:].mean(axis=0).tolist(),
                }
        here = data["snapshot_mass"][-1] > 0
        return {
            "simulated_s": float(data["time"][-1]),
            "mass_start_kg": float(data["mass"][0]),
            "mass_end_kg": float(data["mass"][-1]),
            "mass_left_kg": float(data["mass_left"][-1]),
            "top_of_grains_m": float(np.max(data["snapshot_x"][-1][here, 2])) if here.any() else None,
            "fastest_grain_m_s": float(np.max(np.linalg.norm(data["snapshot_v"][-1][here], axis=-1), initial=0.0)),
            "body_end_m": {
                str(name): data["body_position"][-1, i].tolist() for i, name in enumerate(data["body_names"]) if i
            },
            "forces_of_grains": forces,
            "snow": self._packing(),
        }

    def _packing(self) -> list[dict[str, float]]:
        """Least and greatest plastic volume ratio J_P of each snow over the run, and where its hardening ends."""
        found = []
        for q, k in enumerate(self._snow):
            J_P, material = np.asarray(self.frames["J_P"])[:, q], self.scene.config.grains[k].material
            assert isinstance(material, SnowConfig)
            found.append({"J_P_least": float(J_P.min()), "J_P_greatest": float(J_P.max()), "Jp_min": material.Jp_min})
        return found

    def _of_contact(self, state: State) -> dict[str, float]:
        """How contact went in the last rigid step."""
        if state.contact is None:
            return {}
        return {f"contact_{key}": float(value) for key, value in state.contact._asdict().items()}

    def _of_mass(self, state: State) -> dict[str, float]:
        """Mass there and mass gone, grain by grain: together they are the mass at the start to the last bit."""
        m = np.asarray(state.grains.m)
        if self._start is None:
            self._start = m
        return {"mass": float(total(m)), "mass_left": float(total(self._start[m == 0]))}

    def _of_snow(self, state: State) -> dict[str, Any]:
        """Least and greatest J_P of the grains of each snow, 1 where none is there."""
        if not self._snow:
            return {}
        m, history = np.asarray(state.grains.m), np.asarray(state.grains.history, float)
        rows = []
        for k in self._snow:
            a, b = self.scene.spans[k]
            J_P = np.exp(history[0, a:b][m[a:b] > 0])
            rows.append((J_P.min(), J_P.max()) if len(J_P) else (1.0, 1.0))
        return {"J_P": np.asarray(rows)}

    def _of_grains(self, state: State) -> dict[str, Any]:
        scene = self.scene
        sums = jax.tree.map(partial(np.asarray, dtype=np.float64), self._budgets(state))
        origin = np.insert(scene.grid.origin, 1, scene.middle) if scene.dimension == 2 else scene.grid.origin
        momentum = _in_space(sums.momentum[:, None], scene)[0]
        turning = sums.angular_momentum
        if scene.dimension == 2:  # the plane's (x, z) turn about minus y
            turning = np.array([0.0, -turning[2], 0.0])
        return {
            "momentum": momentum,
            "angular_momentum": turning + np.cross(origin, momentum),
            "kinetic": float(sums.kinetic),
            "elastic": float(sums.elastic),
            "potential": float(sums.potential - sums.mass * (scene.gravity @ scene.grid.origin)),
        }

    def _of_bodies(self, state: State, view: View) -> dict[str, Any]:
        scene, data = self.scene, view.data
        if scene.bodies is None or data is None:
            places = ("body_position", "body_quaternion", "body_twist", "qpos", "qvel", "control")
            sums = {"bodies_momentum": np.zeros(3), "bodies_angular_momentum": np.zeros(3)}
            return {**dict.fromkeys(places, np.zeros(0)), **sums, "bodies_kinetic": 0.0, "bodies_potential": 0.0}
        model = scene.bodies.model
        momentum = model.body_subtreemass[0] * data.subtree_linvel[0]
        return {
            "body_position": data.xpos.copy(),
            "body_quaternion": data.xquat.copy(),
            "body_twist": _twists(scene, data, view.time),
            "qpos": data.qpos.copy(),
            "qvel": data.qvel.copy(),
            "control": data.ctrl.copy(),
            "bodies_momentum": momentum,
            "bodies_angular_momentum": data.subtree_angmom[0] + np.cross(data.subtree_com[0], momentum),
            "bodies_kinetic": float(data.energy[1]),
            "bodies_potential": float(data.energy[0]),
        }


def _in_space(a: np.ndarray, scene: Scene) -> np.ndarray:
    """Rows (d, n) of the grid's axes as points (n, 3) of space."""
    if scene.dimension == 3:
        return a.T
    return np.stack([a[0], np.zeros_like(a[0]), a[1]], axis=-1)


def _twists(scene: Scene, data: mujoco.MjData, time: float) -> np.ndarray:
    """Velocity and angular velocity of every body at its origin, (b, 6) m/s and rad/s in world axes.

    MuJoCo knows no velocity of a mocap body: it is that of the script over the last rigid step.
    """
    assert scene.bodies is not None
    model = scene.bodies.model
    out = np.zeros((model.nbody, 6))
    for body in range(1, model.nbody):
        turning_first = np.zeros(6)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, turning_first, 0)
        out[body] = np.roll(turning_first, 3)
        mocap = model.body_mocapid[body]
        if mocap >= 0 and time > 0:
            was, now = (scene.motion.mocap(t) for t in (time - scene.rigid_dt, time))
            spin = np.zeros(3)
            mujoco.mju_subQuat(spin, now[1][mocap], was[1][mocap])
            axes = np.zeros(9)
            mujoco.mju_quat2Mat(axes, was[1][mocap])
            out[body] = [*(now[0][mocap] - was[0][mocap]), *(axes.reshape(3, 3) @ spin)]
            out[body] /= scene.rigid_dt
    return out
