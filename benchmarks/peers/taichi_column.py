"""The sand column in Taichi 1.7.4, as an expert would write it: explicit MLS-MPM on a dense grid, f32, one core.

    python -m benchmarks.peers.taichi_column --n 20 --tend 0.01 --stress series

--stress svd keeps F and calls ti.svd, as Taichi's own examples do; series keeps b - I and needs no decomposition.
"""

import math

import numpy as np
import taichi as ti

from benchmarks import job

parser = job.parser(__doc__ or "")
parser.add_argument("--stress", default="svd", choices=("svd", "series"))
a = parser.parse_args()
ti.init(arch=ti.cpu, default_fp=ti.f32, cpu_max_num_threads=1, offline_cache=False, log_level=ti.ERROR)

MARGIN, FLOOR = 4, 3  # nodes beside the box, and below the floor
dx = job.SIDE / a.n
dt = job.DT_PER_CELL * dx
NX, NZ = round(job.WIDTH / dx) + 2 * MARGIN, round(job.HEIGHT / dx) + FLOOR + 8
grains = 8 * a.n**3
lam = job.E * job.NU / ((1 + job.NU) * (1 - 2 * job.NU))
mu = job.E / (2 * (1 + job.NU))
sin_phi = math.sin(math.radians(job.PHI_DEG))
cone = (3 * lam + 2 * mu) / (2 * mu) * math.sqrt(2 / 3) * 2 * sin_phi / (3 - sin_phi)
force = dt * 4 / (dx * job.RHO)  # of a unit of stress on a grain of unit mass

x = ti.Vector.field(3, ti.f32)
v = ti.Vector.field(3, ti.f32)
C = ti.Matrix.field(3, 3, ti.f32)
S = ti.Matrix.field(3, 3, ti.f32)  # F, or b - I
gained = ti.field(ti.f32)  # volume to be closed before stress
ti.root.dense(ti.i, grains).place(x, v, C, S, gained)
grid = ti.Vector.field(4, ti.f32, shape=(NX, NX, NZ))  # momentum, then velocity, and mass


@ti.func
def stress_by_svd(p):
    U, sigma, V = ti.svd((ti.Matrix.identity(ti.f32, 3) + dt * C[p]) @ S[p])
    eps = ti.Vector([ti.log(ti.max(ti.abs(sigma[i, i]), 1e-4)) for i in ti.static(range(3))])
    tr = eps.sum() + gained[p]
    deviator = eps - tr / 3
    size = deviator.norm() + 1e-20
    h = ti.Vector([0.0, 0.0, 0.0])
    gained[p] = ti.max(tr, 0.0)
    if tr < 0:
        h = eps - ti.max(0.0, size + cone * tr) / size * deviator
    stretch = ti.exp(h)
    tau = 2 * mu * h + lam * h.sum()
    S[p] = U @ ti.Matrix([[stretch[0], 0, 0], [0, stretch[1], 0], [0, 0, stretch[2]]]) @ V.transpose()
    return U @ ti.Matrix([[tau[0], 0, 0], [0, tau[1], 0], [0, 0, tau[2]]]) @ U.transpose()


@ti.func
def stress_by_series(p):  # logarithm and exponential to fourth order: for strains below some 0.05
    D, e = dt * C[p], S[p]
    M = D + e + D @ e
    e = M + D.transpose() + M @ D.transpose()
    e2 = e @ e
    h = 0.5 * (e - 0.5 * e2 + e2 @ (e / 3 - 0.25 * e2))
    one = ti.Matrix.identity(ti.f32, 3)
    tr = h.trace() + gained[p]
    deviator = h - (tr / 3) * one
    size = ti.sqrt((deviator * deviator).sum()) + 1e-20
    gained[p] = ti.max(tr, 0.0)
    if tr >= 0:
        h = h * 0.0
    else:
        h = h - ti.max(0.0, size + cone * tr) / size * deviator
    h2 = h @ h
    S[p] = 2 * h + 2 * h2 + h2 @ ((4 / 3) * h + (2 / 3) * h2)
    return 2 * mu * h + lam * h.trace() * one


stress = stress_by_series if a.stress == "series" else stress_by_svd


@ti.func
def weights(f):
    return [0.5 * (1.5 - f) ** 2, 0.75 - (f - 1) ** 2, 0.5 * (f - 0.5) ** 2]


@ti.kernel
def clear():
    for node in ti.grouped(grid):
        grid[node] = ti.Vector.zero(ti.f32, 4)


@ti.kernel
def p2g():
    ti.loop_config(serialize=True)  # on one core, atomic adds would only cost
    for p in range(grains):
        A = dx * C[p] - force * stress(p)
        s = x[p] / dx
        base = ti.cast(s - 0.5, ti.i32)
        f = s - base.cast(ti.f32)
        w = weights(f)
        for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
            q = v[p] + A @ (ti.Vector([i, j, k]).cast(ti.f32) - f)
            grid[base + ti.Vector([i, j, k])] += w[i][0] * w[j][1] * w[k][2] * ti.Vector([q[0], q[1], q[2], 1.0])


@ti.kernel
def move_grid():
    for i, j, k in grid:
        q = grid[i, j, k]
        if q[3] > 0:
            u = ti.Vector([q[0], q[1], q[2]]) / q[3]
            u[2] -= job.GRAVITY * dt
            if k <= FLOOR and u[2] < 0:
                along = ti.sqrt(u[0] ** 2 + u[1] ** 2) + 1e-20
                keep = ti.max(0.0, 1 + job.FLOOR_FRICTION * u[2] / along)
                u = ti.Vector([u[0] * keep, u[1] * keep, 0.0])
            grid[i, j, k] = ti.Vector([u[0], u[1], u[2], q[3]])


@ti.kernel
def g2p():
    for p in x:
        s = x[p] / dx
        base = ti.cast(s - 0.5, ti.i32)
        f = s - base.cast(ti.f32)
        w = weights(f)
        new_v, new_C = ti.Vector.zero(ti.f32, 3), ti.Matrix.zero(ti.f32, 3, 3)
        for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
            q = grid[base + ti.Vector([i, j, k])]
            u = w[i][0] * w[j][1] * w[k][2] * ti.Vector([q[0], q[1], q[2]])
            new_v += u
            new_C += 4 / dx * u.outer_product(ti.Vector([i, j, k]).cast(ti.f32) - f)
        v[p], C[p] = new_v, new_C
        x[p] += dt * new_v


corner = np.array([NX * dx / 2, NX * dx / 2, FLOOR * dx])


def reset() -> None:
    x.from_numpy((job.lattice(a.n) + corner).astype(np.float32))
    v.fill(0)
    C.fill(0)
    gained.fill(0)
    S.from_numpy(np.tile(np.eye(3, dtype=np.float32) * (a.stress == "svd"), (grains, 1, 1)))
    ti.sync()


def advance(substeps: int) -> None:
    for _ in range(substeps):
        clear()
        p2g()
        move_grid()
        g2p()
    ti.sync()


job.measure(
    a,
    {"code": f"taichi {a.stress}"},
    dt=dt,
    grains=grains,
    reset=reset,
    advance=advance,
    look=lambda: (x.to_numpy() - corner, v.to_numpy()),
)
