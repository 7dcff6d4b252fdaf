"""The box drop in Newton 1.8 on the CPU: implicit MPM coupled with its rigid solver XPBD by lagged proxies.

    python -m benchmarks.peers.newton_box --iterations 4

One iteration is Newton's default.
"""

import argparse
import json
import math
import time

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverImplicitMPM, SolverXPBD
from newton.solvers.experimental.coupled import SolverCoupledProxy

from benchmarks import box, job

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--iterations", type=int, default=1, help="coupling passes per step")
parser.add_argument("--dt", type=float, default=0.01, help="s")
parser.add_argument("--tend", type=float, default=box.DURATION, help="s")
a = parser.parse_args()
wp.config.log_level = wp.LOG_ERROR
wp.set_device("cpu")

h, half = box.DX / 2, box.BED[0] / 2
cells = [round(side / h) for side in box.BED]
builder = newton.ModelBuilder()
SolverImplicitMPM.register_custom_attributes(builder)
body = builder.add_body(xform=wp.transform(wp.vec3(0.0, 0.0, box.BED[2] + box.DROP + box.HALF[2]), wp.quat_identity()))
rough = newton.ModelBuilder.ShapeConfig(mu=box.FRICTION, density=job.RHO)
builder.add_shape_box(body, hx=box.HALF[0], hy=box.HALF[1], hz=box.HALF[2], cfg=rough)
builder.add_ground_plane(cfg=newton.ModelBuilder.ShapeConfig(mu=job.FLOOR_FRICTION))
for axis in range(2):
    for side in (-1, 1):
        centre, size = [0.0, 0.0, 0.3], [half + 0.2, half + 0.2, 0.3]
        centre[axis], size[axis] = side * (half + 0.1), 0.1
        builder.add_shape_box(
            -1,
            xform=wp.transform(wp.vec3(*centre), wp.quat_identity()),
            hx=size[0],
            hy=size[1],
            hz=size[2],
            cfg=newton.ModelBuilder.ShapeConfig(mu=0.0),
        )
builder.add_particle_grid(
    pos=wp.vec3(h / 2 - half, h / 2 - half, h / 2),
    rot=wp.quat_identity(),
    vel=wp.vec3(0.0),
    dim_x=cells[0],
    dim_y=cells[1],
    dim_z=cells[2],
    cell_x=h,
    cell_y=h,
    cell_z=h,
    mass=job.RHO * h**3,
    jitter=0.0,
    radius_mean=h / 2,
    custom_attributes={
        "mpm:friction": math.tan(math.radians(job.PHI_DEG)),
        "mpm:yield_pressure": 1e12,
        "mpm:tensile_yield_ratio": 0.0,
    },
)
model = builder.finalize(device="cpu")
model.set_gravity((0.0, 0.0, -job.GRAVITY))
config = SolverImplicitMPM.Config()
config.voxel_size = box.DX
config.grid_type = "sparse"
config.max_iterations, config.strain_basis, config.critical_fraction = 50, "P0", 0.0  # as in Newton's own example
solver = SolverCoupledProxy(
    model=model,
    entries=[
        SolverCoupledProxy.Entry(
            name="rigid", solver=lambda v: SolverXPBD(model=v), bodies=[body], joints=list(range(model.joint_count))
        ),
        SolverCoupledProxy.Entry(
            name="mpm",
            solver=lambda v: SolverImplicitMPM(model=v, config=config),
            particles=list(range(model.particle_count)),
            in_place=True,
        ),
    ],
    coupling=SolverCoupledProxy.Config(
        proxies=[
            SolverCoupledProxy.Proxy(
                source="rigid", destination="mpm", bodies=[body], mode="lagged", collision_pipeline=lambda _: None
            )
        ],
        iterations=a.iterations,
    ),
)
state, control = model.state(), model.control()
newton.eval_fk(model, model.joint_q, model.joint_qd, state)
pipeline = newton.CollisionPipeline(model, soft_contact_max=0)
contacts = pipeline.contacts()


def step() -> float:
    """One step; returns the box's upward speed, m/s."""
    state.clear_forces()
    pipeline.collide(state, contacts)
    solver.step(state, state, control, contacts, a.dt)
    return float(state.body_qd.numpy()[0][2])


speeds = [step()]  # compiles
first, steps = job.age(), round(a.tend / a.dt) - 1
cpu = time.process_time()
speeds += [step() for _ in range(steps)]
cpu = time.process_time() - cpu
t = steps * a.dt
record = {
    "code": f"newton implicit, {a.iterations} coupling passes",
    "grains": model.particle_count,
    "t_sim": round(t, 4),
    "cpu_per_sim_s": round(cpu / t, 2),
    "t_first": round(first, 2),
    "finite": bool(np.isfinite(speeds).all()),
    "rss_mb": job.peak_mb(),
}
print(json.dumps(record | (box.verdict(speeds, a.dt) if a.tend >= box.DURATION else {})), flush=True)
