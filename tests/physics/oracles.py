"""The constitutive models once more, from a float64 SVD of F: what the library is held against.

Written from the papers for F (n, 3, 3), with plain numbers: no b, no component rows, no guards.
"""

from typing import NamedTuple

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
    alpha = np.sqrt(2 / 3) * 2 * sin / (3 - sin)
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


ORACLES = {"elastic": elastic, "sand": sand, "snow": snow}


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
