"""The sand column in Newton 1.8's implicit MPM on the CPU: rigid-plastic grains, friction tan(phi), few long steps.

python -m benchmarks.peers.newton_column --n 20 --tend 0.1 --dt 0.004166667
"""

import math

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverImplicitMPM

from benchmarks import job

parser = job.parser(__doc__ or "")
parser.add_argument("--dt", type=float, default=1 / 240, help="s")
a = parser.parse_args()
wp.config.log_level = wp.LOG_ERROR
wp.set_device("cpu")

dx, h = job.SIDE / a.n, job.SIDE / (2 * a.n)
builder = newton.ModelBuilder()
SolverImplicitMPM.register_custom_attributes(builder)
builder.add_particle_grid(
    pos=wp.vec3((h - job.SIDE) / 2, (h - job.SIDE) / 2, h / 2),
    rot=wp.quat_identity(),
    vel=wp.vec3(0.0),
    dim_x=2 * a.n,
    dim_y=2 * a.n,
    dim_z=2 * a.n,
    cell_x=h,
    cell_y=h,
    cell_z=h,
    mass=job.RHO * h**3,
    jitter=0.0,
    radius_mean=h / 2,
    custom_attributes={
        "mpm:young_modulus": 1e15,  # Newton's default: rigid until it yields
        "mpm:poisson_ratio": job.NU,
        "mpm:friction": math.tan(math.radians(job.PHI_DEG)),
        "mpm:yield_pressure": 1e12,
        "mpm:tensile_yield_ratio": 0.0,
    },
)
builder.add_ground_plane(cfg=newton.ModelBuilder.ShapeConfig(mu=job.FLOOR_FRICTION))
model = builder.finalize(device="cpu")
model.set_gravity((0.0, 0.0, -job.GRAVITY))
config = SolverImplicitMPM.Config()
config.voxel_size = dx
config.grid_type = "sparse"
now: list = []


def reset() -> None:
    now[:] = model.state(), model.state(), SolverImplicitMPM(model, config=config)


def advance(steps: int) -> None:
    before, after, solver = now
    for _ in range(steps):
        solver.step(before, after, None, None, a.dt)
        solver.project_outside(after, after, a.dt)
        before, after = after, before
    now[:2] = before, after


job.measure(
    a,
    {"code": f"newton implicit, dt 1/{round(1 / a.dt)}"},
    dt=a.dt,
    grains=model.particle_count,
    reset=reset,
    advance=advance,
    look=lambda: (np.asarray(now[0].particle_q.numpy()), np.asarray(now[0].particle_qd.numpy())),
)
