"""The constitutive models once more, from a float64 SVD of F: what the library is held against.

Written from the papers for F (n, 3, 3), with plain numbers: no b, no component rows, no guards.
"""

from typing import Any, NamedTuple

import numpy as np

from mpm_env.mpm.materials import Material

DILATION_CAP = 0.1  # largest volume that sand remembers


class Answer(NamedTuple):
    """What a return mapping gives for n grains."""

    b: np.ndarray  # (n, 3, 3) elastic left Cauchy-Green strain
    history: np.ndarray  # (k, n)
    tau: np.ndarray  # (n, 3, 3) Pa
    excess: np.ndarray  # (n,) how far the answer lies outside what the material bears, over the modulus; <= 0 inside


def numbers(material: Material) -> dict[str, float]:
    return {k: float(v) for k, v in vars(material).items() if not isinstance(v, str | bool)}


def lame(E: float, nu: float) -> tuple[float, float]:
    return E * nu / ((1 + nu) * (1 - 2 * nu)), E / (2 * (1 + nu))


def around(U: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Symmetric tensors (n, 3, 3) with principal axes U and principal values (n, 3)."""
    return np.einsum("nik,nk,njk->nij", U, values, U)


def elastic(F: np.ndarray, history: np.ndarray, material: Material) -> Answer:
    given = numbers(material)
    U, S, _ = np.linalg.svd(F)
    lam, mu = lame(given["E"], given["nu"])
    eps = np.log(S)
    tau = 2 * mu * eps + lam * eps.sum(axis=1, keepdims=True)
    return Answer(around(U, S**2), history, around(U, tau), np.zeros(len(F)))


def sand(F: np.ndarray, history: np.ndarray, material: Material, *, unshifted: bool = False) -> Answer:
    """K16 and T17. `unshifted` is the trap of two published codes: a deviator that forgets the volume correction."""
    given = numbers(material)
    U, S, _ = np.linalg.svd(F)
    lam, mu = lame(given["E"], given["nu"])
    sin, K = np.sin(given["friction"]), lam + 2 * mu / 3
    plane_strain = vars(material)["friction_fit"] == "plane_strain"
    alpha = np.sqrt(2) * sin / 3 if plane_strain else np.sqrt(2 / 3) * 2 * sin / (3 - sin)
    tip = given["cohesion"] / np.tan(given["friction"]) / K
    vc = history[0][:, None]
    log_S = np.log(S)
    eps = log_S + vc / 3
    tr = eps.sum(axis=1, keepdims=True)
    dev = (log_S if unshifted else eps) - tr / 3
    norm = np.linalg.norm(dev, axis=1, keepdims=True)
    dg = norm + (3 * lam + 2 * mu) / (2 * mu) * (tr - tip) * alpha
    cone = (log_S if unshifted else eps) - dg * dev / np.where(norm > 0, norm, 1)
    H = np.where(tr >= tip, tip / 3, np.where(dg > 0, cone, eps))
    gained = np.clip(vc[:, 0] + log_S.sum(axis=1) - H.sum(axis=1), -DILATION_CAP, DILATION_CAP)
    tau = 2 * mu * H + lam * H.sum(axis=1, keepdims=True)
    s = tau - tau.mean(axis=1, keepdims=True)
    excess = (np.linalg.norm(s, axis=1) + alpha * (tau.sum(axis=1) - 3 * K * tip)) / given["E"]
    return Answer(around(U, np.exp(2 * H)), gained[None], around(U, tau), excess)


def snow(F: np.ndarray, history: np.ndarray, material: Material) -> Answer:
    """S13 section 5 and eq. 6, hardening held at Jp_min."""
    given = numbers(material)
    U, S, _ = np.linalg.svd(F)
    lam, mu = lame(given["E"], given["nu"])
    s = np.clip(S, 1 - given["theta_c"], 1 + given["theta_s"])
    lnJp = history[0] + np.log(S / s).sum(axis=1)
    h = np.exp(given["xi"] * (1 - np.maximum(np.exp(lnJp), given["Jp_min"])))[:, None]
    J = s.prod(axis=1, keepdims=True)
    tau = h * (2 * mu * (s - 1) * s + lam * (J - 1) * J)
    excess = np.max(np.maximum(s - 1 - given["theta_s"], 1 - given["theta_c"] - s), axis=1)
    return Answer(around(U, s**2), lnJp[None], around(U, tau), excess)


def hencky(F: np.ndarray, material: Material) -> tuple[dict[str, float], np.ndarray, np.ndarray, np.ndarray, float]:
    """Parameters with lam, mu and K, axes (n, 3, 3), mean log strain (n, 1), stress deviator (n, 3) and K."""
    given = numbers(material)
    U, S, _ = np.linalg.svd(F)
    given["lam"], given["mu"] = lame(given["E"], given["nu"])
    eps = np.log(S)
    mean = eps.mean(axis=1, keepdims=True)
    return given, U, mean, 2 * given["mu"] * (eps - mean), given["lam"] + 2 * given["mu"] / 3


def answered(U: np.ndarray, given: dict, history: np.ndarray, p: np.ndarray, s: np.ndarray, excess: Any) -> Answer:
    """The answer of Hencky elasticity with pressure p (n, 1) and stress deviator s (n, 3), both in Pa."""
    K = given["lam"] + 2 * given["mu"] / 3
    eps = s / (2 * given["mu"]) - p / (3 * K)
    return Answer(around(U, np.exp(2 * eps)), history, around(U, s - p), np.asarray(excess) / given["E"])


def von_mises(F: np.ndarray, history: np.ndarray, material: Material) -> Answer:
    """Simo & Hughes box 3.1 in terms of the uniaxial stress q."""
    g, U, mean, s, K = hencky(F, material)
    q = np.sqrt(1.5) * np.linalg.norm(s, axis=1)
    strain = np.maximum(q - g["yield_stress"] - g["hardening"] * history[0], 0) / (3 * g["mu"] + g["hardening"])
    kept = 1 - 3 * g["mu"] * strain / q
    excess = kept * q - g["yield_stress"] - g["hardening"] * (history[0] + strain)
    return answered(U, g, (history[0] + strain)[None], -3 * K * mean, s * kept[:, None], excess)


def herschel_bulkley(F: np.ndarray, history: np.ndarray, material: Material) -> Answer:
    """Without hurry: what is above the yield stress is gone."""
    g, U, mean, s, K = hencky(F, material)
    shear = np.linalg.norm(s, axis=1) / np.sqrt(2)
    kept = np.minimum(g["yield_stress"] / shear, 1)
    return answered(U, g, history, -3 * K * mean, s * kept[:, None], kept * shear - g["yield_stress"])


def mu_i(F: np.ndarray, history: np.ndarray, material: Material) -> Answer:
    """Without hurry: a cone with the friction at rest, which touches nobody in tension."""
    g, U, mean, s, K = hencky(F, material)
    vc = history[0][:, None]
    p = -K * (3 * mean + vc)
    shear = np.linalg.norm(s, axis=1, keepdims=True) / np.sqrt(2)
    pressed = p > 0
    kept = np.where(pressed, np.minimum(g["mu_s"] * p / np.maximum(shear, 1e-300), 1), 0)
    gained = np.where(pressed, 0, vc + 3 * mean)[:, 0]  # what pressed grains had to close is in their strain
    p = np.where(pressed, p, 0)
    excess = (kept * shear - g["mu_s"] * p)[:, 0]
    return answered(U, g, np.clip(gained, -DILATION_CAP, DILATION_CAP)[None], p, s * kept, excess)


def cam_clay(F: np.ndarray, history: np.ndarray, material: Material) -> Answer:
    """G18, grain by grain: the tips, and where the line from the trial to the ellipse's middle enters by bisection."""
    g, U, mean, s, K = hencky(F, material)
    beta, M = g["beta"], g["M"]
    p0 = K * np.sinh(g["xi"] * np.maximum(g["compaction"] - history[0], 0))

    def outside(q: Any, p: Any, p0: Any) -> Any:
        return (1 + 2 * beta) * q**2 + M**2 * (p + beta * p0) * (p - p0)

    p_new, kept, flow, excess = (np.zeros(len(F)) for _ in range(4))
    for i, (p, q, top) in enumerate(
        zip(-3 * K * mean[:, 0], np.sqrt(1.5) * np.linalg.norm(s, axis=1), p0, strict=True)
    ):
        p_new[i], kept[i] = p, 1
        if p > top or p < -beta * top:
            p_new[i] = top if p > top else -beta * top
            kept[i], flow[i] = 0, (p_new[i] - p) / K
        elif outside(q, p, top) > 0:
            kept[i] = M * np.sqrt(-(p + beta * top) * (p - top) / (1 + 2 * beta)) / q
            middle, low, high = (1 - beta) / 2 * top, 0.0, 1.0
            for _ in range(60):
                t = (low + high) / 2
                low, high = (t, high) if outside(t * q, middle + t * (p - middle), top) < 0 else (low, t)
            flow[i] = (middle + low * (p - middle) - p) / K
        excess[i] = np.sqrt(max(outside(kept[i] * q, p_new[i], top), 0)) - 1e-7 * top  # a root of round-off
    return answered(U, g, (history[0] + flow)[None], p_new[:, None], s * kept[:, None], excess)


ORACLES = {
    "elastic": elastic,
    "sand": sand,
    "snow": snow,
    "von_mises": von_mises,
    "herschel_bulkley": herschel_bulkley,
    "mu_i": mu_i,
    "cam_clay": cam_clay,
}


def rows(t: np.ndarray, d: int) -> np.ndarray:
    """Symmetric tensors (n, 3, 3) as the library's component rows (s, n)."""
    if d == 2:
        return np.stack([t[:, 0, 0], t[:, 1, 1], t[:, 2, 2], t[:, 0, 1]])
    return np.stack([t[:, 0, 0], t[:, 1, 1], t[:, 2, 2], t[:, 1, 2], t[:, 0, 2], t[:, 0, 1]])


def tensors(r: np.ndarray) -> np.ndarray:
    """Component rows (s, n) as symmetric tensors (n, 3, 3) in float64."""
    r = np.asarray(r, np.float64)
    zero = np.zeros_like(r[0])
    yz, xz, xy = (zero, zero, r[3]) if len(r) == 4 else (r[3], r[4], r[5])
    return np.moveaxis(np.array([[r[0], xy, xz], [xy, r[1], yz], [xz, yz, r[2]]]), -1, 0)


def rotations(n: int, d: int, rng: np.random.Generator) -> np.ndarray:
    """Random proper rotations (n, 3, 3); in plane strain about the third axis."""
    if d == 2:
        a = rng.uniform(0, 2 * np.pi, n)
        Q = np.zeros((n, 3, 3))
        Q[:, 0, 0], Q[:, 0, 1], Q[:, 1, 0], Q[:, 1, 1], Q[:, 2, 2] = np.cos(a), -np.sin(a), np.sin(a), np.cos(a), 1
        return Q
    Q = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]
    return Q * np.sign(np.linalg.det(Q))[:, None, None]


def turned(Q: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Q t Q^T, (n, 3, 3)."""
    return np.einsum("nij,njk,nlk->nil", Q, t, Q)
