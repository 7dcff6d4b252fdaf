"""The sand column in Genesis 1.4.5 on the CPU: its own explicit MPM and sand, with a rigid plane as the floor.

python -m benchmarks.peers.genesis_column --n 20 --tend 0.002
"""

import genesis as gs
import numpy as np
import torch

from benchmarks import job

SUBSTEPS = 10  # in one call
a = job.parser(__doc__ or "").parse_args()
torch.set_num_threads(1)
gs.init(backend=gs.cpu, precision="32", logging_level="error")

dx = job.SIDE / a.n
dt = job.DT_PER_CELL * dx
side, pad = job.WIDTH / 2 + 4 * dx, 4 * dx  # Genesis keeps three cells at its box's sides free
scene = gs.Scene(
    sim_options=gs.options.SimOptions(dt=dt * SUBSTEPS, substeps=SUBSTEPS, gravity=(0, 0, -job.GRAVITY)),
    mpm_options=gs.options.MPMOptions(
        grid_density=1 / dx,
        particle_size=dx / 2,
        lower_bound=(-side, -side, -pad),
        upper_bound=(side, side, job.HEIGHT + pad),
    ),
    show_viewer=False,
)
floor = gs.materials.Rigid(needs_coup=True, coup_friction=job.FLOOR_FRICTION)
scene.add_entity(gs.morphs.Plane(pos=(0, 0, 0)), material=floor)
half = job.SIDE / 2
sand = scene.add_entity(
    material=gs.materials.MPM.Sand(E=job.E, nu=job.NU, rho=job.RHO, friction_angle=job.PHI_DEG, sampler="regular"),
    morph=gs.morphs.Box(lower=(-half, -half, 0), upper=(half, half, job.SIDE)),
)
scene.build(n_envs=0)


def advance(substeps: int) -> None:
    for _ in range(substeps // SUBSTEPS):
        scene.step()


def look() -> tuple[np.ndarray, np.ndarray]:
    state = sand.get_state()
    return tuple(np.asarray(t.detach().cpu()).reshape(-1, 3) for t in (state.pos, state.vel))


job.measure(
    a,
    {"code": "genesis"},
    dt=dt,
    grains=sand.n_particles,
    reset=scene.reset,
    advance=advance,
    look=look,
    stride=SUBSTEPS,
)
