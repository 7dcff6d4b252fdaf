"""The continuum: a material point method (MPM) for sand, snow and elastic solids, in JAX.

Grains carry mass, velocity and strain; a regular grid carries forces. One substep scatters the grains to the
grid (p2g), moves the grid, gathers it back (g2p) and lets the material answer the new strain.

Symbols, as in the papers (left) and in this code:

    paper   code       unit    meaning
    x_p     x          m       position of a grain, measured from the grid's origin
    v_p     v          m/s     velocity
    C_p     C          1/s     affine velocity: the gradient a grain remembers [J15]
    m_p     m          kg      mass; 0 marks an empty slot
    V_p^0   V0         m^3     volume at rest
    b - I   e          -       elastic left Cauchy-Green strain minus identity, b = F_E F_E^T
    tau     tau        Pa      Kirchhoff stress (J times Cauchy stress)
    w_ip    w          -       quadratic B-spline weight of node i for grain p
    D_p     dx^2/4     m^2     the kernel's inertia tensor (quadratic B-splines)
    eps     eps        -       Hencky strain: logarithms of the principal elastic stretches
    mu, la  mu, lam    Pa      Lame parameters
    J_P     lnJp       -       log of the plastic volume ratio (snow)

Array layout: the grain axis is the LAST one, `x (d, n)`, so that every formula runs over long contiguous rows;
`transfer` cuts those rows into chunks that stay in cache. Symmetric tensors are `(4, n)` in plane strain
(11, 22, 33, 12; 33 is out of plane) and `(6, n)` in 3-D (11, 22, 33, 23, 13, 12).

Sources: [S13] Stomakhin et al., A material point method for snow simulation, SIGGRAPH 2013. [J15] Jiang et al., The
affine particle-in-cell method, SIGGRAPH 2015. [J16] Jiang et al., The material point method for simulating continuum
materials, SIGGRAPH 2016 course. [K16] Klar et al., Drucker-Prager elastoplasticity for sand animation, SIGGRAPH 2016.
[T17] Tampubolon et al., Multi-species simulation of porous sand and water, SIGGRAPH 2017. [H18] Hu et al., A moving
least squares material point method, SIGGRAPH 2018. [JK] Jop, Forterre & Pouliquen, A constitutive law for dense
granular flows, Nature 441, 2006. [D15] Dunatunga & Kamrin, Continuum modelling and simulation of granular flows
through their many phases, J. Fluid Mech. 779, 2015. [Y15] Yue et al., Continuum foam, ACM Trans. Graph. 34, 2015.
[G18] Gaume et al., Dynamic anticrack propagation in snow, Nature Communications 9, 2018.
"""
