"""Prescribed motion of a scene: actuator controls and mocap poses as smooth functions of time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from mpm_env.config import nearest
from mpm_env.scene_config import BodiesConfig, Waypoint

Curve = Callable[[float], np.ndarray]


@dataclass(frozen=True, eq=False)
class Motion:
    """What a script tells the bodies at each time; outside a curve's times its end values hold."""

    controls: tuple[Curve, ...]  # (nu)
    positions: tuple[Curve, ...]  # (nmocap)
    turns: tuple[Curve, ...]  # (nmocap) quaternions w x y z
    end: float  # s, after which nothing changes
    extents: tuple[float, ...]  # (nmocap) m, how far a mocap body's geoms reach from its origin

    @classmethod
    def of(cls, config: BodiesConfig | None, model: mujoco.MjModel | None) -> Motion:
        """The motion that a scene describes. Raises ValueError for names that the model does not have."""
        if config is None or model is None:
            return cls((), (), (), 0.0, ())
        actuators = [model.actuator(i).name for i in range(model.nu)]
        mocap = {int(model.body_mocapid[b]): model.body(b) for b in range(model.nbody) if model.body_mocapid[b] >= 0}
        names = [mocap[i].name for i in range(model.nmocap)]
        for name in config.controls:
            if name not in actuators:
                raise ValueError(f"The model has no actuator {name!r}{nearest(name, actuators)}")
        for name in config.motion:
            if name not in names:
                raise ValueError(f"The model has no mocap body {name!r}{nearest(name, names)}")
        for i, name in enumerate(actuators):
            low, high = map(float, model.actuator_ctrlrange[i])
            values = [value for _, value in config.controls.get(name, [])]
            if values and model.actuator_ctrllimited[i] and not low <= min(values) <= max(values) <= high:
                raise ValueError(
                    f"The controls of {name!r} go from {min(values):.6g} to {max(values):.6g}, beyond its range of"
                    f" {low:.6g} to {high:.6g}: stay inside it."
                )
        start = _start_controls(config, model)
        controls = tuple(
            _curve(config.controls.get(name) or [(0.0, float(start[i]))], name) for i, name in enumerate(actuators)
        )
        positions, turns = [], []
        for i, name in enumerate(names):
            x, y, z = map(float, mocap[i].pos)
            points = config.motion.get(name) or [Waypoint(t=0, position=(x, y, z))]
            positions.append(_curve([(w.t, w.position) for w in points], name))
            turns.append(_turn(points, np.asarray(mocap[i].quat), name))
        times = [t for path in config.controls.values() for t, _ in path]
        times += [w.t for path in config.motion.values() for w in path]
        extents = tuple(_extent(model, mocap[i].id) for i in range(model.nmocap))
        return cls(controls, tuple(positions), tuple(turns), max(times, default=0.0), extents)

    def control(self, t: float) -> np.ndarray:
        """Actuator controls (nu,) at time t s."""
        return np.asarray([float(c(t)) for c in self.controls])

    def mocap(self, t: float) -> tuple[np.ndarray, np.ndarray]:
        """Mocap positions (nmocap, 3) m and quaternions (nmocap, 4) at time t s."""
        return (
            np.asarray([c(t) for c in self.positions]).reshape(-1, 3),
            np.asarray([c(t) for c in self.turns]).reshape(-1, 4),
        )

    def top_speed(self) -> float:
        """The fastest that any part of a mocap body moves, m/s."""
        if not self.positions or self.end == 0:
            return 0.0
        times = np.linspace(0, self.end, 1001)
        dt = times[1]
        fastest = 0.0
        for position, turn, reach in zip(self.positions, self.turns, self.extents, strict=True):
            path = np.asarray([position(t) for t in times])
            q = Rotation.from_quat(np.asarray([turn(t) for t in times]), scalar_first=True)
            spin = (q[1:] * q[:-1].inv()).magnitude() / dt
            fastest = max(fastest, float(np.max(np.linalg.norm(np.diff(path, axis=0), axis=1) / dt + spin * reach)))
        return fastest


def _start_controls(config: BodiesConfig, model: mujoco.MjModel) -> np.ndarray:
    keys = [model.key(i).name for i in range(model.nkey)]
    if config.keyframe in keys:
        return np.asarray(model.key(config.keyframe).ctrl)
    return np.zeros(model.nu)


def _extent(model: mujoco.MjModel, body: int) -> float:
    geoms = [g for g in range(model.ngeom) if model.body_rootid[model.geom_bodyid[g]] == body]
    return max((float(np.linalg.norm(model.geom_pos[g]) + model.geom_rbound[g]) for g in geoms), default=0.0)


def _times(path: list[float], name: str) -> np.ndarray:
    times = np.asarray(path, float)
    if (np.diff(times) <= 0).any():
        raise ValueError(f"The waypoint times of {name!r} must increase, got {[float(t) for t in times]}.")
    return times


def _curve(path: list, name: str) -> Curve:
    """Values over time, joined by a monotone cubic (no overshoot), constant before and after."""
    times = _times([t for t, _ in path], name)
    values = np.asarray([v for _, v in path], float)
    if len(times) == 1:
        return lambda t: values[0]
    from scipy.interpolate import PchipInterpolator  # a fifth of a second, which scenes without a script do not wait

    spline = PchipInterpolator(times, values)
    return lambda t: spline(np.clip(t, times[0], times[-1]))


def _turn(points: list[Waypoint], start: np.ndarray, name: str) -> Curve:
    quats = [np.asarray(w.quaternion, float) if w.quaternion else start for w in points]
    times = _times([w.t for w in points], name)
    if any(np.linalg.norm(q) < 1e-6 for q in quats):
        raise ValueError(f"A quaternion of {name!r} is zero: give one of length 1, such as [1, 0, 0, 0].")
    rotations = Rotation.from_quat(np.asarray(quats), scalar_first=True)
    if len(times) == 1:
        return lambda t: rotations[0].as_quat(scalar_first=True)
    slerp = Slerp(times, rotations)
    return lambda t: slerp(np.clip(t, times[0], times[-1])).as_quat(scalar_first=True)
