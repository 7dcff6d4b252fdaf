"""A state seen from the host: grains and bodies as numbers, as a picture, and as a frame of a recording."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from mpm_env.log import Recorder
from mpm_env.render import Camera, camera_for, render
from mpm_env.scene import Scene, State

# The dark and the light end of a material's grains; each grain lies between them.
TONES = {
    "sand": ((184, 142, 88), (236, 204, 150)),
    "snow": ((214, 224, 238), (248, 250, 253)),
    "elastic": ((96, 120, 92), (128, 156, 118)),
    "von_mises": ((120, 126, 134), (158, 164, 172)),
    "herschel_bulkley": ((110, 84, 66), (148, 118, 94)),
    "mu_i": ((184, 142, 88), (236, 204, 150)),
    "cam_clay": ((206, 214, 226), (240, 243, 248)),
}
TONE_SEED = 61_803  # not one that a scene would draw its grains from: places and colours would go together
DRAWN_SHARE = 0.6  # radius of a drawn grain over the distance of grains: heaps look closed


@dataclass(frozen=True, eq=False)
class View:
    """A state on the host: the grains that are there, and where the bodies are."""

    scene: Scene
    time: float  # s
    slots: np.ndarray  # (n,) int, the slots that these grains had at the start
    grains: np.ndarray  # (n, 3) float32 m
    speed: np.ndarray  # (n,) m/s
    material: np.ndarray  # (n,) int, index of the scene's grains entry
    data: mujoco.MjData | None  # poses, velocities and energies of the bodies; None without bodies

    @classmethod
    def of(cls, scene: Scene, state: State) -> View:
        """Look at a state."""
        time = int(state.steps) * scene.rigid_dt
        grains = state.grains_at_home
        slots = np.flatnonzero(grains.m)
        x = np.asarray(grains.x)[:, slots] + scene.grid.origin[:, None].astype(scene.dtype)
        if scene.dimension == 2:
            x = np.stack([x[0], np.full_like(x[0], scene.middle), x[1]])
        speed = np.linalg.norm(np.asarray(grains.v)[:, slots], axis=0)
        starts = np.asarray([a for a, _ in scene.spans], int)
        material = np.searchsorted(starts, slots, side="right") - 1
        return cls(scene, time, slots, x.T.astype(np.float32), speed, material, body_data(scene, state))

    @property
    def poses(self) -> np.ndarray:
        """Position in m and rotation by rows of every geom, (g, 12)."""
        if self.data is None:
            return np.zeros((0, 12))
        return np.concatenate([self.data.geom_xpos, self.data.geom_xmat], axis=1)

    def values(self, quantity: str) -> np.ndarray:
        """What colours the grains in a recording, (n,): "speed", "height" or "material"."""
        return {"speed": self.speed, "height": self.grains[:, 2], "material": self.material}[quantity]

    def wrenches(self, reactions: np.ndarray) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Per coupled body that can move: centre of mass (3,) m, and mean force (3,) N and torque (3,) N m about it.

        reactions (k, G, 6) N and N m, as `sim.advance` returns them.
        """
        b = self.scene.bodies
        if b is None or self.data is None:
            return {}
        per_body = np.zeros((len(b.bodies), 6))
        np.add.at(per_body, np.asarray(b.body_of), np.mean(np.asarray(reactions, float), axis=0))
        return {
            b.model.body(body).name or f"body{body}": (self.data.xipos[body].copy(), wrench[:3], wrench[3:])
            for body, wrench, mocap in zip(b.bodies, per_body, b.mocap, strict=True)
            if mocap >= 0 or b.model.body_weldid[body] != 0
        }

    def picture(
        self, *, width: int = 480, height: int = 320, samples: int = 1, camera: Camera | None = None
    ) -> np.ndarray:
        """(height, width, 3) uint8, by default from the scene's own camera. A slice is drawn as thick as its box."""
        grains, colours = self._drawn()
        return render(
            None if self.scene.bodies is None else self.scene.bodies.model,
            self.data,
            camera or camera_of(self.scene),
            grains=grains,
            colors=colours,
            grain_radius=DRAWN_SHARE * self.scene.spacing,
            ground_z=self.scene.config.box.lower[2],
            width=width,
            height=height,
            samples=samples,
        )

    def _drawn(self) -> tuple[np.ndarray, np.ndarray]:
        """Grains (n, 3) m and their colours (n, 3) uint8 for a picture; a slice is repeated through its box."""
        scene, chance = self.scene, np.random.default_rng(TONE_SEED)
        grains, slots, material = self.grains, self.slots, self.material
        layers = 1
        if scene.dimension == 2:
            low, high = scene.config.box.lower[1], scene.config.box.upper[1]
            layers = max(round((high - low) / scene.spacing), 1)
            y = low + (np.arange(layers) + 0.5) * scene.spacing
            grains, material = np.repeat(grains, layers, axis=0), np.repeat(material, layers)
            slots = np.repeat(slots * layers, layers) + np.tile(np.arange(layers), len(slots))
            grains[:, 1] = np.tile(y, len(self.grains))
            # Copies would line up as rods: each is drawn a little off, the same way in every picture.
            grains += chance.uniform(-0.4, 0.4, (scene.slots * layers, 3))[slots].astype(np.float32) * scene.spacing
        tones = np.asarray([TONES[g.material.model] for g in scene.config.grains], float).reshape(-1, 2, 3)
        share = chance.random(scene.slots * layers)[slots, None]
        dark, light = tones[material, 0], tones[material, 1]
        return grains, (dark + share * (light - dark)).astype(np.uint8)


def camera_of(scene: Scene) -> Camera:
    """The scene's camera, or one that holds its box. Raises ValueError for one that cannot look."""
    config = scene.config
    if config.camera is None:
        return camera_for(config.box.lower, config.box.upper)
    return Camera(config.camera.eye, config.camera.target, config.camera.fov_deg)


def body_data(scene: Scene, state: State) -> mujoco.MjData | None:
    """The bodies of a state as MuJoCo data: poses, velocities, energies and momenta."""
    if scene.bodies is None:
        return None
    model = scene.bodies.model
    data = mujoco.MjData(model)
    data.time = int(state.steps) * scene.rigid_dt
    for name in ("qpos", "qvel", "ctrl", "mocap_pos", "mocap_quat"):
        getattr(data, name)[:] = np.asarray(getattr(state.rigid, name))
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_crb(model, data)
    mujoco.mj_comVel(model, data)
    mujoco.mj_subtreeVel(model, data)
    mujoco.mj_energyPos(model, data)
    mujoco.mj_energyVel(model, data)
    return data


def write_frame(
    recorder: Recorder, view: View, *, step: int, reactions: np.ndarray, quantity: str, scalars: dict[str, float]
) -> None:
    """Write a view as the recording's next frame, with the reactions (k, G, 6) since the frame before."""
    recorder.frame(
        step=step,
        time=view.time,
        grains=view.grains,
        values=view.values(quantity),
        grain_radius=view.scene.spacing / 2,
        geom_pos=None if view.data is None else view.data.geom_xpos,
        geom_mat=None if view.data is None else view.data.geom_xmat,
        wrenches=view.wrenches(reactions),
        scalars=scalars,
    )


def no_reactions(scene: Scene) -> np.ndarray:
    """Reactions (1, G, 6) of the moment before anything has moved."""
    return np.zeros((1, len(scene.bodies.geoms) if scene.bodies else 0, 6))
