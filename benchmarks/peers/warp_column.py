"""The sand column in NVIDIA Warp on the CPU: explicit MLS-MPM on a dense grid, wp.svd3, f32. Warp's CPU runs serially.

python -m benchmarks.peers.warp_column --n 20 --tend 0.01
"""

import math

import numpy as np
import warp as wp

from benchmarks import job

a = job.parser(__doc__ or "").parse_args()
wp.config.log_level = wp.LOG_ERROR
wp.config.enable_backward = False
wp.init()

FLOOR = wp.constant(3)  # nodes below the floor
dx = job.SIDE / a.n
dt = job.DT_PER_CELL * dx
nx, nz = round(job.WIDTH / dx) + 8, round(job.HEIGHT / dx) + 11
grains = 8 * a.n**3
lam = job.E * job.NU / ((1 + job.NU) * (1 - 2 * job.NU))
mu = job.E / (2 * (1 + job.NU))
sin_phi = math.sin(math.radians(job.PHI_DEG))
LAM, MU, DX, DT = (wp.constant(float(number)) for number in (lam, mu, dx, dt))
CONE = wp.constant((3 * lam + 2 * mu) / (2 * mu) * math.sqrt(2 / 3) * 2 * sin_phi / (3 - sin_phi))
FORCE = wp.constant(dt * 4 / (dx * job.RHO))
GRAVITY, FRICTION = wp.constant(job.GRAVITY), wp.constant(job.FLOOR_FRICTION)


@wp.func
def weights(f: float):
    return wp.vec3(0.5 * (1.5 - f) * (1.5 - f), 0.75 - (f - 1.0) * (f - 1.0), 0.5 * (f - 0.5) * (f - 0.5))


@wp.kernel
def p2g(
    x: wp.array(dtype=wp.vec3),
    v: wp.array(dtype=wp.vec3),
    C: wp.array(dtype=wp.mat33),
    F: wp.array(dtype=wp.mat33),
    gained: wp.array(dtype=float),
    grid: wp.array3d(dtype=wp.vec4),
):
    p = wp.tid()
    U, s, V = wp.svd3(F[p] + DT * (C[p] * F[p]))
    eps = wp.vec3(
        wp.log(wp.max(wp.abs(s[0]), 1.0e-4)),
        wp.log(wp.max(wp.abs(s[1]), 1.0e-4)),
        wp.log(wp.max(wp.abs(s[2]), 1.0e-4)),
    )
    tr = eps[0] + eps[1] + eps[2] + gained[p]
    deviator = eps - wp.vec3(tr / 3.0, tr / 3.0, tr / 3.0)
    size = wp.length(deviator) + 1.0e-20
    h = wp.vec3(0.0, 0.0, 0.0)
    gained[p] = wp.max(tr, 0.0)
    if tr < 0.0:
        h = eps - wp.max(0.0, size + CONE * tr) / size * deviator
    F[p] = U * wp.diag(wp.vec3(wp.exp(h[0]), wp.exp(h[1]), wp.exp(h[2]))) * wp.transpose(V)
    pressure = LAM * (h[0] + h[1] + h[2])
    tau = U * wp.diag(2.0 * MU * h + wp.vec3(pressure, pressure, pressure)) * wp.transpose(U)
    A = DX * C[p] - FORCE * tau
    at = x[p] / DX
    i0 = int(at[0] - 0.5)
    j0 = int(at[1] - 0.5)
    k0 = int(at[2] - 0.5)
    f = wp.vec3(at[0] - float(i0), at[1] - float(j0), at[2] - float(k0))
    wx = weights(f[0])
    wy = weights(f[1])
    wz = weights(f[2])
    for i in range(3):
        for j in range(3):
            for k in range(3):
                q = v[p] + A * (wp.vec3(float(i), float(j), float(k)) - f)
                wp.atomic_add(grid, i0 + i, j0 + j, k0 + k, wx[i] * wy[j] * wz[k] * wp.vec4(q[0], q[1], q[2], 1.0))


@wp.kernel
def move_grid(grid: wp.array3d(dtype=wp.vec4)):
    i, j, k = wp.tid()
    q = grid[i, j, k]
    if q[3] > 0.0:
        u = wp.vec3(q[0] / q[3], q[1] / q[3], q[2] / q[3] - GRAVITY * DT)
        if k <= FLOOR and u[2] < 0.0:
            along = wp.sqrt(u[0] * u[0] + u[1] * u[1]) + 1.0e-20
            keep = wp.max(0.0, 1.0 + FRICTION * u[2] / along)
            u = wp.vec3(u[0] * keep, u[1] * keep, 0.0)
        grid[i, j, k] = wp.vec4(u[0], u[1], u[2], q[3])


@wp.kernel
def g2p(
    x: wp.array(dtype=wp.vec3),
    v: wp.array(dtype=wp.vec3),
    C: wp.array(dtype=wp.mat33),
    grid: wp.array3d(dtype=wp.vec4),
):
    p = wp.tid()
    at = x[p] / DX
    i0 = int(at[0] - 0.5)
    j0 = int(at[1] - 0.5)
    k0 = int(at[2] - 0.5)
    f = wp.vec3(at[0] - float(i0), at[1] - float(j0), at[2] - float(k0))
    wx = weights(f[0])
    wy = weights(f[1])
    wz = weights(f[2])
    new_v = wp.vec3()
    new_C = wp.mat33()
    for i in range(3):
        for j in range(3):
            for k in range(3):
                q = grid[i0 + i, j0 + j, k0 + k]
                u = wx[i] * wy[j] * wz[k] * wp.vec3(q[0], q[1], q[2])
                new_v += u
                new_C += (4.0 / DX) * wp.outer(u, wp.vec3(float(i), float(j), float(k)) - f)
    v[p] = new_v
    C[p] = new_C
    x[p] = x[p] + DT * new_v


corner = np.array([nx * dx / 2, nx * dx / 2, 3 * dx])
grid = wp.zeros((nx, nx, nz), dtype=wp.vec4, device="cpu")
now: dict[str, wp.array] = {}


def reset() -> None:
    now["x"] = wp.array((job.lattice(a.n) + corner).astype(np.float32), dtype=wp.vec3, device="cpu")
    now["v"] = wp.zeros(grains, dtype=wp.vec3, device="cpu")
    now["C"] = wp.zeros(grains, dtype=wp.mat33, device="cpu")
    now["F"] = wp.array(np.tile(np.eye(3, dtype=np.float32), (grains, 1, 1)), dtype=wp.mat33, device="cpu")
    now["gained"] = wp.zeros(grains, dtype=float, device="cpu")


def advance(substeps: int) -> None:
    x, v, C, F, gained = now.values()
    for _ in range(substeps):
        grid.zero_()
        wp.launch(p2g, grains, [x, v, C, F, gained, grid], device="cpu")
        wp.launch(move_grid, grid.shape, [grid], device="cpu")
        wp.launch(g2p, grains, [x, v, C, grid], device="cpu")


job.measure(
    a,
    {"code": "warp svd"},
    dt=dt,
    grains=grains,
    reset=reset,
    advance=advance,
    look=lambda: (now["x"].numpy() - corner, now["v"].numpy()),
)
