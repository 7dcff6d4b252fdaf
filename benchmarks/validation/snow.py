"""Snow: what packs it, against the closed form, and balls of it thrown on a floor.

python -m benchmarks.validation.snow [--quick]
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from benchmarks import case, job, part
from benchmarks.case import Case, at_least, at_most
from benchmarks.validation import PLOTS, flows
from benchmarks.validation.flows import Clock, block, flow
from mpm_env import State
from mpm_env.plot import Series, plot

# Table 2 of Stomakhin et al. 2013; hardening stops late, so that the closed form holds in all of the range.
SNOW = {"E": 1.4e5, "nu": 0.2, "rho": 400.0, "theta_c": 0.025, "theta_s": 0.0075, "xi": 10.0, "Jp_min": 0.6}
S13 = "Stomakhin et al. 2013"
DEEPEST = 30e3  # Pa, on the snow at the bottom
HIGH = 0.2  # m
SPINS_UP = 0.6  # s: thirty times as long as a wave through the snow takes


def bears(J: Any) -> Any:
    """Vertical stress, Pa, of snow confined to a volume ratio J once it yields, times J: Kirchhoff.

    The axial elastic stretch is 1 - theta_c, and J_P = J / (1 - theta_c) hardens it (S13 eq. 2 and 6).
    """
    E, nu = SNOW["E"], SNOW["nu"]
    lam, mu = E * nu / ((1 + nu) * (1 - 2 * nu)), E / (2 * (1 + nu))
    s = 1 - SNOW["theta_c"]
    return np.exp(SNOW["xi"] * (1 - np.asarray(J) / s)) * (2 * mu + lam) * (1 - s) * s


class Packed(NamedTuple):
    """Snow under its own weight in a centrifuge, in layers of equal mass two cells high at first, from below."""

    weight: np.ndarray  # (k,) Pa, of the snow above the middle of a layer
    J: np.ndarray  # (k,) volume ratio of a layer
    tops: np.ndarray  # height over the first, as gravity grew
    health: int
    cpu_s: float

    @property
    def off(self) -> np.ndarray:
        """Stress of the closed form at a layer's volume over the weight on it, less one, of layers well past yield."""
        yielded = self.weight > 1.5 * bears(1 - SNOW["theta_c"])
        return bears(self.J[yielded]) / self.J[yielded] / self.weight[yielded] - 1


def pack(across: int, **changes: Any) -> Packed:
    """Snow so many cells high between smooth walls, at gravity that grows slowly and then stays."""
    cell, parts = HIGH / across, 6
    scene = flow(
        {"model": "snow"} | SNOW | changes,
        (4 * cell, HIGH + 2 * cell),
        cell,
        [block((0, 0), (4 * cell, HIGH))],
        {},
        gravity=(0, -DEEPEST / (SNOW["rho"] * HIGH)),
    )
    state, tops, clock = flows.start(scene), [], Clock()
    for k in range(parts):
        state = flows.go(scene, state, SPINS_UP / parts, weight=(k / parts, (k + 1) / parts))
        tops.append(flows.places(scene, state)[0][1].max() / HIGH)
    state = flows.go(scene, state, SPINS_UP / parts)
    (_, z), m = flows.places(scene, state)
    layers = np.array_split(np.argsort(z), across // 2)
    below = np.cumsum([m[some].sum() for some in layers]) / m.sum()
    ln_J = ln_volume(state)
    J = np.exp([ln_J[some].mean() for some in layers])
    return Packed(DEEPEST * (1 - below + below[0] / 2), J, np.array(tops), int(state.health), clock.cpu_s)


def ln_volume(state: State) -> np.ndarray:
    """Logarithm (n,) of the volume ratio of grains, elastic and plastic."""
    here = np.asarray(state.grains.m) > 0
    xx, zz, yy, xz = np.asarray(state.grains.e, np.float64)[:, here]
    plastic = np.asarray(state.grains.history, np.float64)[0, here]
    return 0.5 * np.log(((1 + xx) * (1 + zz) - xz**2) * (1 + yy)) + plastic


RADIUS, ACROSS = 0.04, 20  # m, and cells across a ball
SPEEDS = (0.5, 1.0, 3.0, 10.0, 30.0)  # m/s
APART = 0.75  # cells, half as far again as neighbours are: pieces farther apart than that are two


class Thrown(NamedTuple):
    """A ball of snow that met the floor."""

    largest: float  # share of the mass in the largest piece
    wide: float  # over the diameter
    high: float  # over the diameter
    denser: float  # share of the mass that is more than 2 % denser than before
    kinetic: float  # share of the energy it came with
    J_P: tuple[float, float]  # least and most of all grains
    health: int
    cpu_s: float


def throw(speed: float, across: int = ACROSS, *, ln_Jp: float = 0.0, **changes: Any) -> Thrown:
    """A ball of snow so many cells across, a cylinder in plane strain, thrown down on a floor it sticks to.

    ln_Jp is what its grains remember.
    """
    cell, wide, high = 2 * RADIUS / across, 20 * RADIUS, 5 * RADIUS
    ball = {"shape": "sphere", "centre": [wide / 2, 0.5, 1.2 * RADIUS], "radius": RADIUS, "velocity": [0, 0, -speed]}
    scene = flow({"model": "snow"} | SNOW | changes, (wide, high), cell, [ball], flows.STICK)
    state, clock = flows.start(scene), Clock()
    history = jnp.where(state.grains.m > 0, ln_Jp, state.grains.history)
    state = flows.go(scene, replace(state, grains=replace(state.grains, history=history)), 0.5)
    (x, z), m = flows.places(scene, state)
    here = np.asarray(state.grains.m) > 0
    v2 = (np.asarray(state.grains.v, np.float64)[:, here] ** 2).sum(axis=0)
    J_P = np.exp(np.asarray(state.grains.history, np.float64)[0, here])
    return Thrown(
        float(pieces(x, z, m, APART * cell).max()),
        float(np.ptp(x) / (2 * RADIUS)),
        float(np.ptp(z) / (2 * RADIUS)),
        float((np.exp(ln_volume(state)) < 0.98).mean()),
        float((m * v2).sum() / (m.sum() * speed**2)),
        (float(J_P.min()), float(J_P.max())),
        int(state.health),
        clock.cpu_s,
    )


def pieces(x: np.ndarray, z: np.ndarray, m: np.ndarray, gap: float) -> np.ndarray:
    """Shares of the mass in pieces of grains that hang together, each no farther than `gap` m from the next."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    i, j = cKDTree(np.stack([x, z], axis=-1)).query_pairs(gap, output_type="ndarray").T
    count, piece = connected_components(coo_matrix((np.ones(len(i)), (i, j)), (len(x), len(x))), directed=False)
    return np.bincount(piece, m, count) / m.sum()


FLOOR = "The layer on the floor; all others lie within 4 %"
FINER = "With twice the cells a ball falls apart at speeds at which it stuck: where it softens, nothing sets a width"


def packed(quick: bool) -> list[Case]:
    """The centrifuge."""
    across = 16 if quick else 32
    p, told = pack(across), f"{across} cells high"
    J = np.linspace(0.78, 0.97, 40)
    plot(
        PLOTS / "snow.png",
        "Confined snow under its own weight in a centrifuge",
        "volume ratio",
        "weight of the snow above, kPa",
        [
            Series("closed form", J, bears(J) / J / 1e3, joined=True),
            Series(f"here, {told}", p.J, p.weight / 1e3),
        ],
    )
    grows = float(np.diff(p.tops).max())
    mean, worst = float(np.sqrt(np.mean(p.off**2))), float(np.abs(p.off).max())
    kept = (told, p.cpu_s, p.health)
    return [
        Case("packed snow: closed form over weight, off by, rms", S13, 0.0, at_most(0.05), mean, *kept),
        Case("packed snow: closed form over weight, off by, worst", S13, 0.0, at_most(0.05), worst, *kept, note=FLOOR),
        Case("packed snow: largest rise of its top as weight grows", "it packs", 0, (-1.0, 0.0), grows, *kept),
    ]


def thrown(quick: bool) -> list[Case]:
    """Balls."""
    speeds = SPEEDS[::2] if quick else SPEEDS
    balls, told = {v: throw(v) for v in speeds}, f"{ACROSS} cells across"
    out = []
    for v, b in balls.items():
        kept, name = (told, b.cpu_s, b.health), f"ball at {v:g} m/s"
        out.append(Case(f"{name}: share of its energy left", "it rests", 0, at_most(1e-2), b.kinetic, *kept))
        if v <= 1:
            out.append(Case(f"{name}: largest piece", "it sticks", 1, at_least(0.99), b.largest, *kept))
            out.append(Case(f"{name}: width over before", "it stays a ball", 1, (0.95, 1.15), b.wide, *kept))
        if v == 3:
            out.append(Case(f"{name}: largest piece", "it breaks", 0, at_most(0.9), b.largest, *kept))
            out.append(Case(f"{name}: width over before", "it breaks", 4, at_least(2), b.wide, *kept))
    if not quick:
        finer = throw(1.0, 2 * ACROSS)
        kept = (f"{2 * ACROSS} cells across", finer.cpu_s, finer.health, FINER)
        out.append(Case("ball at 1 m/s: largest piece", "it sticks", 1, at_least(0.99), finer.largest, *kept))
    gain = float(np.diff([b.denser for b in balls.values()]).min())
    cpu_s, health = sum(b.cpu_s for b in balls.values()), int(np.bitwise_or.reduce([b.health for b in balls.values()]))
    name = "balls: least gain in denser snow from one speed to the next"
    out.append(Case(name, "a harder blow packs more", 0.1, at_least(0.01), gain, told, cpu_s, health))
    for past, ln_Jp in (("crushed to a tenth", np.log(0.1)), ("torn to twenty times", 3.0)):
        b = throw(10.0, ln_Jp=ln_Jp)
        name = f"ball {past} before: share of its energy left"
        out.append(Case(name, "it rests", 0, at_most(1e-2), b.kinetic, told, b.cpu_s, b.health))
    return out


def measure(quick: bool) -> dict[str, Any]:
    """All cases."""
    job.pin(1)
    return {"cases": case.say([*packed(quick), *thrown(quick)])}


if __name__ == "__main__":
    part.main("validation_snow", measure, __doc__)
